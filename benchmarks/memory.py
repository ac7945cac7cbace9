"""Memory that the native rasterizer holds for one view between forward and backward, as a formula.

N splats, E entries (tile, splat) that the binning lists, C slots (entries some pixel saw) of the largest chunk of
tiles, P pixels, t tiles; float32, a densification signal of two columns::

    bytes = 64 N + max(56 N, 162 C) + 8 E + 16 P + 84.25 t + a constant below 2 kB

64 N: records. 56 N: cull record 32, tile rectangle 8, sort 16; the backward pass puts the slots of two chunks there,
each gradients 64, extra 16 and its flag 1. A chunk takes N / 3 slots where no four tiles in a row have more, at least
4096, so from 12,000 splats on the maximum is 56 N. 16 P: T, M1, M2, 1/z of the first pair. The sums of gradients lie
in the gradient of shN; where that is not wanted or has fewer than 6 coefficients, they take 64 N more. Buffers that
grow for a later view take 1/16 more than asked.
"""

from __future__ import annotations

from dataclasses import dataclass

CHUNKS = 16  # of bin.cpp
MIN_SLOTS = 4096  # of gradient_sums.cpp
TILE, LINE = 16, 64
GROUP = 4  # of frame.h
SLOT = 64 + 16 + 1  # bytes
FORWARD_SCRATCH = 32 + 8 + 2 * 8  # bytes per splat


@dataclass(frozen=True)
class ViewWork:
    """What is in one view, counted by the native library."""

    splats: int
    visible_splats: int
    entries: int  # (tile, splat), before the forward pass
    slots: int  # after it: some live pixel saw the splat
    pairs: int  # (pixel, splat), visible
    lane_pairs: int  # (pixel, splat) that the backward pass computes, seen or not
    width: int
    height: int
    largest_chunk: int  # slots; 0 before the backward pass

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        return -(-self.width // TILE) * -(-self.height // TILE)


def _lines(size: int) -> int:
    """Bytes in whole cache lines."""
    return -(-size // LINE) * LINE


def _room(count: int, size: int) -> int:
    """Bytes of a fresh buffer of that many elements (Buffer::reserve of frame.h)."""
    return _lines(count * size) // size * size


def view_bytes(work: ViewWork) -> int:
    """Exact bytes of a fresh frame after its backward pass."""
    n, t, s = work.splats, work.tiles, work.slots
    elements = (
        (16 * n, 4),  # records
        (t + 1, 8),  # tile_begin
        (work.entries, 8),
        (t, 4),  # tile_count
        (-(-t // GROUP), 1),  # taken
        (4 * work.width * work.height, 4),  # saved
        (CHUNKS * t, 4),  # histogram
        (t + 1, 8),  # slot_begin
        (min(t, s // (MIN_SLOTS // 2)) + 3, 40),  # chunks
    )
    scratch, slots = _room(FORWARD_SCRATCH * n, 1), 2 * _lines(SLOT * work.largest_chunk)
    if slots > scratch:  # it grows
        scratch = _room(slots + slots // 16, 1)
    return scratch + sum(_room(count, size) for count, size in elements)
