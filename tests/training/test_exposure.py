"""Exposures that are learned: updates by hand, the whole loss, what they are worth on a scene that needs them."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from fake_backends import lacking
from gs2d.config.presets import appearance, refine, surface, with_exposure
from gs2d.config.protocols import GENERIC, NERF_SYNTHETIC
from gs2d.config.recipe import Exposure, LearningRates, Recipe
from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.errors import RunError
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.exposure import _exposed, _gradients
from gs2d.render.types import RasterSettings
from gs2d.synthetic.perturb_exposure import random_gains
from gs2d.training import events
from gs2d.training.cached_objective import CachedViews
from gs2d.training.exposure import Exposures, apply_exposure, exposure_step, uncount
from gs2d.training.objective import clipped_pixels
from gs2d.training.state import TrainState
from gs2d.training.targets import Target
from gs2d.training.trainer import Trainer
from train_toys import SIZE, VIEWS, backends, random_splats, same, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def by(settings: Exposure, iterations: int = 100) -> Recipe:
    return Recipe("one", (replace(surface(), iterations=iterations),), exposure=settings)


def quick() -> Recipe:
    """``short`` with exposures from its third iteration on."""
    return replace(short(), exposure=Exposure(start=2, decay_steps=10))


def exposures(views: int = 3) -> Exposures:
    return Exposures.start(views, torch.zeros(1))


def saved(trainer: Trainer) -> bytes:
    file = io.BytesIO()
    torch.save(trainer.state.state_dict(), file)
    return file.getvalue()


def reload(data: bytes) -> TrainState:
    return TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))


# -- one update ---------------------------------------------------------------------------------------------------
def test_the_mean_of_all_transforms_is_the_identity_and_only_the_view_s_own_numbers_are_written() -> None:
    made = exposures()
    exposure_step(made, 1, torch.ones(3, 4), by(Exposure(rate=0.1, rate_final=0.1, start=0)), 0, 1)
    # Adam's first step is the rate against the sign: theta_1 = -0.1, the mean of three -0.1 / 3.
    assert torch.allclose(made.offsets[1], torch.full((3, 4), -0.1))
    assert not made.offsets[[0, 2]].any()
    assert made.steps == [0, 1, 0]
    assert torch.allclose(made.transforms().mean(dim=0), torch.eye(3, 4), atol=1e-7)
    assert torch.allclose(made.transform(1) - torch.eye(3, 4), torch.full((3, 4), -0.2 / 3))
    assert torch.equal(made.transforms()[2], made.transform(2))


def test_the_rate_decays_over_the_whole_run() -> None:
    settings = Exposure(rate=0.1, rate_final=0.001, decay_steps=100, start=0)
    assert settings.rate_at(50) == pytest.approx(0.01)  # the geometric mean, half way
    assert settings.rate_at(100) == settings.rate_at(500) == pytest.approx(0.001)
    recipe = replace(by(settings, 40), stages=(by(settings, 40).stages[0], replace(refine(), iterations=20)))
    made = exposures()
    exposure_step(made, 0, torch.ones(3, 4), recipe, 1, 10)  # iteration 50 of the run
    assert torch.allclose(made.offsets[0], torch.full((3, 4), -0.01))


def test_nothing_is_learned_or_counted_before_the_start() -> None:
    made, recipe = exposures(), by(Exposure(start=5))
    exposure_step(made, 0, torch.ones(3, 4), recipe, 0, 5)
    uncount(made, 0, recipe, 0, 5)
    assert made.steps == [0, 0, 0]
    assert not made.offsets.any()
    exposure_step(made, 0, torch.ones(3, 4), recipe, 0, 6)
    assert made.steps == [1, 0, 0]
    uncount(made, 0, recipe, 0, 6)
    assert made.steps == [0, 0, 0]


def test_a_cancelled_update_changes_nothing_but_the_count() -> None:
    made, recipe = exposures(), by(Exposure(start=0))
    exposure_step(made, 0, torch.ones(3, 4), recipe, 0, 1)
    before = made.state_dict()
    exposure_step(made, 0, torch.full((3, 4), torch.nan), recipe, 0, 2, lacking(1))
    after = made.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in ("offsets", "mean", "square"))
    exposure_step(made, 0, torch.ones(3, 4), recipe, 0, 2, lacking(0))
    assert not torch.equal(made.offsets, before["offsets"])


class Looks(TorchDispatchMode):
    """Counts the operations for which a host would wait for its device."""

    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.overloadpacket.__name__
        self.count += name in ("_local_scalar_dense", "nonzero", "is_nonzero", "masked_select")
        return function(*args, **(kwargs or {}))


def test_on_a_device_neither_the_transform_nor_its_update_waits() -> None:
    made, recipe, backend = exposures(), by(Exposure(start=0)), lacking(0)
    color, coverage, white = torch.rand(4, 5, 3), torch.rand(4, 5), torch.ones(3)
    with Looks() as looks:
        transform = made.transform(1)
        image, over = _exposed(color, transform, coverage, white, color > 0.5)
        _, gradient = _gradients(image, color, transform, coverage, white, over)
        exposure_step(made, 1, gradient, recipe, 0, 1, backend)
        assert looks.count == 0
        backend.is_whole()  # this is one
    assert looks.count == 1


# -- the loss -----------------------------------------------------------------------------------------------------
def test_the_gradient_of_a_transform_is_that_of_the_whole_loss(scene: Scene) -> None:
    recipe = with_exposure(Recipe("one", (replace(surface(), iterations=5),)))
    trainer = Trainer(scene, recipe, GENERIC, backend="reference", dtype=torch.float64)
    trainer.enter(0)
    state, stage = trainer.state, recipe.stages[0]
    assert state.exposures is not None
    state.exposures.offsets += 0.1 * torch.randn(VIEWS, 3, 4, generator=state.generator, dtype=torch.float64)
    transform = state.exposures.transform(2)

    def loss(change: torch.Tensor) -> float:
        assert state.exposures is not None
        kept = state.exposures.offsets.clone()
        state.exposures.offsets[2] += change * VIEWS / (VIEWS - 1)  # the mean takes its share back
        total = sum(float(value) for value in trainer._whole.evaluate(state, stage, 1, 2).losses.values())
        state.exposures.offsets = kept
        return total

    found = trainer._whole.evaluate(state, stage, 1, 2)
    assert found.losses["exposure"] == pytest.approx(0.001 * float((transform - torch.eye(3, 4)).square().sum()))
    for row, column in ((0, 0), (1, 2), (2, 3)):
        step = torch.zeros(3, 4, dtype=torch.float64)
        step[row, column] = 1e-6
        slope = (loss(step) - loss(-step)) / 2e-6
        assert float(found.gradients["exposure"][row, column]) == pytest.approx(slope, rel=1e-4), (row, column)


def test_exposures_that_stay_where_they_are_change_no_bit_of_the_splats(scene: Scene, backend: str) -> None:
    still = Exposure(rate=1e-30, rate_final=1e-30, eps=1e30, start=0)  # updates underflow
    trainers = [
        Trainer(scene, replace(short(), exposure=exposure), GENERIC, backend=backend) for exposure in (None, still)
    ]
    assert same(*(trainer.run() for trainer in trainers))
    off, on = (trainer.state for trainer in trainers)
    assert "exposures" not in off.state_dict()
    assert on.exposures is not None
    assert not on.exposures.offsets.any()
    assert sum(on.exposures.steps) == 10 + 4 + 5


def test_the_white_behind_a_photograph_with_an_alpha_channel_has_no_exposure(scene: Scene, backend: str) -> None:
    # The photograph is empty and so is the rendering: both are white, whatever the transform, and the loss is 0.
    empty = View.from_arrays("empty", scene.train[0].camera, np.zeros((SIZE, SIZE, 4), np.uint8))
    splats = random_splats(5)
    splats.opacity_logits.fill_(-20.0)
    state = TrainState(splats, torch.Generator().manual_seed(0))
    state.exposures = Exposures.start(2, splats.means)
    state.exposures.offsets[0] = -0.5
    views = replace(scene, train=(empty, scene.train[1]))
    trainer = Trainer(views, by(Exposure()), NERF_SYNTHETIC, backend=backend, state=state)
    trainer.enter(0)
    found = trainer._whole.evaluate(state, trainer.recipe.stages[0], 1, 0)
    assert found.losses["l1"] == pytest.approx(0, abs=1e-6)
    assert found.losses["exposure"] > 0


def test_pixels_at_the_ceiling_are_clipped_but_not_the_white_behind_a_photograph() -> None:
    image = torch.tensor([[[1.0, 0.9, 1.0], [1.0, 1.0, 1.0]]])
    assert clipped_pixels(Target(image, None, None)).tolist() == [[[True, False, True], [True, True, True]]]
    cut_out = Target(image, None, None, silhouette=torch.tensor([[0.5, 0.0]]))
    assert clipped_pixels(cut_out).tolist() == [[[True, False, True], [False, False, False]]]


def test_errors_are_ranked_in_the_exposure_of_the_photograph(scene: Scene, backend: str) -> None:
    # |A c - A P| with A = I / 2 is half of |c - P|.
    splats, view = random_splats(40, seed=1), scene.train[0]
    image, settings = torch.from_numpy(view.target((0.0, 0.0, 0.0))), RasterSettings()
    plain = splat_errors(splats, view.camera, image, settings, backend=backend)
    dim, changed = apply_exposure(splats, view.camera, 0.5 * torch.eye(3, 4), settings)
    assert torch.allclose(
        splat_errors(dim, view.camera, image / 2, changed, backend=backend), plain / 2, rtol=1e-4, atol=1e-4
    )
    assert plain.max() > 1


@needs_cpu
def test_cached_views_have_the_losses_and_gradients_of_the_plain_path(scene: Scene) -> None:
    recipe = Recipe("colors", (replace(appearance(k=20.0), iterations=3 * VIEWS),), exposure=Exposure())
    state = TrainState(random_splats(90, seed=5), torch.Generator().manual_seed(0))
    state.exposures = Exposures.start(VIEWS, state.splats.means)
    state.exposures.offsets += 0.1 * torch.randn(VIEWS, 3, 4, generator=state.generator)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=state)
    trainer.enter(0)
    cached = CachedViews(trainer._whole, state, recipe.stages[0], 1 << 30)
    assert len(cached.views) == VIEWS
    for index in range(VIEWS):
        a, b = (e.evaluate(state, recipe.stages[0], 1, index) for e in (cached, trainer._whole))
        assert a.losses == pytest.approx(b.losses, rel=1e-6)
        assert torch.allclose(a.gradients["exposure"], b.gradients["exposure"], rtol=1e-4, atol=1e-7)
        assert torch.allclose(a.gradients["sh0"], b.gradients["sh0"][cached.rows], rtol=1e-4, atol=1e-8)


# -- resuming -----------------------------------------------------------------------------------------------------
def test_resuming_from_any_event_gives_the_same_splats_and_exposures(scene: Scene) -> None:
    recipe, backend = quick(), backends()[-1]
    kept: list[bytes] = []
    trainer = Trainer(
        scene, recipe, GENERIC, backend=backend, progress_every=1, on_event=lambda _: kept.append(saved(trainer))
    )
    end = trainer.run()
    assert trainer.state.exposures is not None
    found = trainer.state.exposures.transforms()
    assert (found - torch.eye(3, 4)).abs().max() > 0.005
    for data in kept[:: 1 if backend == "cpu" else 5]:
        resumed = Trainer(scene, recipe, GENERIC, backend=backend, state=reload(data))
        assert same(resumed.run(), end)
        assert resumed.state.exposures is not None
        assert torch.equal(resumed.state.exposures.transforms(), found)
        assert resumed.state.exposures.steps == trainer.state.exposures.steps


def test_bytes_do_not_depend_on_the_number_of_threads(scene: Scene) -> None:
    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        trainer = Trainer(scene, quick(), GENERIC, backend=backends()[-1])
        ends.append((trainer.run(), trainer.state.exposures.transforms()))  # type: ignore[union-attr]
    assert same(ends[0][0], ends[1][0])
    assert torch.equal(ends[0][1], ends[1][1])


def test_a_state_with_the_exposures_of_other_views_or_none_is_refused(scene: Scene) -> None:
    state = TrainState(random_splats(5), torch.Generator())
    with pytest.raises(RunError, match="exposures of 6 views, as recipe and scene say, got 0"):
        Trainer(scene, quick(), GENERIC, backend="reference", state=state)
    state.exposures = exposures(4)
    with pytest.raises(RunError, match="exposures of 6 views, as recipe and scene say, got 4"):
        Trainer(scene, quick(), GENERIC, backend="reference", state=state)
    with pytest.raises(RunError, match="exposures of 0 views, as recipe and scene say, got 4"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)


# -- what it is worth ---------------------------------------------------------------------------------------------
TRAIN, TEST = 16, 4


def image(truth: Splats, camera: Camera, gain: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        color = rasterize(truth, camera, RasterSettings(), backend="reference").color.numpy()
    return np.rint(255 * np.clip(color * gain, 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def varied() -> tuple[Scene, Splats, np.ndarray]:
    """Matt splats in 16 photographs of random gains, whose mean is 1, and 4 test photographs of gain 1; the gains."""
    truth = random_splats(80, seed=3)
    truth.shN.zero_()
    truth.sh0.mul_(0.5)  # nothing near white, where photographs clip
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
def test_the_gains_are_found_and_new_views_gain_by_it(varied: tuple[Scene, Splats, np.ndarray]) -> None:
    scene, truth, gains = varied
    stage = replace(surface(), iterations=480, densify=None, sh_interval=50, lr=LearningRates(means_decay_steps=480))
    plain = Recipe("plain", (stage,))
    scores, grey = [], np.empty(0)
    for recipe in (plain, replace(plain, exposure=Exposure(decay_steps=480, start=0))):
        state = TrainState(truth.clone(), torch.Generator().manual_seed(0))
        state.exposures = Exposures.start(TRAIN, state.splats.means) if recipe.exposure else None
        trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=state)
        scores.append(held_out_psnr(scene, trainer))
        if state.exposures is not None:
            transforms = state.exposures.transforms().numpy()
            grey = (0.5 * transforms[:, :, :3].sum(axis=2) + transforms[:, :, 3]) / 0.5  # what a middle grey becomes
    errors = np.abs(grey / gains - 1)  # the gains are 13 % from 1 in the mean
    assert scores[1] > scores[0] + 8  # measured: 36.4 and 50.1 dB
    assert errors.mean() < 0.012  # measured: 0.006
    assert errors.max() < 0.04  # measured: 0.022


def held_out_psnr(scene: Scene, trainer: Trainer) -> float:
    """PSNR of the test photographs as they are: nothing is fitted to them."""
    splats, errors = trainer.run(), []
    for view in scene.test:
        with torch.no_grad():
            color = rasterize(splats, view.camera, trainer.settings, backend="cpu").color
        target = torch.from_numpy(view.target(GENERIC.background))
        errors.append(float((color.clamp(0, 1) - target).square().mean()))
    return float(-10 * np.log10(np.mean(errors)))


def test_the_events_name_the_prior_among_the_losses(scene: Scene) -> None:
    seen: list[events.Progress] = []

    def listen(event: events.Event) -> None:
        if isinstance(event, events.Progress):
            seen.append(event)

    recipe = Recipe("one", (replace(refine(), iterations=2, on_enter=()),), exposure=Exposure(start=0))
    Trainer(scene, recipe, GENERIC, backend="reference", on_event=listen, progress_every=1).run()
    assert [event.losses["exposure"] > 0 for event in seen] == [False, True]  # identities first
    assert seen[1].loss == pytest.approx(sum(seen[1].losses.values()))
