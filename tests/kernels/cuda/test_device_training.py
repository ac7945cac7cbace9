"""Training with the emulated cuda backend equals the CPU's result up to rounding, and never blocks the host.

Tensors are in host memory, so would-be GPU copies and synchronisations are counted by operation: reading a value,
finding the rows that are True, or making a tensor from Python numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import train_toys
from emulate import Emulator
from fake_backends import altered, cuda_on_host
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import EXPOSURE, POSES
from gs2d.config.recipe import GradDensify, LossTerm, Recipe
from gs2d.data.scene import Scene, View
from gs2d.errors import BackendError
from gs2d.kernels.cuda import launch
from gs2d.render import cuda_passes
from gs2d.render import pair_budget as cuda_budget
from gs2d.render.backends import Backend, get_backend
from gs2d.render.pair_budget import Rendering
from gs2d.render.types import RasterSettings
from gs2d.training import events, targets
from gs2d.training import objective as views
from gs2d.training import trainer as loop
from gs2d.training.targets import DeviceTargets, Targets
from gs2d.training.trainer import Trainer, TrainerOptions
from render_scenes import front_camera, splat, stack


@pytest.fixture
def emulated(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> Backend:
    """Return the cuda backend with the emulator in place of the GPU."""
    monkeypatch.setattr(launch, "launcher_for", lambda device: emulator)
    return cuda_on_host()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return train_toys.make_scene()


def cpu_backend() -> Backend:
    try:
        return get_backend("cpu")
    except BackendError as error:
        pytest.skip(str(error))


GROWS = GradDensify(every=3, start=1, stop=10, reset_every=0, opacity_cull=0.005, max_splats=75, absolute=True)


def in_first_stage(**fields: Any) -> Recipe:
    recipe = train_toys.short()
    return replace(recipe, stages=(replace(recipe.stages[0], **fields), *recipe.stages[1:]))


VARIANTS = {
    "plain": train_toys.short(),
    "exposure": train_toys.short().with_learned(replace(EXPOSURE, start=2, decay_steps=10)),
    "poses": train_toys.short().with_learned(replace(POSES, start=2, decay_steps=10)),
    "distortion": in_first_stage(losses=(*train_toys.short().stages[0].losses, LossTerm("distortion", 10.0))),
}


@pytest.mark.parametrize(
    "variant",
    ["plain", "poses", *(pytest.param(v, marks=pytest.mark.slow) for v in VARIANTS if v not in ("plain", "poses"))],
)
def test_three_stages_give_the_cpu_backends_scene_within_rounding(
    emulated: Backend, scene: Scene, variant: str
) -> None:
    """19 iterations with densification, a reset, ranking, a clone and frozen rows; decisions and counts are equal."""
    recipe = VARIANTS[variant]
    results = [
        train_toys.train(scene, recipe, backend=backend, stage2_cache_bytes=0) for backend in (cpu_backend(), emulated)
    ]
    (cpu, on_cpu), (gpu, on_gpu) = results
    counts = [[(type(e).__name__, getattr(e, "splats", None)) for e in r.events] for r in (on_cpu, on_gpu)]
    assert counts[0] == counts[1]
    losses = [[e.loss for e in r.events if isinstance(e, events.Progress)] for r in (on_cpu, on_gpu)]
    assert losses[0] == pytest.approx(losses[1], rel=2e-3)
    for (name, a), (_, b) in zip(cpu.splats.items(), gpu.splats.items(), strict=True):
        assert float((a - b).norm()) <= 5e-3 * float(a.norm()), name
    moved = gpu.splats.means - on_gpu.splats[0].means[:1]
    assert float(moved.abs().max()) > 0


WAITS = {
    "_local_scalar_dense": "a value is read",
    "nonzero": "the number of True rows is read",
    "masked_select": "the number of True rows is read",
    "equal": "a value is read",
    "_unique2": "the number of values is read",
}


class TrainingObserver(TorchDispatchMode):
    """Counts operations that make the host wait for a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in WAITS:
            self.seen[name] += 1
        indexing = name in ("index", "index_put", "index_put_")
        if indexing and any(i is not None and i.dtype == torch.bool for i in args[1]):
            self.seen["index by a mask"] += 1
        return func(*args, **(kwargs or {}))


@contextmanager
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[Counter[str]]:
    """Record synchronising operations and tensors made from Python numbers (a blocking copy)."""
    with monkeypatch.context() as patch, TrainingObserver() as watch:
        for where, name in ((torch, "tensor"), (torch, "as_tensor"), (torch.Tensor, "new_tensor")):
            original = getattr(where, name)

            def recording(*args: Any, _original: Any = original, _name: str = name, **kwargs: Any) -> Any:
                if str(kwargs.get("device", "")) != "cpu":  # explicitly on the host
                    watch.seen[_name] += 1
                return _original(*args, **kwargs)

            patch.setattr(where, name, recording)
        yield watch.seen


