"""Native and (emulated) CUDA Adam against torch's fused Adam: all rows, some rows, any thread count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.optim.adam import adam

from emulate import Emulator
from gs2d.errors import ShapeError
from gs2d.kernels.adam_update import AdamUpdate
from gs2d.kernels.cuda import cuda_adam as cuda
from gs2d.kernels.library import Library, load
from gs2d.render.cpu_backend import CpuBackend

WRITTEN = ("parameter", "mean", "square")
BETAS = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}
SHAPES = ((3,), (4,), (2,), (), (1, 3), (15, 3))


def attribute(count: int, shape: tuple[int, ...], dtype: torch.dtype, seed: int = 0) -> AdamUpdate:
    """Return parameters, moments after a few steps, and gradients with exact zeros."""
    g = torch.Generator().manual_seed(seed)

    def rand() -> Tensor:
        return torch.randn(count, *shape, generator=g).to(dtype)

    gradient = torch.where(rand() < -1, 0.0, 1e-3 * rand()).to(dtype)
    return AdamUpdate(rand(), 1e-3 * rand(), 1e-6 * rand() ** 2, gradient, 1.6e-4 * (1 + seed), 7)


def copied(update: AdamUpdate) -> AdamUpdate:
    return replace(update, **{name: getattr(update, name).clone() for name in WRITTEN})


def by_torch(update: AdamUpdate) -> AdamUpdate:
    """Apply the same step to all rows with torch."""
    out = copied(update)
    lists = [[t] for t in (out.parameter, out.gradient, out.mean, out.square)]
    adam(
        *lists, [], [torch.tensor(float(update.step - 1))], fused=True, amsgrad=False, beta1=BETAS["beta1"],
        beta2=BETAS["beta2"], eps=BETAS["eps"], lr=update.rate, weight_decay=0.0, maximize=False,
    )  # fmt: skip
    return out


def equal(a: AdamUpdate, b: AdamUpdate) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in WRITTEN)


@pytest.fixture(params=["native", "emulated"])
def step(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Return the step function of each device."""
    if request.param == "native":
        return partial(CpuBackend(load()).adam_step, **BETAS)
    return partial(cuda.adam_step, **BETAS, launcher=request.getfixturevalue("emulator"))


def assert_torchs_step(step: Callable[..., None], count: int, dtype: torch.dtype = torch.float32) -> None:
    """Compare up to the last digits: torch contracts operations differently between processors."""
    updates = [attribute(count + (shape == ()), shape, dtype, seed=k) for k, shape in enumerate(SHAPES)]
    before, expected = [copied(u) for u in updates], [by_torch(u) for u in updates]
    step(updates)
    digits = 5e-7 if dtype == torch.float32 else 1e-15
    for found, wanted, start in zip(updates, expected, before, strict=True):
        for name in WRITTEN:
            a, b, old = (getattr(update, name) for update in (found, wanted, start))
            assert bool(((a - b).abs() <= digits * (b.abs() + old.abs())).all()), name
            assert bool((a != old).any()), name


def test_it_takes_torchs_fused_step(any_native: Library) -> None:
    """1000 rows of 45 are several chunks of 8192 elements; 1001 rows of 1 end within a vector."""
    assert_torchs_step(partial(CpuBackend(any_native).adam_step, **BETAS), 1000, any_native.dtype)


def test_the_cuda_kernel_takes_torchs_fused_step(emulator: Emulator) -> None:
    """70 rows of 45 are several blocks of 512; the others end within one."""
    assert_torchs_step(partial(cuda.adam_step, **BETAS, launcher=emulator), 70)


def test_a_step_whose_iteration_overflowed_changes_nothing(emulator: Emulator) -> None:
    start = attribute(20, (4,), torch.float32)
    stopped = copied(start)
    cuda.adam_step([stopped], **BETAS, launcher=emulator, skip=torch.tensor(1, dtype=torch.int32))
    assert equal(stopped, start)


def test_the_bits_do_not_depend_on_threads(native: Library) -> None:
    results = []
    for threads in (1, 2, 5):
        native.use_threads(threads)
        updates = [attribute(3000, shape, torch.float32, seed=k) for k, shape in enumerate(SHAPES)]
        CpuBackend(native).adam_step(updates, **BETAS)
        results.append(updates)
    assert all(equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("compact", [False, True])
@pytest.mark.parametrize("shape", [(), (3,), (15, 3)])
def test_only_the_rows_that_are_named_are_written_and_as_they_would_be_alone(
    step: Callable[..., None], shape: tuple[int, ...], compact: bool
) -> None:
    start = attribute(100, shape, torch.float32)
    mask = torch.arange(100) % 3 == 1
    rows = mask.nonzero().squeeze(1)
    alone = AdamUpdate(
        start.parameter[rows], start.mean[rows], start.square[rows], start.gradient[rows], start.rate, start.step
    )
    step([alone])
    expected = copied(start)
    for name in WRITTEN:
        getattr(expected, name)[rows] = getattr(alone, name)
    found = copied(
        replace(start, rows=rows, compact=compact, gradient=start.gradient[rows] if compact else start.gradient)
    )
    step([found])
    assert equal(found, expected)
    if not compact:
        masked = copied(replace(start, trained=mask))
        step([masked])
        assert equal(masked, expected)


@pytest.mark.parametrize("rows", [[0, 5], [-1]])
def test_rows_that_are_not_there_change_nothing(native: Library, rows: list[int]) -> None:
    good, bad = attribute(5, (3,), torch.float32), attribute(5, (3,), torch.float32, seed=1)
    before = copied(good)
    with pytest.raises(ShapeError, match="parameter"):
        CpuBackend(native).adam_step([good, replace(bad, rows=torch.tensor(rows))], **BETAS)
    assert equal(good, before)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_the_first_tensor_that_is_not_finite_is_found_wherever_it_is(any_native: Library, value: float) -> None:
    sizes = (1, 37, 70_000, 300_001)
    large = 3e38 if any_native.dtype == torch.float32 else 1e308
    for which, size in enumerate(sizes):
        for at in (0, size // 2, size - 1):
            tensors = [torch.full((n,), large, dtype=any_native.dtype) for n in sizes]
            assert (
                CpuBackend(any_native).first_not_finite(tensors) is None
            )  # the sum overflows although each element is finite
            tensors[which][at] = value
            tensors[-1][-1] = value
            assert CpuBackend(any_native).first_not_finite(tensors) == which
    assert CpuBackend(any_native).first_not_finite([torch.empty(0, dtype=any_native.dtype)]) is None
