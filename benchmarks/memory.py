"""Formula for the memory of the native rasterizer for one view between forward and backward.

N splats, E binned entries (tile, splat), C slots (entries visible in some pixel) of the largest chunk of
tiles, P pixels, t tiles; float32, a densification signal of two columns::

    bytes = 64 N + max(56 N, 162 C) + 8 E + 16 P + 84.25 t + a constant below 2 kB

64 N: records. 56 N: cull record 32, tile rectangle 8, sort 16; the backward pass reuses this memory for the slots of
two chunks, each with gradients 64, extra 16 and a flag 1. A chunk takes N / 3 slots, at least 4096, unless four
consecutive tiles have more, so the maximum is 56 N from 12,000 splats on. 16 P: T, M1, M2, 1/z of the first pair. The
sums of gradients use the gradient of shN; if that is not requested or has fewer than 6 coefficients, they take 64 N
more. Buffers that grow for a later view are over-allocated by 1/16.
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
    """Work of one view, counted by the native library."""

    splats: int
    visible_splats: int
    entries: int  # (tile, splat), before the forward pass
    slots: int  # after it: the splat was visible in some live pixel
    pairs: int  # (pixel, splat), visible
    lane_pairs: int  # (pixel, splat) that the backward pass computes, visible or not
    width: int
    height: int
    largest_chunk: int  # slots; 0 before the backward pass

    @property
    def tiles(self) -> int:
        """Return the number of tiles of the image."""
        return -(-self.width // TILE) * -(-self.height // TILE)


def _lines(size: int) -> int:
    """Round bytes up to whole cache lines."""
    return -(-size // LINE) * LINE


def _room(count: int, size: int) -> int:
    """Return the bytes of a fresh buffer with this many elements (Buffer::reserve of frame.h)."""
    return _lines(count * size) // size * size


def view_bytes(work: ViewWork) -> int:
    """Return the exact bytes of a fresh frame after its backward pass."""
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
    if slots > scratch:  # growth of the buffer
        scratch = _room(slots + slots // 16, 1)
    return scratch + sum(_room(count, size) for count, size in elements)
