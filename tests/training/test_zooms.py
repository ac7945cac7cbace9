"""Learned focal lengths: gradients, sharing, single updates, resuming, and the gain."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.config.presets import get_recipe, surface, with_intrinsics
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import INTRINSICS, POSES
from gs2d.config.recipe import LearningRates, LossTerm, Recipe, validate
from gs2d.core.camera import Zoom, look_at
from gs2d.core.splats import Splats
from gs2d.data.camera_models import Lens
from gs2d.data.scene import Scene, View
from gs2d.data.undistort import Intrinsics
from gs2d.errors import RecipeError
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training.learned.camera_intrinsics import CameraIntrinsics
from gs2d.training.learned.learned_table import LearnedTable
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from learned_rows import Learner, begun
from train_toys import backends, make_scene, random_splats, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def quick(**changes: Any) -> Recipe:
    """Return ``short`` with poses and focal lengths active from the third iteration on."""
    learned = {"rate": 1e-2, "rate_final": 1e-3, "start": 2, "decay_steps": 10}
    intrinsics = replace(INTRINSICS, **learned, options=changes)  # type: ignore[arg-type]
    return short().with_learned(replace(POSES, **learned), intrinsics)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["normal_consistency", "normal_consistency_per_splat"])
def test_gradients_of_the_intrinsics_are_those_of_the_loss(scene: Scene, kind: str) -> None:
    terms = (LossTerm("l1", 0.8), LossTerm("ssim", 0.2), LossTerm(kind, 5.0), LossTerm("distortion", 10.0))
    stage = replace(surface(), losses=terms, densify=None)
    intrinsics = replace(INTRINSICS, start=0).with_options(principal_point=True)
    recipe = Recipe("all", (stage,), learned=(replace(POSES, start=0), intrinsics))
    found = {}
    for backend in backends():
        dtype = torch.float64 if backend == "reference" else torch.float32
        state = TrainState(random_splats(60, seed=1, dtype=dtype), torch.Generator().manual_seed(0))
        rows = begun(state, recipe, scene).learned["intrinsics"]
        start = torch.zeros(3, dtype=torch.float64)
        rows.values[:] = start
        trainer = Trainer(scene, recipe, GENERIC, backend=backend, state=state)
        trainer.enter(0)
        found[backend] = trainer._whole.evaluate(state, stage, 1, 2).learned["intrinsics"]
        if backend != "reference":
            largest = float(found["reference"].abs().max())
            torch.testing.assert_close(found[backend], found["reference"], rtol=2e-3, atol=2e-3 * largest)
            continue
        if kind == "normal_consistency":  # alpha is detached by definition, which finite differences cannot reproduce
            continue
        step, whole = 1e-6, trainer._whole
        for k in range(3):
            values = []
            for sign in (1, -1):
                rows.values[:] = start
                rows.values[:, k] += sign * step
                there = whole.camera(state, 2)
                output = rasterize(state.splats, there, whole.settings(stage, 1), backend=backend)
                values.append(float(sum(whole.differentiate(state, stage, 1, 2, there, output, {}).losses.values())))
            rows.values[:] = start
            slope = (values[0] - values[1]) / (2 * step)
            assert slope == pytest.approx(float(found[backend][k]), rel=1e-3, abs=1e-5)


def test_images_of_one_camera_share_a_focal_length(scene: Scene) -> None:
    first, second = (
        Intrinsics(64, 64, 60.0, 60.0, 32.0, 32.0),
        Intrinsics(64, 64, 70.0, 70.0, 32.0, 32.0, Lens("fov", (0.9,))),
    )
    views = [replace(view, intrinsics=second if index == 1 else first) for index, view in enumerate(scene.train)]
    seen = replace(scene, train=tuple(views))
    made = Learner(quick(principal_point=True), seen)
    quantity = made.table.quantities["intrinsics"]
    assert isinstance(quantity, CameraIntrinsics)
    assert quantity.row_of == [0, 1, 0, 0, 0, 0]
    made.step("intrinsics", 1, [5.0, 1.0, -1.0], 0.01)
    values = made.rows["intrinsics"].values
    assert quantity.zoom(values, 1) == pytest.approx((math.exp(-0.01), -0.01, 0.01))
    assert quantity.zoom(values, 0) == quantity.zoom(values, 3) == Zoom()


def test_only_the_requested_intrinsics_are_learned(scene: Scene) -> None:
    for recipe, moves in ((quick(), 1), (quick(principal_point=True), 3)):
        trainer = Trainer(scene, recipe, GENERIC, backend=backends()[-1])
        trainer.run()
        assert int(trainer.state.learned["intrinsics"].values.count_nonzero()) == moves


def test_panorama_faces_keep_their_intrinsics(scene: Scene) -> None:
    faces = replace(scene, train=tuple(replace(view, whole=view) for view in scene.train))
    for views, stays in ((faces, True), (scene, False)):
        trainer = Trainer(views, quick(), GENERIC, backend="reference")
        trainer.run()
        learned = trainer.state.learned
        assert bool((learned["intrinsics"].values == 0).all()) is stays
        assert bool(learned["poses"].values.any())


def test_invalid_intrinsics_recipes_are_refused() -> None:
    recipe = with_intrinsics(get_recipe("2dgs"))
    assert recipe.name == "2dgs-cameras"
    assert recipe.learns("poses")
    validate(recipe)
    with pytest.raises(RecipeError, match="intrinsics need poses in learned, got none"):
        validate(replace(recipe, learned=(INTRINSICS,)))
    with pytest.raises(RecipeError, match=r"intrinsics\.rate must be in \(0, 1\], got 0"):
        validate(recipe.with_learned(replace(INTRINSICS, rate=0.0)))


def test_options_that_a_quantity_does_not_take_are_refused(scene: Scene) -> None:
    recipe = with_intrinsics(get_recipe("2dgs"))
    for options, message in (
        ({"principal_point": 3}, "principal_point must be true or false, got 3"),
        ({"lens": 1}, "'intrinsics' does not take the options"),
    ):
        with pytest.raises(RecipeError, match=message):
            LearnedTable(recipe.with_learned(replace(INTRINSICS, options=options)), scene)


def test_test_views_of_the_same_camera_get_its_focal_length(scene: Scene) -> None:
    whole = replace(scene, test=(replace(scene.train[0], name="t.png"),))
    made = Learner(quick(), whole)
    made.rows["intrinsics"].values[:, 0] = 0.1
    now = made.table.scene_now(made.rows)
    assert now.test[0].camera.fx == pytest.approx(whole.test[0].camera.fx * math.exp(0.1))
    assert now.train[3].zoom == now.test[0].zoom
    assert np.array_equal(now.test[0].camera.T_cam_world, whole.test[0].camera.T_cam_world)


def seen_with_a_wrong_focal_length(factor: float) -> tuple[Splats, Scene]:
    """Return splats all around cameras whose focal length is off by a factor, and their images."""
    truth, angles = random_splats(160, seed=3), 2.4 * np.arange(20)
    truth = replace(truth, means=truth.means * 2, log_scales=truth.log_scales + 0.3)  # a large depth range
    heights, near = np.linspace(-1.5, 1.5, 20)[np.argsort(np.sin(7 * angles))], 3.0 + 0.8 * np.sin(5 * angles)
    base, views = make_scene(), []
    for k, (a, z, r) in enumerate(zip(angles, heights, near, strict=True)):
        eye = np.array([r * np.cos(a), r * np.sin(a), z])
        camera = look_at(eye, np.zeros(3), np.eye(3)[2], width=40, height=40, fx=50.0)
        with torch.no_grad():
            color = rasterize(truth, camera, RasterSettings(), backend="cpu").color
        image = (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        said = replace(camera, fx=50.0 * factor, fy=50.0 * factor)
        views.append(View.from_arrays(f"{k:02d}.png", said, image))
    return truth, replace(base, train=tuple(views[:16]), test=tuple(views[16:]))


@needs_cpu
def test_the_focal_length_of_a_known_scene_is_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, scene = seen_with_a_wrong_focal_length(1.02)
    stage = replace(surface(), iterations=120, densify=None, losses=(LossTerm("l1", 0.8), LossTerm("ssim", 0.2)))
    learned = {"start": 0, "decay_steps": 120}
    settings = replace(INTRINSICS, rate=2e-3, rate_final=1e-5, **learned)
    recipe = Recipe("one", (stage,), learned=(replace(POSES, **learned), settings))
    monkeypatch.setattr(CameraIntrinsics, "beta2", 0.9)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", init=truth)
    trainer.enter(0)
    state, quantity = trainer.state, trainer.learned.quantities["intrinsics"]
    assert isinstance(quantity, CameraIntrinsics)
    rows = state.learned["intrinsics"]
    for iteration in range(1, 121):
        index = iteration % 16
        found = trainer._whole.evaluate(state, replace(stage, sh_interval=0), iteration, index)
        rates = {"intrinsics": trainer.learned.learning(0, iteration)["intrinsics"]}
        trainer.learned.update(state.learned, index, found.learned, rates, trainer.backend)
    assert 1.02 * quantity.zoom(rows.values, 0).scale == pytest.approx(1.0, abs=3e-4)


@needs_cpu
@pytest.mark.slow
def test_a_focal_length_is_recovered_together_with_scene_and_poses() -> None:
    truth, scene = seen_with_a_wrong_focal_length(1.02)
    lr = LearningRates(means_decay_steps=1500, means=8e-4, means_final=8e-5)
    stage = replace(surface(), iterations=1500, densify=None, sh_interval=300, lr=lr)
    poses = replace(POSES, rate=1e-3, rate_final=5e-5, start=20, decay_steps=1500)
    intrinsics = replace(INTRINSICS, rate=3e-3, rate_final=1.5e-4, start=20, decay_steps=1500)
    trainer = Trainer(scene, Recipe("one", (stage,), learned=(poses, intrinsics)), GENERIC, init=truth)
    trainer.run()
    now = trainer.scene_now()
    assert now.train[0].camera.fx / 50 == pytest.approx(1.0, abs=0.006)
