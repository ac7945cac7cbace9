"""Fused iterations (kernels only) are bit-identical to iterations through torch, as launches and as a graph."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.gpu.host import OperationCount, iterations_by

import fake_driver
import train_toys
from emulate import Emulator
from fake_backends import cuda_on_host
from fake_driver import FakeDriver, Result
from gs2d.config.protocols import GENERIC, Protocol
from gs2d.config.quantities import POSES
from gs2d.config.recipe import GradDensify, LossTerm, Recipe
from gs2d.data.scene import Scene, View
from gs2d.errors import BackendError
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.launch import GpuLauncher, Launcher
from gs2d.render import cuda_step, cuda_works, pair_budget
from gs2d.training import objective as views
from gs2d.training import targets
from gs2d.training import trainer as loop
from gs2d.training.densify.gradient import GradientDensifier
from gs2d.training.trainer import Trainer, TrainerOptions


@pytest.fixture(scope="module")
def scene() -> Scene:
    return train_toys.make_scene()


@contextmanager
def mode(chosen: str, launcher: Launcher) -> Iterator[list[bool]]:
    """Train on an asynchronous device with one kind of iteration; yields whether each iteration was fused."""
    done: list[bool] = []
    run = cuda_step.Stepper.run

    def recorded(self: Any, *given: Any) -> bool:
        done.append(run(self, *given))
        return done[-1]

    with pytest.MonkeyPatch.context() as patch, iterations_by(chosen):
        patch.setattr(launch, "launcher_for", lambda device: launcher)
        patch.setattr(loop, "is_async", lambda device: True)
        patch.setattr(views, "is_async", lambda device: True)
        patch.setattr(targets, "is_async", lambda device: True)
        patch.setattr(cuda_step.Stepper, "run", recorded)
        yield done


def trained(
    launcher: Launcher, scene: Scene, recipe: Recipe, chosen: str, protocol: Protocol = GENERIC, **options: Any
) -> tuple[Trainer, int]:
    """Train; return the trainer and the number of fused iterations."""
    with mode(chosen, launcher) as done:
        trainer = Trainer(
            scene, recipe, protocol, **train_toys.grouped({"backend": cuda_on_host(), "progress_every": 100, **options})
        )
        trainer.run()
    return trainer, sum(done)


def same(a: Trainer, b: Trainer) -> bool:
    """Return whether splats and Adam moments are bit-identical."""
    assert {name: m.steps for name, m in a.state.moments.items()} == {k: m.steps for k, m in b.state.moments.items()}
    pairs = [(m.square, b.state.moments[name].square) for name, m in a.state.moments.items()]
    return train_toys.same(a.splats, b.splats) and all(torch.equal(x, y) for x, y in pairs)


def masked(scene: Scene) -> Scene:
    """Return the scene with masks, and with alpha in every other image."""
    rng, views = np.random.default_rng(1), []
    for number, view in enumerate(scene.train):
        image = view.image()
        alpha = rng.integers(0, 256, (*image.shape[:2], 1), dtype=np.uint8)
        pixels = np.concatenate([image, alpha], axis=2) if number % 2 else image
        views.append(View.from_arrays(view.name, view.camera, pixels, rng.uniform(size=image.shape[:2]) < 0.7))
    return replace(scene, train=tuple(views))


def two_sizes(scene: Scene) -> Scene:
    """Return the scene with half as many rows in every third image."""
    small = []
    for number, view in enumerate(scene.train):
        camera = view.camera if number % 3 else view.camera.resized(view.camera.width, view.camera.height // 2)
        image = view.image() if number % 3 else np.ascontiguousarray(view.image()[::2])
        small.append(View.from_arrays(view.name, camera, image))
    return replace(scene, train=tuple(small))


def with_options(recipe: Recipe, **options: str | float) -> Recipe:
    """Return the recipe with these options of normal consistency."""
    stages = []
    for stage in recipe.stages:
        terms = (replace(t, options=options) if t.kind.startswith("normal") else t for t in stage.losses)
        stages.append(replace(stage, losses=tuple(terms)))
    return replace(recipe, stages=tuple(stages))


def at_camera(recipe: Recipe) -> Recipe:
    """Return the recipe with normals from depth as in the official code."""
    return with_options(recipe, edges="camera")


def of_object(recipe: Recipe) -> Recipe:
    """Return the recipe with normal consistency only on the object, as in ``best``."""
    return with_options(recipe, where="object")


def with_silhouettes(recipe: Recipe) -> Recipe:
    """Return the recipe with the silhouette loss for images with alpha, as in ``best``."""
    return with_term(recipe, LossTerm("silhouette", 0.1, options={"required": False}))


def with_squares(recipe: Recipe) -> Recipe:
    """Return the recipe with a squared loss after the first iterations, as in ``best``."""
    return with_term(recipe, LossTerm("l2", 10.0, start=3))


def with_smooth_normals(recipe: Recipe) -> Recipe:
    """Return the recipe with normal smoothness beside normal consistency, as in ``best``."""
    flat, stages = with_options(recipe, where="object", flat=3.0), []
    for stage in flat.stages:
        added = [LossTerm("normal_smoothness", 0.8, t.start) for t in stage.losses if t.kind == "normal_consistency"]
        stages.append(replace(stage, losses=(*stage.losses, *added)))
    return replace(flat, stages=tuple(stages))


def with_term(recipe: Recipe, term: LossTerm) -> Recipe:
    """Return the recipe with an additional term in all stages."""
    return replace(recipe, stages=tuple(replace(stage, losses=(*stage.losses, term)) for stage in recipe.stages))


QUIET = GradDensify(every=100, start=500, stop=900, reset_every=0, opacity_cull=0.005)


def brief(recipe: Recipe | None = None) -> Recipe:
    """Return eight iterations of the first stage, six of them without an observer."""
    recipe = recipe or train_toys.short()
    return replace(recipe, stages=(replace(recipe.stages[0], iterations=8, densify=QUIET),))


VARIANTS = {
    "plain": (lambda scene: scene, train_toys.short(), GENERIC),
    "absolute": (two_sizes, train_toys.short(absgs=True), replace(GENERIC, depth="median")),
    "object": (masked, of_object(train_toys.short()), replace(GENERIC, depth="median")),
    "flat": (masked, with_options(train_toys.short(), where="object", flat=6.0), GENERIC),
    "flat, opaque": (lambda scene: scene, with_options(train_toys.short(), where="object", flat=6.0), GENERIC),
    "smooth": (masked, with_smooth_normals(train_toys.short()), GENERIC),
    "silhouettes": (masked, with_silhouettes(of_object(train_toys.short())), GENERIC),
    "squares": (masked, with_squares(train_toys.short()), GENERIC),
    "masks": (masked, at_camera(train_toys.short()), replace(GENERIC, background=(0.2, 1.0, 0.7))),
}


@pytest.mark.slow
@pytest.mark.parametrize("variant", list(VARIANTS))
def test_three_stages_have_the_bits_of_training_through_torch(emulator: Emulator, scene: Scene, variant: str) -> None:
    """Includes densification, reset, ranking and cloning, whose statistics a kernel gathers."""
    change, recipe, protocol = VARIANTS[variant]
    given = emulator, change(scene), recipe
    parts, none = trained(*given, "torch", protocol)
    whole, some = trained(*given, "launches", protocol)
    assert none == 0
    assert some >= 10  # of 19: not densifying iterations, last ones, or the first of a resolution
    assert same(parts, whole)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 11])
def test_reused_memory_and_the_order_of_threads_change_nothing(
    emulator: Emulator, scene: Scene, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory not guaranteed to be zero is NaN or -1 at the start of an iteration; sums are zero at its end."""
    checked = Counter[str]()
    run = cuda_step.Stepper.run

    def poisoned(self: Any, *given: Any) -> bool:
        held = self._arena._tensors
        for name, tensor in held.items():
            if name not in ("gradient_rows", "extras"):
                tensor.view(torch.int16).fill_(-1)
        done = run(self, *given)
        for name in held.keys() & {"gradient_rows", "extras"}:  # stages that train only colours have no gradient rows
            if done:
                assert not held[name].any()
                checked[name] += 1
        return done

    monkeypatch.setattr(cuda_step.Stepper, "run", poisoned)
    shuffled = Emulator(seed=seed)
    parts, _ = trained(shuffled, scene, train_toys.short(), "torch")
    whole, some = trained(shuffled, scene, train_toys.short(), "launches")
    assert some == checked["extras"] >= 11
    for (name, a), (_, b) in zip(parts.splats.items(), whole.splats.items(), strict=True):
        assert float((a - b).norm()) <= 1e-3 * float(a.norm()), name  # atomics add in another order


