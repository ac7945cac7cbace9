"""Learned exposures: single updates, the complete loss, and the gain on a scene with varying exposure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.perturbations import random_gains
from torch.utils._python_dispatch import TorchDispatchMode

from fake_backends import lacking
from gs2d.config.presets import appearance, refine, surface, with_exposure
from gs2d.config.protocols import GENERIC, NERF_SYNTHETIC
from gs2d.config.quantities import EXPOSURE, Quantity
from gs2d.config.recipe import LearningRates, Recipe
from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.exposure_transform import _exposed
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.cached_objective import CachedViews
from gs2d.training.learned.image_exposure import ImageExposure
from gs2d.training.learned.learned_table import shown, shown_splats
from gs2d.training.learned.quantity import ImagePoints
from gs2d.training.objective import clipped_pixels
from gs2d.training.state import TrainState
from gs2d.training.targets import Target
from gs2d.training.trainer import Trainer, TrainerOptions
from learned_rows import Learner, begun
from train_toys import SIZE, VIEWS, backends, random_splats, same, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


def by(settings: Quantity, iterations: int = 100) -> Recipe:
    return Recipe("one", (replace(surface(), iterations=iterations),), learned=(settings,))


# -- one update ---------------------------------------------------------------------------------------------------
def test_the_mean_of_all_transforms_is_the_identity(scene: Scene) -> None:
    made = Learner(by(EXPOSURE), scene)
    made.step("exposure", 1, torch.ones(3, 4), 0.1)
    transforms = torch.stack([made.numbers("exposure", index) for index in range(VIEWS)])
    assert torch.allclose(transforms.mean(dim=0), torch.eye(3, 4), atol=1e-7)
    assert torch.allclose(transforms[1] - torch.eye(3, 4), torch.full((3, 4), -0.1 * (VIEWS - 1) / VIEWS))


class Looks(TorchDispatchMode):
    """Counts operations that make the host wait for a device."""

    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.overloadpacket.__name__
        self.count += name in ("_local_scalar_dense", "nonzero", "is_nonzero", "masked_select")
        return function(*args, **(kwargs or {}))


def test_on_a_device_transform_and_update_do_not_wait(scene: Scene) -> None:
    made, backend = Learner(by(EXPOSURE), scene), lacking(0)
    color, coverage, white = torch.rand(4, 5, 3), torch.rand(4, 5), torch.ones(3)
    view = scene.train[1]
    with Looks() as looks:
        transform = made.numbers("exposure", 1)
        image = shown(color, {"exposure": transform}, ImagePoints(view.camera, coverage, white), color > 0.5)
        leaf = transform.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(_exposed(color, leaf, coverage, white), leaf, image)
        made.table.update(made.rows, 1, {"exposure": gradient}, {"exposure": 0.1}, backend)
        assert looks.count == 0
        backend.is_whole()  # one such operation
    assert looks.count == 1


# -- the loss -----------------------------------------------------------------------------------------------------
def test_the_gradient_of_a_transform_is_that_of_the_whole_loss(scene: Scene) -> None:
    recipe = with_exposure(Recipe("one", (replace(surface(), iterations=5),)))
    trainer = Trainer(scene, recipe, GENERIC, backend="reference", options=TrainerOptions(dtype=torch.float64))
    trainer.enter(0)
    state, stage = trainer.state, recipe.stages[0]
    rows = state.learned["exposure"]
    rows.values += 0.1 * torch.randn(VIEWS, 3, 4, generator=state.generator, dtype=torch.float64)
    transform = trainer.learned.numbers(state.learned, 2, rows.values)["exposure"]

    def loss(change: torch.Tensor) -> float:
        kept = rows.values.clone()
        rows.values[2] += change * VIEWS / (VIEWS - 1)  # centring removes a share of 1 / VIEWS
        total = sum(float(value) for value in trainer._whole.evaluate(state, stage, 1, 2).losses.values())
        rows.values = kept
        return total

    found = trainer._whole.evaluate(state, stage, 1, 2)
    assert found.losses["exposure"] == pytest.approx(0.001 * float((transform - torch.eye(3, 4)).square().sum()))
    for row, column in ((0, 0), (1, 2), (2, 3)):
        step = torch.zeros(3, 4, dtype=torch.float64)
        step[row, column] = 1e-6
        slope = (loss(step) - loss(-step)) / 2e-6
        assert float(found.learned["exposure"][row, column]) == pytest.approx(slope, rel=1e-4), (row, column)


def test_constant_exposures_change_no_bit_of_the_splats(
    scene: Scene, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ImageExposure, "eps", 1e30)  # updates underflow
    still = short().with_learned(replace(EXPOSURE, rate=1e-30, rate_final=1e-30, start=0))
    trainers = [Trainer(scene, recipe, GENERIC, backend=backend) for recipe in (short(), still)]
    assert same(*(trainer.run() for trainer in trainers))
    off, on = (trainer.state for trainer in trainers)
    assert off.learned == {}
    assert not on.learned["exposure"].values.any()
    assert sum(on.learned["exposure"].steps) == 10 + 4 + 5


def test_exposure_does_not_change_the_white_background(scene: Scene, backend: str) -> None:
    # Image and rendering are both empty, therefore white for any transform, and the loss is 0.
    empty = View.from_arrays("empty", scene.train[0].camera, np.zeros((SIZE, SIZE, 4), np.uint8))
    splats = random_splats(5)
    splats.opacity_logits.fill_(-20.0)
    state = TrainState(splats, torch.Generator().manual_seed(0))
    views = replace(scene, train=(empty, scene.train[1]))
    begun(state, by(EXPOSURE), views).learned["exposure"].values[0] = -0.5
    trainer = Trainer(views, by(EXPOSURE), NERF_SYNTHETIC, backend=backend, state=state)
    trainer.enter(0)
    found = trainer._whole.evaluate(state, trainer.recipe.stages[0], 1, 0)
    assert found.losses["l1"] == pytest.approx(0, abs=1e-6)
    assert found.losses["exposure"] > 0


def test_clipped_pixels_exclude_the_white_background() -> None:
    image = torch.tensor([[[1.0, 0.9, 1.0], [1.0, 1.0, 1.0]]])
    assert clipped_pixels(Target(image, None, None)).tolist() == [[[True, False, True], [True, True, True]]]
    cut_out = Target(image, None, None, silhouette=torch.tensor([[0.5, 0.0]]))
    assert clipped_pixels(cut_out).tolist() == [[[True, False, True], [False, False, False]]]


def test_a_clipped_pixel_allows_brighter_colours(scene: Scene) -> None:
    rendered = torch.tensor([[[1.3, 1.3, 0.7]]], requires_grad=True)
    clipped = torch.tensor([[[True, False, True]]])  # clipped red counts as no error; green and blue do count
    at = ImagePoints(scene.train[0].camera)
    seen = shown(rendered, {"exposure": torch.eye(3, 4)}, at, clipped)
    assert seen.flatten().tolist() == pytest.approx([1.0, 1.3, 0.7])
    seen.sum().backward()
    assert rendered.grad is not None
    assert rendered.grad.flatten().tolist() == [0, 1, 1]
    assert torch.equal(shown(rendered, {}, at, clipped), rendered)


def test_errors_are_ranked_in_the_exposure_of_the_photograph(scene: Scene, backend: str) -> None:
    # |A c - A P| with A = I / 2 is half of |c - P|.
    splats, view = random_splats(40, seed=1), scene.train[0]
    image, settings = torch.from_numpy(view.target((0.0, 0.0, 0.0))), RasterSettings()
    plain = splat_errors(splats, view.camera, image, settings, backend=backend)
    dim = shown_splats(splats, view.camera, {"exposure": 0.5 * torch.eye(3, 4)}, settings.sh_degree)
    found = splat_errors(dim, view.camera, image / 2, replace(settings, sh_degree=0), backend=backend)
    assert torch.allclose(found, plain / 2, rtol=1e-4, atol=1e-4)
    assert plain.max() > 1


@needs_cpu
def test_cached_views_have_the_losses_and_gradients_of_full_renderings(scene: Scene) -> None:
    recipe = Recipe("colors", (replace(appearance(k=20.0), iterations=3 * VIEWS),), learned=(EXPOSURE,))
    state = TrainState(random_splats(90, seed=5), torch.Generator().manual_seed(0))
    begun(state, recipe, scene).learned["exposure"].values += 0.1 * torch.randn(VIEWS, 3, 4, generator=state.generator)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=state)
    trainer.enter(0)
    cached = CachedViews(trainer._whole, state, recipe.stages[0], 1 << 30)
    assert len(cached.views) == VIEWS
    for index in range(VIEWS):
        a, b = (e.evaluate(state, recipe.stages[0], 1, index) for e in (cached, trainer._whole))
        assert a.losses == pytest.approx(b.losses, rel=1e-6)
        assert torch.allclose(a.learned["exposure"], b.learned["exposure"], rtol=1e-4, atol=1e-7)
        assert torch.allclose(a.gradients["sh0"], b.gradients["sh0"][cached.rows], rtol=1e-4, atol=1e-8)


# -- gain ---------------------------------------------------------------------------------------------------------
TRAIN, TEST = 16, 4


def image(truth: Splats, camera: Camera, gain: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        color = rasterize(truth, camera, RasterSettings(), backend="reference").color.numpy()
    return np.rint(255 * np.clip(color * gain, 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def varied() -> tuple[Scene, Splats, np.ndarray]:
    """Return matt splats with 16 images of random gains (mean 1) and 4 test images of gain 1, and the gains."""
    truth = random_splats(80, seed=3)
    truth.shN.zero_()
    truth.sh0.mul_(0.5)  # nothing near white, where images clip
    angles = 2.4 * np.arange(TRAIN + TEST)
    cameras = [
        look_at(
            np.array([3 * np.cos(a), 3 * np.sin(a), z]),
            np.zeros(3),
            np.array([0.0, 0.0, 1.0]),
            width=SIZE,
            height=SIZE,
            fx=30.0,
        )
        for a, z in zip(angles, np.linspace(-1.5, 1.5, TRAIN + TEST)[np.argsort(np.sin(7 * angles))], strict=True)
    ]
    gains = np.concatenate([random_gains(TRAIN, 0), np.ones((TEST, 3))])
    views = [
        View.from_arrays(f"{i:03d}.png", camera, image(truth, camera, gain))
        for i, (camera, gain) in enumerate(zip(cameras, gains, strict=True))
    ]
    scene = Scene(
        name="varied",
        format="colmap",
        train=tuple(views[:TRAIN]),
        test=tuple(views[TRAIN:]),
        points=PointCloud(truth.means.numpy().astype(np.float64), None),
        extent=camera_extent(cameras),
        bounds=np.array([[-1.0] * 3, [1.0] * 3]),
    )
    return scene, truth, gains[:TRAIN]


@needs_cpu
def test_exposure_gains_are_recovered_and_improve_new_views(varied: tuple[Scene, Splats, np.ndarray]) -> None:
    scene, truth, gains = varied
    stage = replace(surface(), iterations=480, densify=None, sh_interval=50, lr=LearningRates(means_decay_steps=480))
    plain = Recipe("plain", (stage,))
    scores, grey = [], np.empty(0)
    for recipe in (plain, plain.with_learned(replace(EXPOSURE, decay_steps=480, start=0))):
        state = TrainState(truth.clone(), torch.Generator().manual_seed(0))
        trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=begun(state, recipe, scene))
        scores.append(held_out_psnr(scene, trainer))
        if recipe.learned:
            transforms = np.stack([view.appearance["exposure"] for view in trainer.scene_now().train])
            grey = (0.5 * transforms[:, :, :3].sum(axis=2) + transforms[:, :, 3]) / 0.5  # mapped middle grey
    errors = np.abs(grey / gains - 1)  # the gains differ from 1 by 13 % on average
    assert scores[1] > scores[0] + 8  # measured: 36.4 and 50.1 dB
    assert errors.mean() < 0.012  # measured: 0.006
    assert errors.max() < 0.04  # measured: 0.022


def held_out_psnr(scene: Scene, trainer: Trainer) -> float:
    """Return the PSNR of the unmodified test images: nothing is fitted to them."""
    splats, errors = trainer.run(), []
    for view in scene.test:
        with torch.no_grad():
            color = rasterize(splats, view.camera, trainer.settings, backend="cpu").color
        target = torch.from_numpy(view.target(GENERIC.background))
        errors.append(float((color.clamp(0, 1) - target).square().mean()))
    return float(-10 * np.log10(np.mean(errors)))


def test_the_events_name_the_prior_among_the_losses(scene: Scene) -> None:
    seen: list[events.Progress] = []

    def listen(event: events.TrainingEvent) -> None:
        if isinstance(event, events.Progress):
            seen.append(event)

    recipe = Recipe("one", (replace(refine(), iterations=2, on_enter=()),), learned=(replace(EXPOSURE, start=0),))
    Trainer(
        scene, recipe, GENERIC, backend="reference", on_event=listen, options=TrainerOptions(progress_every=1)
    ).run()
    assert [event.losses["exposure"] > 0 for event in seen] == [False, True]  # the first transforms are identities
    assert seen[1].loss == pytest.approx(sum(seen[1].losses.values()))