def in_stage(trainer: Trainer, stage: int) -> None:
    while trainer.state.stage < stage or not trainer.state.entered:
        if not trainer.state.entered:
            trainer.enter(trainer.state.stage)
            continue
        finished = trainer.recipe.stages[trainer.state.stage]
        while trainer.state.step < finished.iterations:
            trainer.step()
        trainer._finish(finished)


def quiet(recipe: Recipe) -> Recipe:
    """Return the recipe without densification or resets in the observed iterations."""
    first = recipe.stages[0]
    assert first.densify is not None
    densify = replace(first.densify, start=1000, stop=2000, reset_every=0)
    longer = [replace(stage, iterations=100) for stage in (replace(first, densify=densify), *recipe.stages[1:])]
    return replace(recipe, stages=(longer[0], *recipe.stages[1:]))


@pytest.mark.parametrize(("stage", "variant"), [(0, "plain"), (0, "distortion"), (1, "plain"), (2, "plain")])
def test_an_iteration_waits_for_nothing_once_it_knows_how_many_pairs_to_expect(
    emulated: Backend, scene: Scene, stage: int, variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = quiet(VARIANTS[variant]) if stage == 0 else VARIANTS[variant]
    monkeypatch.setattr(loop, "is_async", lambda device: True)
    monkeypatch.setattr(views, "is_async", lambda device: True)
    monkeypatch.setattr(targets, "is_async", lambda device: True)
    trainer = Trainer(scene, recipe, GENERIC, backend=emulated, options=TrainerOptions(progress_every=1000))
    in_stage(trainer, stage)
    trainer.step()
    for index in range(len(scene.train)):
        trainer._whole.targets[index]  # every image is loaded
    with watched(monkeypatch) as seen:
        trainer.step()
        trainer.step()
    through_torch = stage == 0 and variant != "plain"
    looks_at_probe = {"_local_scalar_dense": 2} if through_torch else {}  # these tensors are in host memory
    assert dict(seen) == looks_at_probe


def test_a_loss_that_is_not_finite_stops_training_at_the_next_report(
    emulated: Backend, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.errors import DivergedError

    monkeypatch.setattr(loop, "is_async", lambda device: True)
    monkeypatch.setattr(views, "is_async", lambda device: True)
    monkeypatch.setattr(targets, "is_async", lambda device: True)
    trainer = Trainer(scene, train_toys.short(), GENERIC, backend=emulated, options=TrainerOptions(progress_every=2))
    trainer.enter(0)
    trainer.step()
    trainer.state.splats.sh0[3] = float("nan")
    with pytest.raises(DivergedError, match="iteration"):
        trainer.step()


@pytest.mark.parametrize(("slack", "variant"), [(1.25, "plain"), (0.5, "distortion")])
def test_without_waiting_for_the_number_of_pairs_training_gives_the_same_bits(
    emulated: Backend, scene: Scene, slack: float, variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With capacity for half of the pairs, truncated iterations change nothing and are repeated."""
    recipe = VARIANTS[variant]
    kept = train_toys.train(scene, recipe, backend=altered(emulated, for_training=lambda: emulated))[0]
    monkeypatch.setattr(cuda_budget, "SLACK", slack)
    monkeypatch.setattr(cuda_budget, "VIEW_SLACK", slack)
    monkeypatch.setattr(cuda_budget, "STEP", 1)
    outcomes = []
    settle = cuda_budget.PairBudget.overflowed
    monkeypatch.setattr(
        cuda_budget.PairBudget, "overflowed", lambda self: outcomes.append(settle(self)) or outcomes[-1]
    )
    trainer = Trainer(scene, recipe, GENERIC, backend=emulated, options=TrainerOptions(progress_every=5))
    trainer.run()
    assert any(outcomes) == (slack < 1)
    assert train_toys.same(kept.splats, trainer.splats)
    assert {k: m.steps for k, m in kept.state.moments.items()} == {k: m.steps for k, m in trainer.state.moments.items()}


def test_unused_room_is_empty_and_too_little_room_sets_overflow(
    emulator: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last splat by depth is at the top: unused entries would be counted in the tiles below it.

    Culling inside tiles is disabled because it would hide them.
    """
    monkeypatch.setattr(cuda_budget, "STEP", 1)
    camera = front_camera(40, 200)
    scene = stack(splat((0.1, 0.0, 2.0), (0.8, 0.8)), splat((0.0, -25.0, 3.0), (0.8, 0.3)))
    view = cuda_passes.view_of(camera, RasterSettings(sh_degree=0))
    parameters = dict(scene.items())
    budget = cuda_budget.PairBudget()
    exact = cuda_passes.forward(emulator, view, parameters, exact=False, budget=budget)
    assert budget.overflow is None
    assert not budget.overflowed()
    pairs = len(exact.entries)
    assert pairs > 6
    for slack, short in ((3.0, False), (0.5, True)):
        monkeypatch.setattr(cuda_budget, "VIEW_SLACK", slack)
        frame = cuda_passes.forward(emulator, view, parameters, exact=False, budget=budget)
        assert len(frame.entries) == int(slack * pairs)
        assert bool(budget.overflow) == short
        assert budget.overflowed() == short
        assert not budget.overflowed()  # reading it resets it
        same = [torch.equal(frame.images[name], exact.images[name]) for name in ("color", "alpha", "depth_median")]
        assert all(same) != short
        if not short:
            assert torch.equal(frame.ranges[:-1], exact.ranges[:-1])


def test_room_follows_the_number_of_pairs_up_at_once_and_down_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """All capacity is sorted, used or not: large initial splats must not slow down the rest of a run."""
    monkeypatch.setattr(cuda_budget, "STEP", 1)
    budget, size = cuda_budget.PairBudget(), Rendering(7)
    budget.learn(size, 1_000_000)
    assert budget.room(size) == 1_250_000
    budget.learn(size, 100_000)
    assert budget.room(size) == 1_248_779  # 1.25 * 1e6 * 1023 / 1024, rounded down to whole pairs
    for _ in range(10_000):
        budget.learn(size, 100_000)
    assert budget.room(size) == 125_000
    budget.learn(size, cuda_budget.MAX_PAIRS)
    assert budget.room(size) == cuda_budget.MAX_PAIRS  # 1.25 times as many would overflow the index


def test_each_view_has_room_for_its_own_pairs_and_for_splats_that_were_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """A common capacity for views that differ by a factor of 3 would sort 3.75 times as many pairs as exist."""
    monkeypatch.setattr(cuda_budget, "STEP", 1)
    budget = cuda_budget.PairBudget()
    small, large = (Rendering(7, 1000, name) for name in (b"small", b"large"))
    budget.learn(small, 300_000)
    budget.learn(large, 900_000)
    assert budget.room(small) == pytest.approx(330_000, abs=1)
    assert budget.room(large) == pytest.approx(990_000, abs=1)
    assert budget.room(Rendering(7, 1000, b"new")) == 1_125_000
    assert budget.room(small._replace(splats=2000)) == pytest.approx(660_000, abs=1)
    assert budget.room(small._replace(splats=500)) == pytest.approx(
        330_000, abs=1
    )  # pruned splats are faint and have few pairs
    budget.learn(small, 200_000)
    assert budget.room(small) == pytest.approx(220_000, abs=1)


def test_a_fault_that_a_kernel_left_is_one_line_with_a_remedy_where_torch_meets_it() -> None:
    class Broken:
        def synchronize(self) -> None:
            raise RuntimeError("CUDA error: an illegal memory access was encountered\nCUDA kernel errors might be ...")

    budget = cuda_budget.PairBudget()
    budget.learn(Rendering(7), 10)
    budget.fetch(Rendering(7), 20, torch.tensor(5))
    budget._event = Broken()
    with pytest.raises(BackendError, match="illegal") as error:
        budget.overflowed()
    assert "\n" not in str(error.value)


def image_scene() -> tuple[View, ...]:
    """Return four views of 6 x 4 px: opaque, with alpha, with a mask, opaque."""
    rng = np.random.default_rng(0)
    camera = front_camera(6, 4)
    images = [rng.integers(0, 256, (4, 6, channels), dtype=np.uint8) for channels in (3, 4, 3, 3)]
    mask = rng.uniform(size=(4, 6)) < 0.5
    masks = (None, None, mask, None)
    return tuple(
        View.from_arrays(str(i), camera, image, m) for i, (image, m) in enumerate(zip(images, masks, strict=True))
    )


def test_images_are_stored_as_bytes_and_convert_to_the_targets_of_the_cpu() -> None:
    """72 bytes opaque, 96 with alpha, 96 with a mask: the first two use 168 of the 170 bytes on the device.

    Pinned, the third takes 128 + 32 bytes.
    """
    scene_views, pinned = image_scene(), []

    def pin(tensor: Tensor) -> Tensor:
        pinned.append(tensor.nbytes)
        return tensor.clone()

    background = (0.25, 0.5, 1.0)
    options: dict[str, Any] = {"use_masks": True, "device": torch.device("cpu")}
    targets = DeviceTargets(scene_views, background, **options, limit_bytes=170, pinned_bytes=160, pin=pin)
    plain = Targets(scene_views, background, use_masks=True)
    for _ in range(2):
        for index in range(4):
            target, expected = targets[index], plain[index]
            assert torch.allclose(target.image, expected.image, rtol=0, atol=2e-7)
            assert (target.mask is None) == (expected.mask is None)
            assert target.mask is None or torch.equal(target.mask, expected.mask)  # type: ignore[arg-type]
    assert pinned == [72, 24]  # the third view's image and mask; the fourth does not fit and is read each time
    assert sorted(targets._cached) == [0, 1, 2]


def test_a_state_on_a_device_is_saved_in_host_memory_and_moves_completely() -> None:
    state = train_toys.full_state()
    state.move_to("meta")
    tensors = [t for _, t in state.splats.items()] + [m.mean for m in state.moments.values()]
    tensors += [m.square for m in state.moments.values()] + [*state.groups.values(), *state.statistics.values()]
    assert {tensor.device.type for tensor in tensors} == {"meta"}
    assert state.generator.device.type == "cpu"
