"""Memory that the native rasterizer holds for one view between forward and backward, as a formula.

N splats, E entries (tile, splat) that the binning lists, S slots (entries some pixel saw), P pixels, t tiles; float32::

    bytes = 5/4 (140 N + 8 E + 85 S + 16 P + 84 t) + a constant below 50 kB

140 N: record 64, cull record 32, tile rectangle 2 x 8, order 4, sort 16, list of slots 8. 85 S: gradients 64, extra 16
with its flag 1, index 4. 16 P: T, M1, M2, 1/z of the first pair. Buffers grow by a quarter more than asked, so that a
few more splats do not mean new memory; buffers of 2 MiB or more are rounded up to 2 MiB (not counted here).
"""

from __future__ import annotations

from dataclasses import dataclass

CHUNKS, PASSES, DIGITS = 16, 3, 1 << 11  # of bin.cpp
TILE = 16


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

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        return -(-self.width // TILE) * -(-self.height // TILE)


def _room(count: int) -> int:
    """Capacity of a fresh buffer (Buffer::reserve of frame.h)."""
    return count + count // 4 + 64


def view_bytes(work: ViewWork) -> int:
    """Exact bytes of a fresh frame after its backward pass."""
    n, t, s = work.splats, work.tiles, work.slots
    elements = (
        (16 * n, 4),  # records
        (n, 32),  # cull records
        (n, 8),  # tile rectangles
        (n, 4),  # order
        (n, 8),  # rectangles in depth order
        (2 * n * 8 + PASSES * DIGITS * 4, 1),  # radix sort
        (CHUNKS * t, 4),  # histogram
        (t + 1, 8),  # tile_begin
        (work.entries, 8),
        (t, 4),  # tile_count
        (4 * work.width * work.height, 4),  # saved
        (t + 1, 8),  # slot_begin
        (16 * s, 4),  # gradients
        (4 * s, 4),  # extra gradients
        (s, 1),  # has_extra
        (n + 2, 8),  # splat_begin
        (s, 4),  # splat_slots
    )
    return sum(_room(count) * size for count, size in elements)
