"""The emulator of CUDA kernels computes what a GPU would, and detects deadlocks."""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest
import torch
from torch import Tensor

import emulate


class _Arrays(ctypes.Structure):
    _fields_ = (("input", ctypes.c_void_p), ("output", ctypes.c_void_p))


HELPERS = Path(__file__).resolve().parents[2] / "helpers"


@pytest.fixture(scope="module")
def cases() -> emulate.EmulatedKernels:
    return emulate.build([HELPERS / "emulator_cases.cu"], HELPERS)


def run(
    kernels: emulate.EmulatedKernels,
    name: str,
    given: Tensor,
    out: Tensor,
    blocks: int = 1,
    descending: bool = False,
    seed: int = 0,
) -> Tensor:
    arrays = _Arrays(given.data_ptr(), out.data_ptr())
    kernels.launch(name, (blocks, 1), len(given) // blocks, arrays, descending=descending, seed=seed)
    return out


def ints(n: int) -> Tensor:
    return torch.arange(n, dtype=torch.int32)


def test_a_missing_barrier_gives_wrong_results(cases: emulate.EmulatedKernels) -> None:
    results = [run(cases, "reverse_block_without_barrier", ints(64), ints(64), 1, d).tolist() for d in (False, True)]
    assert results[0] != results[1]
    assert all(result != list(range(63, -1, -1)) for result in results)


def test_warps_that_run_ahead_expose_a_vote_used_as_a_barrier(cases: emulate.EmulatedKernels) -> None:
    """With all warps in lockstep the vote would pass as a barrier; with a real barrier the results are correct."""
    right = [*range(63, -1, -1), *range(127, 63, -1)]

    def results(name: str, **order: int) -> list[int]:
        return list(run(cases, name, ints(128), ints(128) - 9, 2, **order).tolist())  # type: ignore[arg-type]

    assert [results("reverse_block_behind_a_vote", descending=d) for d in (False, True)] == [right] * 2
    assert any(results("reverse_block_behind_a_vote", seed=seed) != right for seed in range(1, 9))
    assert all(results("reverse_block", seed=seed) == right for seed in range(1, 9))


@pytest.mark.parametrize("seed", [0, *range(1, 9)])
def test_warps_may_diverge_and_each_has_its_own_ballots(cases: emulate.EmulatedKernels, seed: int) -> None:
    given = torch.tensor([3, 7, 0, 5], dtype=torch.int32).repeat(32)
    out = run(cases, "warps_that_part", given, torch.full((128, 2), -1, dtype=torch.int32), seed=seed).view(4, 32, 2)
    for warp, count in enumerate((3, 7, None, 5)):
        there = [-1, -1] if count is None else [sum(range(count + 1)), sum(range(32 * warp, 32 * warp + 32))]
        assert out[warp].tolist() == [there] * 32


@pytest.mark.parametrize("kernel", ["read_unwritten_shared", "read_unwritten_shared_of_a_template"])
def test_unwritten_shared_memory_is_nan_in_every_block(cases: emulate.EmulatedKernels, kernel: str) -> None:
    for _ in range(2):
        assert bool(run(cases, kernel, torch.zeros(64), torch.zeros(32), blocks=2).isnan().all())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("collective_in_a_branch", "__any_sync"),
        ("different_collectives", "divergent.*__any_sync.*__ballot_sync"),
        ("partial_mask", "full mask"),
        ("barrier_of_one_warp", "__syncthreads"),
    ],
)
def test_threads_that_do_not_meet_are_an_error_with_words_not_a_hang(
    cases: emulate.EmulatedKernels, name: str, words: str
) -> None:
    with pytest.raises(RuntimeError, match=words):
        run(cases, name, ints(64), ints(64))
    with pytest.raises(RuntimeError):
        run(cases, name, ints(64), ints(64), seed=3)
