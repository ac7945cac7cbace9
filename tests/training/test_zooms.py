"""Focal lengths and lenses that are learned: gradients, sharing, updates by hand, resuming, what they are worth."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from fake_backends import lacking
from gs2d.config.presets import get_recipe, surface, with_intrinsics, with_multiview
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import IntrinsicsRefinement, LearningRates, LossTerm, PoseRefinement, Recipe, Stage, validate
from gs2d.config.schedule import scale_schedule
from gs2d.core.camera import Zoom, look_at
from gs2d.core.residual_lens import through_lens
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.data.undistort import Intrinsics, Lens
from gs2d.errors import DivergedError, RecipeError, RunError
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training import per_image
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from gs2d.training.zooms import Zooms, zoom_rate, zoom_step
from train_toys import backends, make_scene, random_splats, same, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def quick(**changes: Any) -> Recipe:
    """``short`` with poses and focal lengths from its third iteration on."""
    learned = {"rate": 1e-2, "rate_final": 1e-3, "start": 2, "decay_steps": 10}
    return replace(short(), poses=PoseRefinement(**learned), intrinsics=IntrinsicsRefinement(**{**learned, **changes}))


@pytest.mark.parametrize("kind", ["normal_consistency", "normal_consistency_per_splat"])
def test_the_gradient_is_that_of_the_whole_loss_by_focal_length_principal_point_and_lens(
    scene: Scene, kind: str
) -> None:
    terms = (LossTerm("l1", 0.8), LossTerm("ssim", 0.2), LossTerm(kind, 5.0), LossTerm("distortion", 10.0))
    stage = replace(surface(), losses=terms, densify=None)
    recipe = Recipe(
        "all",
        (stage,),
        poses=PoseRefinement(start=0),
        intrinsics=IntrinsicsRefinement(start=0, principal_point=True, distortion=True),
    )
    found = {}
    for backend in backends():
        dtype = torch.float64 if backend == "reference" else torch.float32
        state = TrainState(random_splats(60, seed=1, dtype=dtype), torch.Generator().manual_seed(0))
        state = per_image.start(state, recipe, scene)
        assert state.zooms is not None
        begun = torch.tensor([0.0, 0.0, 0.0, 0.01, -0.02], dtype=torch.float64)  # samples lie between pixels
        state.zooms.offsets[:] = begun
        trainer = Trainer(scene, recipe, GENERIC, backend=backend, state=state)
        trainer.enter(0)
        found[backend] = trainer._whole.evaluate(state, stage, 1, 2).gradients["zoom"]
        if backend != "reference":
            largest = float(found["reference"].abs().max())
            torch.testing.assert_close(found[backend], found["reference"], rtol=2e-3, atol=2e-3 * largest)
            continue
        if kind == "normal_consistency":  # its alpha is held by definition, which differences do not do
            continue
        step, whole = 1e-6, trainer._whole
        for k in range(5):
            values = []
            for sign in (1, -1):
                state.zooms.offsets[:] = begun
                state.zooms.offsets[:, k] += sign * step
                there = whole.camera(state, 2)
                output = rasterize(state.splats, there, whole.settings(stage, 1), backend=backend)
                values.append(float(sum(whole.differentiate(state, stage, 1, 2, there, output, {})[0].values())))
            state.zooms.offsets[:] = begun
            slope = (values[0] - values[1]) / (2 * step)
            assert slope == pytest.approx(float(found[backend][k]), rel=1e-3, abs=1e-5)


def test_photographs_of_one_camera_share_a_focal_length_and_the_first_step_is_the_rate(scene: Scene) -> None:
    first, second = (
        Intrinsics(64, 64, 60.0, 60.0, 32.0, 32.0),
        Intrinsics(64, 64, 70.0, 70.0, 32.0, 32.0, Lens("fov", (0.9,))),
    )
    views = [replace(view, intrinsics=second if index == 1 else first) for index, view in enumerate(scene.train)]
    made = Zooms.start(views)
    assert made.group == [0, 1, 0, 0, 0, 0]
    zoom_step(made, 3, torch.tensor([-5.0, 1.0, -1.0, 2.0, 2.0], dtype=torch.float64), quick(), 0.01)
    assert made.zoom(0) == made.zoom(3) == Zoom(pytest.approx(math.exp(0.01)), 0.0, 0.0)
    assert made.zoom(1) == Zoom()
    everything, corner = quick(principal_point=True, distortion=True), made.corners[1]
    assert corner == pytest.approx(2 * (views[1].camera.width / views[1].camera.fx / 2) ** 2)
    zoom_step(made, 1, torch.tensor([5.0, 1.0, -1.0, 2.0, -2.0], dtype=torch.float64), everything, 0.01)
    assert made.zoom(1) == pytest.approx((math.exp(-0.01), -0.01, 0.01, -0.01 / corner, 0.01 / corner**2))
    assert made.steps == [1, 1]


def test_faces_of_a_panorama_keep_their_intrinsics_while_their_poses_learn(scene: Scene) -> None:
    faces = replace(scene, train=tuple(replace(view, is_face=True) for view in scene.train))
    for views, stays in ((faces, True), (scene, False)):
        trainer = Trainer(views, quick(distortion=True), GENERIC, backend="reference")
        trainer.run()
        state = trainer.state
        assert state.zooms is not None
        assert state.poses is not None
        assert bool((state.zooms.offsets == 0).all()) is stays
        assert bool(state.poses.offsets.any())


def test_the_camera_s_numbers_are_those_of_its_size(scene: Scene) -> None:
    camera = replace(scene.train[0].camera, width=40, height=30, cx=19.0, cy=16.0, fx=50.0, fy=51.0)
    now = camera.zoomed(Zoom(1.1, 0.02, -0.01))
    assert (now.fx, now.fy, now.cx, now.cy) == pytest.approx((55.0, 56.1, 20.0, 15.49))
    half = camera.resized(20, 15).zoomed(Zoom(1.1, 0.02, -0.01))
    again = now.resized(20, 15)
    assert (half.fx, half.fy, half.cx, half.cy) == pytest.approx((again.fx, again.fy, again.cx, again.cy))


def test_they_learn_where_poses_do_and_faster_in_short_schedules() -> None:
    recipe = quick()
    assert [zoom_rate(recipe, 0, i) > 0 for i in (1, 2, 3, 4)] == [False, False, True, True]
    assert zoom_rate(recipe, 1, 1) == 0  # only colours learn
    assert zoom_rate(short(), 0, 5) == 0
    tenth = scale_schedule(with_intrinsics(get_recipe("2dgs")), 0.1).intrinsics
    assert tenth is not None
    assert tenth.rate == pytest.approx(IntrinsicsRefinement().rate * math.sqrt(10))
    assert tenth.start == 200


def test_what_cannot_be_learned_is_refused() -> None:
    recipe = with_intrinsics(get_recipe("2dgs"))
    assert recipe.name == "2dgs-cameras"
    assert recipe.poses is not None
    validate(recipe)
    with pytest.raises(RecipeError, match="intrinsics learn with poses, got poses=null"):
        validate(replace(recipe, poses=None))
    with pytest.raises(RecipeError, match="intrinsics cannot learn with multiview"):
        validate(with_multiview(recipe, 0.6, 0.04))
    with pytest.raises(RecipeError, match=r"intrinsics\.rate must be positive, got 0.* \(intrinsics=null leaves"):
        validate(replace(recipe, intrinsics=IntrinsicsRefinement(rate=0.0)))
    with pytest.raises(RecipeError, match=r"principal_point must be true or false, got 3"):
        validate(replace(recipe, intrinsics=IntrinsicsRefinement(principal_point=3)))  # type: ignore[arg-type]
    with pytest.raises(RecipeError, match=r"distortion must be true or false, got 'k1'"):
        validate(replace(recipe, intrinsics=IntrinsicsRefinement(distortion="k1")))  # type: ignore[arg-type]


def test_resuming_from_any_event_gives_the_same_splats_and_focal_lengths(scene: Scene) -> None:
    kept: list[bytes] = []

    def save(_: object) -> None:
        file = io.BytesIO()
        torch.save(trainer.state.state_dict(), file)
        kept.append(file.getvalue())

    recipe = quick(distortion=True)
    trainer = Trainer(scene, recipe, GENERIC, backend=backends()[-1], progress_every=1, on_event=save)
    end = trainer.run()
    assert trainer.state.zooms is not None
    assert trainer.state.zooms.offsets[:, 0].abs().max() > 1e-3
    assert not trainer.state.zooms.offsets[:, 1:3].any()  # principal points stay
    assert trainer.state.zooms.offsets[:, 3:].abs().min() > 1e-4
    for data in kept[::5]:
        state = TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))
        resumed = Trainer(scene, recipe, GENERIC, backend=backends()[-1], state=state)
        assert same(resumed.run(), end)
        assert resumed.state.zooms is not None
        assert torch.equal(resumed.state.zooms.offsets, trainer.state.zooms.offsets)


def test_a_state_of_other_views_or_a_gradient_that_is_not_finite_is_refused(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = per_image.start(TrainState(random_splats(5), torch.Generator()), replace(quick(), intrinsics=None), scene)
    with pytest.raises(RunError, match="focal lengths of 6 views, as recipe and scene say, got 0"):
        Trainer(scene, quick(), GENERIC, backend="reference", state=state)
    trainer = Trainer(scene, quick(start=0), GENERIC, backend=backends()[-1])
    trainer.enter(0)
    monkeypatch.setattr(Zooms, "gradient", lambda *_: torch.full((5,), torch.nan))
    with pytest.raises(DivergedError, match="the gradient of focal length is NaN or infinite"):
        trainer.step()


def test_an_update_that_was_cancelled_on_the_device_changes_nothing(scene: Scene) -> None:
    state = per_image.start(TrainState(random_splats(5), torch.Generator()), quick(), scene)
    assert state.zooms is not None
    gradients = {"zoom": torch.ones(5, dtype=torch.float64)}
    per_image.update(state, replace(quick(), exposure=None), 5, 1, gradients, lacking(1))
    assert not any(state.zooms.steps)
    per_image.update(state, replace(quick(), exposure=None), 5, 1, gradients, lacking(0))
    assert sum(state.zooms.steps) == 1


def test_test_photographs_of_the_same_camera_get_its_focal_length(scene: Scene) -> None:
    whole = replace(scene, test=(replace(scene.train[0], name="t.png"),))
    state = per_image.start(TrainState(random_splats(5), torch.Generator()), quick(), whole)
    assert state.zooms is not None
    state.zooms.offsets[:, 0] = 0.1
    now = per_image.scene_now(state, whole)
    assert now.test[0].camera.fx == pytest.approx(whole.test[0].camera.fx * math.exp(0.1))
    assert now.train[3].zoom == now.test[0].zoom
    assert np.array_equal(now.test[0].camera.T_cam_world, whole.test[0].camera.T_cam_world)


def seen_with_a_wrong_focal_length(factor: float) -> tuple[Splats, Scene]:
    """Splats before, around and behind cameras that say a focal length that is off, and their photographs."""
    truth, angles = random_splats(160, seed=3), 2.4 * np.arange(20)
    truth = replace(truth, means=truth.means * 2, log_scales=truth.log_scales + 0.3)  # far and near: it shows
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
def test_the_focal_length_of_a_scene_that_is_known_is_found_to_the_last_digits() -> None:
    truth, scene = seen_with_a_wrong_focal_length(1.02)
    stage = replace(surface(), iterations=120, densify=None, losses=(LossTerm("l1", 0.8), LossTerm("ssim", 0.2)))
    learned = {"start": 0, "decay_steps": 120}
    settings = IntrinsicsRefinement(rate=2e-3, rate_final=1e-5, beta2=0.9, **learned)
    recipe = Recipe("one", (stage,), poses=PoseRefinement(**learned), intrinsics=settings)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", init=truth)
    trainer.enter(0)
    state, zooms = trainer.state, trainer.state.zooms
    assert zooms is not None
    for iteration in range(1, 121):
        index = iteration % 16
        found = trainer._whole.evaluate(state, replace(stage, sh_interval=0), iteration, index)
        zoom_step(zooms, index, found.gradients["zoom"], recipe, zoom_rate(recipe, 0, iteration))
    assert 1.02 * zooms.zoom(0).scale == pytest.approx(1.0, abs=3e-4)


@needs_cpu
@pytest.mark.slow
def test_a_focal_length_that_is_two_per_cent_off_is_found_with_the_scene_and_the_poses() -> None:
    truth, scene = seen_with_a_wrong_focal_length(1.02)
    lr = LearningRates(means_decay_steps=1500, means=8e-4, means_final=8e-5)
    stage = replace(surface(), iterations=1500, densify=None, sh_interval=300, lr=lr)
    poses = PoseRefinement(rate=1e-3, rate_final=5e-5, start=20, decay_steps=1500)
    intrinsics = IntrinsicsRefinement(rate=3e-3, rate_final=1.5e-4, start=20, decay_steps=1500)
    trainer = Trainer(scene, Recipe("one", (stage,), poses=poses, intrinsics=intrinsics), GENERIC, init=truth)
    trainer.run()
    now = per_image.scene_now(trainer.state, scene)
    assert now.train[0].camera.fx / 50 == pytest.approx(1.0, abs=0.006)


LENS = (-0.12, -0.04)


def seen_through_a_lens() -> tuple[Splats, Scene]:
    """Splats and photographs of them by cameras of which something of the lens is left, and nobody says so."""
    truth, scene = seen_with_a_wrong_focal_length(1.0)
    views = []
    for view in scene.views:
        with torch.no_grad():
            color = rasterize(truth, view.camera, RasterSettings(), backend="cpu").color
        seen, inside = through_lens(color.clamp(0, 1), view.camera, torch.tensor(LENS))
        assert bool(inside.all())
        views.append(View.from_arrays(view.name, view.camera, (seen * 255).round().to(torch.uint8).numpy()))
    return truth, replace(scene, train=tuple(views[:16]), test=tuple(views[16:]))


@needs_cpu
def test_the_lens_of_a_scene_that_is_known_is_found_with_its_focal_length() -> None:
    truth, scene = seen_through_a_lens()
    stage = replace(surface(), iterations=240, densify=None, losses=(LossTerm("l1", 0.8), LossTerm("ssim", 0.2)))
    learned = {"start": 0, "decay_steps": 240}
    settings = IntrinsicsRefinement(rate=2e-3, rate_final=2e-5, beta2=0.9, distortion=True, **learned)
    recipe = Recipe("one", (stage,), poses=PoseRefinement(**learned), intrinsics=settings)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", init=truth)
    trainer.enter(0)
    state, zooms = trainer.state, trainer.state.zooms
    assert zooms is not None
    before = residual_of(trainer, state, stage)
    for iteration in range(1, 241):
        index = iteration % 16
        found = trainer._whole.evaluate(state, replace(stage, sh_interval=0), iteration, index)
        zoom_step(zooms, index, found.gradients["zoom"], recipe, zoom_rate(recipe, 0, iteration))
    found_lens, corner = zooms.zoom(0), zooms.corners[0]
    for square in (0.1, 0.2, corner):  # what it does to the picture, rather than its two numbers, is told apart well
        wanted = 1 + LENS[0] * square + LENS[1] * square**2
        got = (1 + found_lens.k1 * square + found_lens.k2 * square**2) * found_lens.scale
        assert got == pytest.approx(wanted, abs=2e-3)
    # The ranking of splats and E_i look at photographs that were straightened.
    assert residual_of(trainer, state, stage) < before / 3


def residual_of(trainer: Trainer, state: TrainState, stage: Stage) -> float:
    """What renderings of all photographs differ by in the mean, as E_i sees it."""
    plain = replace(stage, sh_interval=0)
    return float(np.mean([trainer._whole.residual(state, plain, 1, k).error.mean() for k in range(16)]))


@needs_cpu
@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_lens_is_found_with_the_scene_and_new_views_gain(seed: int) -> None:
    truth, scene = seen_through_a_lens()
    lr = LearningRates(means_decay_steps=1500, means=8e-4, means_final=8e-5)
    stage = replace(surface(), iterations=1500, densify=None, sh_interval=300, lr=lr)
    poses = PoseRefinement(rate=1e-3, rate_final=5e-5, start=20, decay_steps=1500)
    psnr = []
    for distortion in (False, True):
        intrinsics = IntrinsicsRefinement(
            rate=3e-3, rate_final=1.5e-4, start=20, decay_steps=1500, distortion=distortion
        )
        recipe = Recipe("one", (stage,), seed=seed, poses=poses, intrinsics=intrinsics)
        trainer = Trainer(scene, recipe, GENERIC, init=truth)
        splats = trainer.run()
        errors = []
        for view in per_image.scene_now(trainer.state, scene).test:
            with torch.no_grad():
                color = rasterize(splats, view.camera, trainer.settings, backend="cpu").color
            valid = view.valid()
            error = (color - torch.from_numpy(view.target((0.0, 0.0, 0.0)))).square().mean(dim=2)
            errors.append(float(error.mean() if valid is None else error[torch.from_numpy(valid)].mean()))
        psnr.append(-10 * math.log10(np.mean(errors)))
    assert psnr[1] > psnr[0] + 2.0, psnr


def test_photographs_of_a_lens_that_was_found_are_straightened_wherever_they_are_asked_for() -> None:
    camera = look_at(np.array([3.0, 0, 0]), np.zeros(3), np.eye(3)[2], width=40, height=30, fx=36.0)
    picture = np.zeros((30, 40, 3), np.uint8)
    picture[14:16], picture[:, 19:21], picture[3] = 255, 255, 255
    view = View.from_arrays("a.png", camera, picture)
    there = view.at(camera.T_cam_world, Zoom(1.0, 0.0, 0.0, 0.08, 0.0))
    straight, valid = there.image(), there.valid()
    assert np.array_equal(straight[14:16, 5:35], picture[14:16, 5:35])  # the middle lines stay
    assert straight[3, 20].max() < 255 or straight[3, 3].max() < 255  # others bend
    assert valid is None  # the photograph shows more than a pinhole of this size
    wide = view.at(camera.T_cam_world, Zoom(1.0, 0.0, 0.0, -0.08, 0.0))
    reached = wide.valid()
    assert reached is not None
    assert not reached[0, 0]
    assert reached[5:25, 5:35].all()
    mask = wide.mask()
    assert mask is not None
    assert np.array_equal(mask, reached)
    assert np.array_equal(wide.at(camera.T_cam_world).image(), wide.image())  # once, however often it is moved
    assert there.downscaled(2).image().shape == (15, 20, 3)


def test_checkpoints_of_before_there_were_lenses_are_read(scene: Scene) -> None:
    made = Zooms.start(scene.train)
    data = made.state_dict()
    for name in ("offsets", "mean", "square"):
        data[name] = torch.full((1, 3), 0.5, dtype=torch.float64)
    del data["corners"]
    again = Zooms.from_state_dict(data)
    again.check()
    assert again.offsets.tolist() == [[0.5, 0.5, 0.5, 0.0, 0.0]]
