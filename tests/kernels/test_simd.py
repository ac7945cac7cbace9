"""SIMD wrapper functions against numpy, on every instruction set."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gs2d.kernels.library import Library

UNARY = {"exp2": 0, "exp": 1, "log2": 2, "round": 3, "sqrt": 4}


def real(library: Library) -> np.dtype:
    return np.dtype(np.float64 if library.dtype == torch.float64 else np.float32)


def apply(library: Library, name: str, x: np.ndarray) -> np.ndarray:
    padded = np.ascontiguousarray(np.resize(x, -(-len(x) // 64) * 64), dtype=real(library))
    out = np.empty_like(padded)
    assert library.call("gs2d_selftest_unary", UNARY[name], padded, out, len(padded))
    return out[: len(x)].astype(np.float64)


@pytest.mark.parametrize(
    ("name", "low", "high", "bound"), [("exp2", -126, 0, 2.5e-7), ("exp", -87, 88, 4e-7), ("log2", 1e-30, 1e30, 3e-7)]
)
def test_transcendental_functions_are_within_a_few_roundings(
    any_native: Library, name: str, low: float, high: float, bound: float
) -> None:
    x = np.geomspace(low, high, 20_011) if low > 0 else np.linspace(low, high, 20_011)
    x = np.concatenate([x, np.linspace(-1, 1, 999) if low <= 0 and high > 0 else [x[0]]]).astype(real(any_native))
    expected = getattr(np, name)(x.astype(np.float64))
    error = np.abs(apply(any_native, name, x) - expected) / np.maximum(np.abs(expected), 1e-30 if low <= 0 else 1.0)
    assert error.max() < bound


def test_log2_of_numbers_next_to_one_keeps_its_digits(any_native: Library) -> None:
    x = (1 + np.linspace(-1e-3, 1e-3, 640)).astype(real(any_native))
    assert np.abs(apply(any_native, "log2", x) - np.log2(x.astype(np.float64))).max() < 2e-9


def test_exp_saturates_to_zero_and_infinity(any_native: Library) -> None:
    with np.errstate(over="ignore"):
        values = apply(any_native, "exp", np.array([-1e4, -200.0, 1e4, -np.inf, np.inf]))
    assert values.tolist()[2:] == [np.inf, 0.0, np.inf]
    assert values[0] == 0
    assert values[1] < 1e-38


def test_round_is_to_the_nearest_even(any_native: Library) -> None:
    x = np.array([-2.5, -1.5, -0.5, -0.4, 0.0, 0.5, 1.5, 2.5, 2.6, 1e6 + 0.25])
    assert apply(any_native, "round", x).tolist() == np.rint(x).tolist()


def test_sqrt_is_correctly_rounded(any_native: Library) -> None:
    x = np.geomspace(1e-30, 1e30, 3001).astype(real(any_native))
    assert np.array_equal(apply(any_native, "sqrt", x), np.sqrt(x).astype(np.float64))


def test_transpose_swaps_rows_and_columns(any_native: Library) -> None:
    n = any_native.lanes
    x = np.arange(n * n, dtype=real(any_native)).reshape(n, n)
    out = np.empty_like(x)
    any_native.call("gs2d_selftest_transpose", x, out)
    assert np.array_equal(out, x.T)


def test_transposing_reduction_sums_each_vector_into_its_own_lane(any_native: Library) -> None:
    x = np.random.default_rng(0).integers(-99, 99, size=(20, any_native.lanes)).astype(real(any_native))
    out = np.empty(20, dtype=x.dtype)
    any_native.call("gs2d_selftest_transpose_reduce", x, out)
    assert np.array_equal(out, x.sum(axis=1))


@pytest.mark.parametrize("n", [0, 1, 7, 8, 15, 16, 17, 31, 64, 255])
def test_lists_of_entries_hold_exactly_those_with_the_bit_in_order(any_native: Library, n: int) -> None:
    masks = np.random.default_rng(n).integers(0, 2**32, size=n + 64, dtype=np.uint32)  # bits beyond n must not count
    out = np.zeros(n + 64, dtype=np.uint32)
    for bit in (0, 5, 31):
        count = any_native.call("gs2d_selftest_indices_with_bit", masks, n, bit, out)
        assert out[:count].tolist() == [i for i in range(n) if masks[i] >> bit & 1]


@pytest.mark.parametrize("k", [2, 3, 4])
def test_packed_rows_become_vectors_and_rows_again(any_native: Library, k: int) -> None:
    n = any_native.lanes
    rows = np.arange(n * k, dtype=real(any_native)).reshape(n, k)
    vectors, back = np.empty((k, n), rows.dtype), np.empty_like(rows)
    any_native.call("gs2d_selftest_packed", k, rows, vectors, back)
    assert np.array_equal(vectors, rows.T)
    assert np.array_equal(back, rows)


def test_rows_of_eight_become_columns(any_native: Library) -> None:
    n = any_native.lanes
    rows = np.arange(n * 8, dtype=real(any_native)).reshape(n, 8)
    out = np.empty((8, n), rows.dtype)
    any_native.call("gs2d_selftest_columns", rows, out)
    assert np.array_equal(out, rows.T)


def test_bits_are_added_in_the_lanes_of_a_mask_and_move_to_the_left(any_native: Library) -> None:
    n = any_native.lanes
    random = np.random.default_rng(0)
    for masks, bits in zip(random.integers(0, 1 << n, (50, 2)), random.integers(0, 1 << 28, (50, 2)), strict=True):
        in_lane = masks[:, None] >> np.arange(n) & 1
        out = np.empty(n, np.uint32)
        arguments = masks.astype(np.uint32), bits.astype(np.uint32)
        any_native.call("gs2d_selftest_with_bits", *arguments, out)
        assert np.array_equal(out, in_lane[0] * bits[0] << 4 | in_lane[1] * bits[1])


def test_nonzero_masks_are_set_for_every_block_of_a_tile(any_native: Library) -> None:
    n = any_native.lanes
    random = np.random.default_rng(0)
    for fraction in (0.0, 0.1, 0.9, 1.0):
        numbers = np.where(random.random(256 // n) < fraction, random.integers(1, 1 << n, 256 // n), 0).astype(
            np.uint32
        )
        assert any_native.call("gs2d_selftest_nonzero", numbers) == sum(
            1 << b for b, number in enumerate(numbers) if number
        )


def test_planes_are_unzipped_and_repeated(any_native: Library) -> None:
    n = any_native.lanes
    fields = np.arange(1, 9, dtype=real(any_native))
    out = np.empty((3, n), fields.dtype)
    any_native.call("gs2d_selftest_unzip", fields, out)
    assert np.array_equal(out, np.tile([[1, 3, 5, 0], [2, 4, 6, 0], [0, 0, 7, 8]], n // 4))
