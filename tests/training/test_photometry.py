"""Learned vignetting and response: single updates, the complete loss, resuming, and the gain."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.presets import surface
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import EXPOSURE, RESPONSE, VIGNETTING
from gs2d.config.recipe import LearningRates, Recipe
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent
from gs2d.core.vignetting import reach_of
from gs2d.data.camera_models import Lens
from gs2d.data.scene import Appearance, PointCloud, Scene, View
from gs2d.data.undistort import Intrinsics
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.exposure_transform import identity
from gs2d.render.types import RasterSettings
from gs2d.synthetic.perturb_exposure import random_gains
from gs2d.training.learned.appearance import numbers_of, shown, shown_splats, unshown
from gs2d.training.learned.quantity import ImagePoints
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions
from learned_rows import Learner, begun
from train_toys import SIZE, VIEWS, backends, random_splats, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


def quick() -> Recipe:
    """Return ``short`` with all photometric and camera quantities active from the third iteration on."""
    light = (replace(quantity, start=2, decay_steps=10, rate=0.02) for quantity in (VIGNETTING, RESPONSE))
    return short().with_learned(replace(EXPOSURE, start=2, decay_steps=10), *light)


def seen_through(views: tuple[View, ...], cameras: int) -> list[View]:
    """Assign ``cameras`` different intrinsics to the views, in rotation."""
    known = [Intrinsics(64, 64, 60.0 + i, 60.0, 32.0, 32.0, Lens("fov", (0.9,))) for i in range(cameras)]
    return [replace(view, intrinsics=known[index % cameras]) for index, view in enumerate(views)]


# -- one update ---------------------------------------------------------------------------------------------------
def test_images_of_one_camera_share_vignetting_and_response(scene: Scene) -> None:
    views = replace(scene, train=tuple(seen_through(scene.train, 2)))
    made = Learner(short().with_learned(VIGNETTING, RESPONSE), views)
    assert made.table.quantities["vignetting"].row_of == [0, 1, 0, 1, 0, 1]
    made.step("vignetting", 2, [5.0, -5.0, 1.0], 0.01)
    made.step("response", 2, [-1.0], 0.01)
    seen = [view.appearance for view in made.table.scene_now(made.rows).train]
    powers = reach_of([scene.train[0].camera]) ** np.array([2.0, 4.0, 6.0])
    for index in (0, 2, 4):
        assert seen[index]["vignetting"] * powers == pytest.approx([-0.01, 0.01, -0.01])
        assert seen[index]["response"] == pytest.approx(0.005)  # half of the images are from this camera
    assert not seen[1]["vignetting"].any()
    assert seen[1]["response"] == pytest.approx(-0.005)
    only = short().with_learned(VIGNETTING)
    assert [*Learner(only, views).rows] == ["vignetting"]


def test_panorama_faces_learn_no_vignetting(scene: Scene) -> None:
    views = seen_through(scene.train, 2)
    for is_face in (False, True):
        seen = replace(scene, train=tuple(replace(view, is_face=is_face) for view in views))
        trainer = Trainer(seen, quick(), GENERIC, backend="reference")
        trainer.run()
        learned = trainer.state.learned
        assert bool(learned["vignetting"].values.any()) is not is_face
        assert bool(learned["response"].values.all())


# -- the loss -----------------------------------------------------------------------------------------------------
def test_gradients_of_vignetting_and_response_are_those_of_the_loss(scene: Scene) -> None:
    recipe = Recipe("one", (replace(surface(), iterations=5),), learned=(VIGNETTING, RESPONSE, EXPOSURE))
    views = replace(scene, train=tuple(seen_through(scene.train, 2)))
    trainer = Trainer(views, recipe, GENERIC, backend="reference", options=TrainerOptions(dtype=torch.float64))
    trainer.enter(0)
    state, stage = trainer.state, recipe.stages[0]
    state.learned["exposure"].values += 0.1 * torch.randn(VIEWS, 3, 4, generator=state.generator, dtype=torch.float64)
    state.learned["vignetting"].values += torch.tensor([[0.3, -0.1, 0.1], [0.1, 0.1, 0.0]], dtype=torch.float64)
    state.learned["response"].values += torch.tensor([[0.5], [-0.2]], dtype=torch.float64)
    found = trainer._whole.evaluate(state, stage, 1, 2)
    assert found.losses["vignetting"] == pytest.approx(0.001 * (0.09 + 0.01 + 0.01))
    assert found.losses["response"] == pytest.approx(0.001 * 0.35**2)  # (0.5 + 0.2) / 2
    for name, column in (("vignetting", 0), ("vignetting", 1), ("vignetting", 2), ("response", 0)):
        values = []
        for step in (1e-6, -1e-6):
            state.learned[name].values[0, column] += step
            values.append(sum(float(v) for v in trainer._whole.evaluate(state, stage, 1, 2).losses.values()))
            state.learned[name].values[0, column] -= step
        slope = (values[0] - values[1]) / 2e-6
        assert float(found.learned[name][column]) == pytest.approx(slope, rel=1e-3, abs=1e-9), (name, column)


def test_constant_photometry_leaves_splats_unchanged_up_to_rounding(scene: Scene, backend: str) -> None:
    still = [replace(quantity, rate=1e-30, rate_final=1e-30, start=0) for quantity in (VIGNETTING, RESPONSE)]
    recipes = short(), short().with_learned(*still)
    plain, learned = (Trainer(scene, recipe, GENERIC, backend=backend) for recipe in recipes)
    before, after = plain.run(), learned.run()
    assert sum(learned.state.learned["vignetting"].steps) == 10 + 4 + 5
    assert len(before) == len(after)
    assert torch.allclose(before.means, after.means, atol=1e-3)


def test_ranking_uses_the_vignetting_of_the_image(scene: Scene) -> None:
    # A falloff that is uniform over the whole image is a gain.
    splats, view = random_splats(40, seed=1), scene.train[0]
    image, settings = torch.from_numpy(view.target((0.0, 0.0, 0.0))), RasterSettings()
    plain = splat_errors(splats, view.camera, image, settings, backend="reference")
    darker, dim, even = (
        shown_splats(splats, view.camera, {"vignetting": torch.tensor(falloff), "exposure": gain * torch.eye(3, 4)}, 3)
        for falloff, gain in (((0.5, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.0), 0.5), ((0.0, 0.0, 0.0), 1.0))
    )
    found = splat_errors(dim, view.camera, image / 2, replace(settings, sh_degree=0), backend="reference")
    assert torch.allclose(found, plain / 2, rtol=1e-4, atol=1e-4)
    assert (darker.sh0 <= even.sh0 + 1e-6).all()
    assert (darker.sh0 < even.sh0 - 0.01).any()


def test_unshown_inverts_shown(scene: Scene) -> None:
    color, at = 0.2 + 0.5 * torch.rand(SIZE, SIZE, 3, dtype=torch.float64), ImagePoints(scene.train[0].camera)
    transform = identity(color) + torch.tensor([[0.1, 0.02, 0.0, 0.03]] * 3, dtype=torch.float64)
    known = {"response": torch.tensor([0.5]), "exposure": transform, "vignetting": torch.tensor([0.3, 0.1, 0.0])}
    known = {name: numbers.double() for name, numbers in known.items()}
    assert torch.allclose(unshown(shown(color, known, at), known, at), color)


# -- gain ---------------------------------------------------------------------------------------------------------
TRAIN, TEST = 24, 4
FALLOFF = (0.35, 0.15, 0.0)


def taken(lights: tuple[dict[str, torch.Tensor], ...], gains: np.ndarray) -> tuple[Scene, Splats]:
    """Render matt splats with these gains, alternating between cameras with these photometric models."""
    truth = random_splats(120, seed=3)
    truth.shN.zero_()
    truth.sh0.mul_(0.5)
    angles = 2.4 * np.arange(TRAIN + TEST)
    heights = np.linspace(-1.5, 1.5, TRAIN + TEST)[np.argsort(np.sin(7 * angles))]
    up, views = np.array([0.0, 0.0, 1.0]), []
    for i, (a, z) in enumerate(zip(angles, heights, strict=True)):
        aside = 0.4 * np.array([np.sin(3 * a), np.cos(5 * a), np.sin(11 * a)])  # varies the image positions of splats
        place, number = np.array([3 * np.cos(a), 3 * np.sin(a), z]), i % len(lights)
        camera = look_at(place, aside, up, width=SIZE, height=SIZE, fx=30.0)
        with torch.no_grad():
            color = rasterize(truth, camera, RasterSettings(), backend="reference").color
            exposure = {"exposure": identity(color) * torch.from_numpy(gains[i]).float()[:, None]}
            color = shown(color, exposure | lights[number], ImagePoints(camera))
        view = View.from_arrays(f"{i:03d}.png", camera, np.rint(255 * color.clamp(0, 1).numpy()).astype(np.uint8))
        views.append(replace(view, intrinsics=Intrinsics(SIZE, SIZE, 30.0 + number, 30.0, SIZE / 2, SIZE / 2)))
    scene = Scene(
        name="taken",
        format="colmap",
        train=tuple(views[:TRAIN]),
        test=tuple(views[TRAIN:]),
        points=PointCloud(truth.means.numpy().astype(np.float64), None),
        extent=camera_extent([view.camera for view in views]),
        bounds=np.array([[-1.0] * 3, [1.0] * 3]),
    )
    return scene, truth


def learned(scene: Scene, truth: Splats, recipe: Recipe) -> tuple[float, list[Appearance]]:
    """Train from the true splats; return the PSNR of the test images, and the estimated camera models."""
    state = begun(TrainState(truth.clone(), torch.Generator().manual_seed(0)), recipe, scene)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=state)
    trainer.run()
    now = trainer.scene_now()
    return held_out_psnr(now, trainer), [view.appearance for view in now.test]


def short_stage(iterations: int) -> Recipe:
    rates = LearningRates(means_decay_steps=iterations)
    stage = replace(surface(), iterations=iterations, densify=None, sh_interval=iterations, lr=rates)
    return Recipe("plain", (stage,))


@needs_cpu
def test_vignetting_is_recovered_and_improves_new_views() -> None:
    gains = np.concatenate([random_gains(TRAIN, 0), np.ones((TEST, 3))])
    powers = (math.hypot(SIZE, SIZE) / 2 / 30) ** torch.tensor([2.0, 4.0, 6.0])
    scene, truth = taken(({"vignetting": torch.tensor(FALLOFF) / powers},), gains)
    plain = short_stage(600).with_learned(replace(EXPOSURE, decay_steps=600, start=0))
    light = replace(VIGNETTING, rate=0.01, rate_final=1e-3, decay_steps=600, start=0)
    without, _ = learned(scene, truth, plain)
    score, (found, *_) = learned(scene, truth, plain.with_learned(light))
    assert score > without + 8  # measured: 35.4 and 51.7 dB
    corner = math.exp(-(found["vignetting"] * powers.numpy()).sum())
    assert corner == pytest.approx(math.exp(-0.5), rel=0.08)  # measured: 0.583 for 0.607


@needs_cpu
def test_response_curves_are_recovered_and_improve_new_views() -> None:
    lights = {"response": torch.tensor([0.5])}, {"response": torch.tensor([-0.5])}
    scene, truth = taken(lights, np.ones((TRAIN + TEST, 3)))
    light = replace(RESPONSE, rate=0.01, rate_final=1e-3, decay_steps=600, start=0)
    without, _ = learned(scene, truth, short_stage(600))
    score, (first, second, *_) = learned(scene, truth, short_stage(600).with_learned(light))
    assert score > without + 20  # measured: 21.2 and 55.6 dB
    assert (*first["response"], *second["response"]) == pytest.approx((0.5, -0.5), abs=0.03)  # measured: within 0.002


def held_out_psnr(scene: Scene, trainer: Trainer) -> float:
    """Return the PSNR of the test images, at the mean exposure and with their camera's photometric model."""
    errors = []
    for view in scene.test:
        with torch.no_grad():
            color = rasterize(trainer.splats, view.camera, trainer.settings, backend="cpu").color
            color = shown(color, numbers_of(view, color), ImagePoints(view.camera))
        target = torch.from_numpy(view.target(GENERIC.background))
        errors.append(float((color.clamp(0, 1) - target).square().mean()))
    return float(-10 * np.log10(np.mean(errors)))
