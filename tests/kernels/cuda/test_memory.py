"""Uninitialised memory is never read: on a GPU it holds the values of earlier tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from torch import Tensor

import train_toys
from emulate import Emulator
from fake_backends import cuda_on_host
from gs2d.kernels.cuda import launch
from gs2d.render.cuda_backend import CudaBackend
from kernel_cases import SETTINGS, many_tiles
from render_scenes import IMAGES, contraction, random_cotangents, requiring_grad


@contextmanager
def fresh_memory(*, poisoned: bool) -> Iterator[None]:
    """Make ``torch.empty`` and similar return NaN and the largest integers, or arbitrary values."""
    before = torch.utils.deterministic.fill_uninitialized_memory  # type: ignore[attr-defined]
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = poisoned  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.utils.deterministic.fill_uninitialized_memory = before  # type: ignore[attr-defined]
        torch.use_deterministic_algorithms(False)


def unchanged_by_poison(work: Callable[[], list[Tensor]]) -> int:
    """Run ``work`` with and without poisoned memory; return the number of its tensors."""
    with fresh_memory(poisoned=False):
        plain = work()
    with fresh_memory(poisoned=True):
        assert bool(torch.empty(3).isnan().all())
        assert torch.zeros(2, dtype=torch.int16).new_empty(1).item() == 32767
        found = work()
    assert all(torch.equal(a, b) for a, b in zip(plain, found, strict=True))
    return len(found)


@pytest.mark.parametrize("deterministic", [False, True])
def test_no_pass_of_the_rasterizer_reads_uninitialised_memory(emulator: Emulator, deterministic: bool) -> None:
    case = many_tiles()
    cotangents = random_cotangents(np.random.default_rng(1), case.camera)
    image = torch.rand(case.camera.height, case.camera.width, 3, generator=torch.Generator().manual_seed(0))

    def work() -> list[Tensor]:
        scene = requiring_grad(case.splats)
        probe = torch.zeros(len(scene), 4, requires_grad=True)
        backend = CudaBackend(launcher=emulator, deterministic=deterministic)
        output = backend.rasterize(scene, case.camera, SETTINGS, probe)
        contraction(output, cotangents).backward()
        given = (case.splats, case.camera, image, SETTINGS)
        errors = [backend.splat_errors(*given, occlusion=occlusion) for occlusion in (False, True)]
        grads = [tensor.grad for _, tensor in scene.items()] + [probe.grad]
        images = [getattr(output, name).detach() for name in IMAGES]
        return [*images, *(grad for grad in grads if grad is not None), *errors]

    assert unchanged_by_poison(work) == len(IMAGES) + 7 + 2


def test_training_reads_no_uninitialised_memory(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Covers losses, Adam, densification, ranking, clones and frozen rows in three short stages."""
    monkeypatch.setattr(launch, "launcher_for", lambda device: emulator)
    backend = cuda_on_host()
    scene, recipe = train_toys.make_scene(), train_toys.short()

    def work() -> list[Tensor]:
        state = train_toys.train(scene, recipe, backend=backend)[0].state
        return [t for _, t in state.splats.items()] + [m.square for m in state.moments.values()]

    assert unchanged_by_poison(work) > 6
