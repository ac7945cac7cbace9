"""Sort and prefix sums of sort.cu, emulated: equal to torch's stable sort in any order of threads and blocks."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from emulate import Emulator
from gs2d.kernels.cuda.kernel_arguments import work_of
from gs2d.kernels.cuda.sort import (
    DIGITS,
    MOST_PASSES,
    PIECE,
    SORT_THREADS,
    digit_blocks,
    passes_of,
    pieces_of,
)

SEEDS = (0, 7)  # ascending; shuffled


def sort(emulator: Emulator, keys: Tensor, payloads: Tensor | None, bits: int) -> tuple[Tensor, Tensor]:
    """Sort int16 or int32 keys by their lowest bits, with payloads, or by default the original indices."""
    width = 16 if keys.dtype == torch.int16 else 32
    count, plan = len(keys), passes_of(bits)
    digits = torch.zeros(MOST_PASSES, DIGITS, dtype=torch.int32)
    given = {"keys": keys, "digits": digits, "count": count, "passes": len(plan)}
    emulator.run([work_of(f"count_digits_{width}", digit_blocks(count), given, threads=SORT_THREADS)])
    for number, (shift, of_digit) in enumerate(plan):
        words = torch.zeros(pieces_of(count) * DIGITS, dtype=torch.int32)
        ticket = torch.zeros(1, dtype=torch.int32)
        sorted_keys, sorted_payloads = torch.full_like(keys, -1), torch.full((count,), -1, dtype=torch.int32)
        given = {"count": count, "shift": shift, "bits": of_digit, "keys": keys, "payloads": payloads}
        given |= {"sorted_keys": sorted_keys, "sorted_payloads": sorted_payloads}
        given |= {"digits": digits[number], "ticket": ticket, "words": words}
        emulator.run([work_of(f"sort_pass_{width}", pieces_of(count), given, threads=SORT_THREADS)])
        keys, payloads = sorted_keys, sorted_payloads
    assert payloads is not None
    return keys, payloads


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("count", [1, 31, PIECE - 1, PIECE, 2 * PIECE + 77])
def test_a_sort_by_radix_is_torchs_stable_sort(emulator: Emulator, count: int, seed: int) -> None:
    emulator = Emulator(seed=seed)
    generator = torch.Generator().manual_seed(count)
    depths = torch.rand(count, generator=generator).mul(100).floor().div(7)  # many ties
    depths[::5] = float("inf")
    found = sort(emulator, depths.view(torch.int32), None, 32)
    expected = torch.sort(depths, stable=True)
    assert torch.equal(found[1].long(), expected.indices)
    assert torch.equal(found[0].view(torch.float32), expected.values)


@pytest.mark.parametrize(("tiles", "width"), [(1, 16), (200, 16), (2500, 16), (40_000, 32), (1 << 17, 32)])
def test_pairs_are_sorted_by_tile_with_their_payloads(emulator: Emulator, tiles: int, width: int) -> None:
    count = PIECE + 300
    generator = torch.Generator().manual_seed(tiles)
    keys = torch.randint(0, tiles + 1, (count,), generator=generator, dtype=torch.int32)
    payloads = torch.randint(0, 1 << 31, (count,), generator=generator, dtype=torch.int64).to(torch.int32)
    given = keys.to(torch.int16) if width == 16 else keys
    found = sort(Emulator(seed=3), given, payloads, tiles.bit_length())
    order = torch.sort(keys, stable=True).indices
    assert torch.equal(found[0].to(torch.int32), keys[order])
    assert torch.equal(found[1], payloads[order])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("count", [1, 300, PIECE, 40 * PIECE + 5])
def test_running_sums_follow_an_order_and_say_whether_there_is_room(emulator: Emulator, count: int, seed: int) -> None:
    """The last of 41 chunks looks back further than a warp is wide, unless an earlier one has published its sum."""
    emulator = Emulator(seed=seed)
    generator = torch.Generator().manual_seed(count)
    counts = torch.randint(0, 9, (count,), generator=generator, dtype=torch.int32)
    order = torch.randperm(count, generator=generator).to(torch.int32)
    total = int(counts.sum())
    for room, short in ((total, 0), (total - 1, 1)):
        found = run_counts(emulator, order, counts, room)
        assert torch.equal(found[0].long(), counts[order.long()].cumsum(0))
        assert (found[1], found[2]) == (total, short)


def run_counts(emulator: Emulator, order: Tensor, counts: Tensor, room: int) -> tuple[Tensor, int, int]:
    count = len(order)
    ends, pairs = torch.full((count,), -1, dtype=torch.int32), torch.full((1,), -1, dtype=torch.int64)
    overflow, ticket = torch.full((1,), -1, dtype=torch.int32), torch.zeros(1, dtype=torch.int32)
    words = torch.zeros(pieces_of(count), dtype=torch.int32)
    given = {"order": order, "tile_counts": counts, "ends": ends, "ticket": ticket, "words": words}
    given |= {"pairs": pairs, "overflow": overflow, "count": count, "room": room}
    emulator.run([work_of("running_counts", pieces_of(count), given, threads=SORT_THREADS)])
    return ends, int(pairs), int(overflow)