def test_an_iteration_without_room_for_its_pairs_changes_nothing_and_is_repeated(
    emulator: Emulator, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = brief()
    plain, _ = trained(emulator, scene, recipe, "launches")
    for name in ("SLACK", "VIEW_SLACK"):
        monkeypatch.setattr(pair_budget, name, 0.5)
    monkeypatch.setattr(pair_budget, "STEP", 1)
    short, some = trained(emulator, scene, recipe, "launches")
    assert some >= 4
    assert same(plain, short)


def on_gpu(driver: FakeDriver) -> GpuLauncher:
    return fake_driver.launcher(driver)


@pytest.mark.parametrize("stages", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_repeated_iteration_is_a_graph_with_the_same_bits(emulator: Emulator, scene: Scene, stages: int) -> None:
    """Rows are added; cameras, learning rates and capacities change: the graph is updated where they differ."""
    recipe = brief() if stages == 1 else train_toys.short()
    plain, some = trained(emulator, scene, recipe, "launches")
    driver = FakeDriver(emulator=emulator)
    replayed, as_many = trained(on_gpu(driver), scene, recipe, "graph")
    assert some == as_many
    assert same(plain, replayed)
    assert len(driver.replays) >= 6  # two per iteration, from the third on
    assert driver.changes > 0
    launched = Counter(done.kernel for done in driver.launches)
    assert 0 < launched["running_counts"] < some  # until a graph was used


def test_a_driver_without_graphs_launches_one_by_one(emulator: Emulator, scene: Scene) -> None:
    """Other failures: tests/kernels/cuda/test_launch.py."""
    plain, some = trained(emulator, scene, brief(), "launches")
    driver = FakeDriver(emulator=emulator, failing={"cuGraphExecKernelNodeSetParams": Result.CUDA_ERROR_NOT_SUPPORTED})
    found, as_many = trained(on_gpu(driver), scene, brief(), "graph")
    assert same(plain, found)
    assert some == as_many
    assert len(driver.replays) <= 2  # each half once, if the failure comes afterwards


def test_an_unknown_step_mode_is_an_error_of_one_line(scene: Scene, emulator: Emulator) -> None:
    with pytest.raises(BackendError, match="GS2D_CUDA_STEP must be graph or launches, got 'fast'; unset it"):
        trained(emulator, scene, brief(), "fast")


class OfItsOwn(GradientDensifier):
    """Observes every iteration itself."""

    seen = 0

    def after_backward(self, state: Any, output: Any, iteration: int) -> Any:
        type(self).seen += output is not None
        return super().after_backward(state, output, iteration)


def test_learned_cameras_and_custom_densifiers_train_through_torch(
    emulator: Emulator, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = train_toys.short()
    short = replace(recipe, stages=(replace(recipe.stages[0], iterations=5),))
    assert trained(emulator, scene, short, "launches")[1] == 2  # 1 and 3 are observed, 5 is the last
    posed = short.with_learned(replace(POSES, start=2, decay_steps=10))
    assert trained(emulator, scene, posed, "launches")[1] == 0
    made = loop.densifier_of
    monkeypatch.setattr(
        loop,
        "densifier_of",
        lambda given, around: None if made(given, around) is None else OfItsOwn(around, **vars(given)),
    )
    assert trained(emulator, scene, short, "launches")[1] == 0
    assert OfItsOwn.seen == 5


@pytest.mark.parametrize("case", ["object", "squares", "silhouettes", "in the host's memory", "long lists"])
def test_an_iteration_by_kernels_has_the_bits_of_an_iteration_through_torch(
    emulator: Emulator, scene: Scene, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With images in host memory, if they do not fit on the device."""
    recipe, given, count = brief(), scene, 6
    if case == "object":
        recipe, given = of_object(recipe), masked(scene)
    elif case == "squares":
        recipe = with_squares(recipe)
    elif case == "silhouettes":
        recipe, given = with_silhouettes(of_object(recipe)), masked(scene)
    elif case == "long lists":
        monkeypatch.setattr(cuda_works, "SHORTEST_PIECE", 8)  # lists from 16 entries on are cut
    else:
        monkeypatch.setattr(targets, "DEVICE_BYTES", 0)
    parts, _ = trained(emulator, given, recipe, "torch")
    whole, some = trained(emulator, given, recipe, "launches")
    assert some == count
    assert same(parts, whole)


def test_an_iteration_uses_no_torch_operations(emulator: Emulator, scene: Scene) -> None:
    """No operations and no allocations, except shuffling the views once per epoch."""
    recipe = of_object(brief())
    first = replace(recipe.stages[0], iterations=200)
    with mode("launches", emulator) as done:
        trainer = Trainer(
            scene,
            replace(recipe, stages=(first,)),
            GENERIC,
            backend=cuda_on_host(),
            options=TrainerOptions(progress_every=1000),
        )
        trainer.enter(0)
        for _ in range(7):
            trainer.step()
        before = sum(done)
        with OperationCount() as count:
            for _ in range(6):
                trainer.step()
    assert sum(done) - before == 6
    assert set(count.names) <= {"randperm", "detach"}, count.names  # detach: the number of pairs, in host memory


def test_a_byte_converts_to_the_same_number_as_by_division(emulator: Emulator) -> None:
    """A row of all 256 values against a float target has an L1 of exactly 0."""
    from gs2d.kernels.cuda.cuda_losses import strips
    from gs2d.kernels.cuda.kernel_arguments import work_of

    width = 86  # 258 reals
    values = torch.arange(3 * width) % 256
    rendered = (values.to(torch.float32) / 255).view(1, width, 3).contiguous()
    partials = torch.full((4, strips(1, width)), torch.nan)  # valid reals, L1, SSIM, L2
    pixels, size = values.to(torch.uint8), {"height": 1, "width": width}
    work = work_of("photometric_forward_rgb", strips(1, width), size, rendered=rendered, partials=partials)
    work.arguments.photograph.bytes = pixels.data_ptr()
    emulator.run([work])
    assert float(partials[1].sum()) == 0
    assert float(partials[0].sum()) == 3 * width


assert not os.environ.get(launch.STEP_VARIABLE), "the tests choose how iterations are done"
