"""A block-sparse truncated signed distance field (Curless and Levoy 1996), fused from depth maps.

Space is a grid of voxels; only blocks of 8^3 that lie near some seen surface exist. A voxel starts unknown (weight 0),
never as inside or outside, so what no view saw makes no surface and no second layer. A view changes a voxel at depth
z, seen through a pixel of depth d, by the running mean of min(1, (d - z) / truncation): free space in front of the
surface clears voxels of existing blocks, and behind the surface the weight falls to zero at the truncation, so that
the two sides of a thin plate do not fight.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gs2d.errors import ProtocolError
from gs2d.meshing.bounds import FusionBounds, backproject
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.integrate import fusion_backend, integrator
from gs2d.meshing.sampling import make_sampler
from gs2d.meshing.volume import BLOCK, Budget, Volume, block_bytes, block_grid, check_truncation, invalid_volume
from gs2d.render.backends import Backend

if TYPE_CHECKING:
    from gs2d.kernels.library import Library

_MAX_MARKS = 1 << 27  # bytes
_FEW_SAMPLES = 1e8  # of one depth map: seconds


def fuse(
    frames: Iterable[DepthMap],
    limits: FusionBounds,
    *,
    max_bytes: int = 4 << 30,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Volume:
    """Fuse depth maps.

    Parameters
    ----------
    frames : iterable of DepthMap
        Read twice, one at a time: a sequence or a ``Spool``, not a generator.
    limits : FusionLimits
    max_bytes : int
        The volume will not grow beyond this.
    threads : int, optional
        Default: as many as the machine has. The result does not depend on it.
    backend : str or Backend
        What adds the views: "reference" (numpy), "cpu" (native, the same bits), "cuda", or "auto" (see
        ``integrate.fusion_backend``).

    Raises
    ------
    ProtocolError
        If the blocks near the surface need more than ``max_bytes`` (the message names a voxel that fits), the
        truncation is larger than the box, or the depth maps see nothing inside the limits.
    BackendError
        If the backend is unknown or cannot run here.
    """
    blocks = find_blocks(frames, limits, max_bytes=max_bytes, threads=threads, backend=backend)
    return fuse_blocks(frames, limits, blocks, threads=threads, backend=backend)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The blocks near what depth maps saw.

    Attributes
    ----------
    dims, keys
        As of a ``Volume``.
    colored : bool
        Whether a depth map has colour.
    frames : int
        How many depth maps there are.
    """

    dims: tuple[int, int, int]
    keys: np.ndarray
    colored: bool
    frames: int

    @property
    def nbytes(self) -> int:
        """Bytes of a volume of them."""
        return len(self.keys) * block_bytes(self.colored)

    def part(self, start: int, stop: int) -> Blocks:
        """Return the blocks of these rows."""
        return replace(self, keys=self.keys[start:stop])


def find_blocks(
    frames: Iterable[DepthMap],
    limits: FusionBounds,
    *,
    max_bytes: int = 4 << 30,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Blocks:
    """Find the blocks that are fused; parameters and errors as of ``fuse``."""
    if iter(frames) is frames:
        raise TypeError("frames are read twice: pass a list or a Spool, not an iterator")
    check_truncation(limits)
    dims = block_grid(limits)
    budget = Budget(limits, max_bytes)
    keys = np.zeros(0, dtype=np.int64)
    colored, count, library = False, 0, block_finder(backend, threads)
    for item in frames:
        colored, count = colored or item.color is not None, count + 1
        budget.check_least(min_blocks(item, limits), colored)
        keys = merged(keys, touched_blocks(item, limits, dims, library))
        budget.check(len(keys), colored, partial=True)
    budget.check(len(keys), colored, partial=False)
    if not len(keys):
        raise ProtocolError("depth inside the fusion limits was expected, got none; widen bbox or depth_limit")
    return Blocks(dims, keys, colored, count)


def fuse_blocks(
    frames: Iterable[DepthMap],
    limits: FusionBounds,
    blocks: Blocks,
    *,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Volume:
    """Fuse depth maps into these blocks; parameters as of ``fuse``."""
    volume = invalid_volume(limits, blocks.dims, blocks.keys, colored=blocks.colored, frames=blocks.frames)
    with integrator([volume], backend, threads) as add:
        for item in frames:
            add(make_sampler(item, limits))
    return volume


def min_blocks(item: DepthMap, limits: FusionBounds) -> int:
    """Return a number below which ``touched_blocks`` cannot stay, without its work, which grows as voxels shrink.

    0 where that work is small. The bands of the pixels, one truncation before and behind what they saw, cut to the box,
    are disjoint pieces of space, z^3 / (3 fx fy) between two depths, and a block is b^3 of it. What they saw is at
    least d^2 / (fx fy) wide, seen face on, and the shadow of a block is at most sqrt(3) b^2.
    """
    rows, columns = np.nonzero((item.depth > 0) & (item.depth <= limits.depth_limit))
    depth = item.depth[rows, columns].astype(np.float64)
    parts, steps = _samples(item, depth, limits)
    if len(rows) * parts**2 * steps < _FEW_SAMPLES:
        return 0
    center, focal2, block = item.camera.center, item.camera.fx * item.camera.fy, BLOCK * limits.voxel
    ray = backproject(item.camera, np.ones(len(rows)), rows, columns) - center  # to depth 1
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along an axis
        sides = np.stack([(limits.lower - center) / ray, (limits.upper - center) / ray])
    near = np.fmax(sides.min(axis=0).max(axis=1), np.maximum(depth - limits.truncation, 0))
    far = np.fmin(sides.max(axis=0).min(axis=1), depth + limits.truncation)
    volume = float(np.maximum(far**3 - near**3, 0).sum()) / (3 * focal2)
    area = float((depth[(near <= depth) & (depth <= far)] ** 2).sum()) / focal2
    return int(max(volume / block**3, area / (3**0.5 * block**2)))


def _samples(item: DepthMap, depth: np.ndarray, limits: FusionBounds) -> tuple[int, int]:
    """At how many places along a side of each pixel, and along each ray, a depth map is sampled."""
    half = 0.5 * BLOCK * limits.voxel
    width = float(depth.max(initial=0.0)) / min(item.camera.fx, item.camera.fy)
    return max(1, int(np.ceil(width / half))), int(np.ceil(2 * limits.truncation / half)) + 1


def touched_blocks(
    item: DepthMap, limits: FusionBounds, dims: tuple[int, int, int], library: Library | None = None
) -> np.ndarray:
    """Keys [K] of the blocks near what one depth map saw: sorted, each once.

    Each seen pixel is sampled along its ray from one truncation before to one behind the surface, in steps of half a
    block; a sample takes the 2^3 blocks nearest to it. Where a pixel is wider than half a block, it is sampled at
    several places of its square. The native library does the same operations as numpy.
    """
    half = 0.5 * BLOCK * limits.voxel
    rows, columns = np.nonzero((item.depth > 0) & (item.depth <= limits.depth_limit))
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    depth = item.depth[rows, columns].astype(np.float64)
    parts, steps = _samples(item, depth, limits)
    shifts = (np.arange(parts) + 0.5) / parts - 0.5
    offsets = np.linspace(-limits.truncation, limits.truncation, steps)
    # The lower of the two nearest blocks along each axis, counted from a border of one block round the grid.
    padded = (dims[0] + 2, dims[1] + 2, dims[2] + 2)
    strides = (padded[1] * padded[2], padded[2], 1)
    start = (item.camera.center - limits.lower) / half  # in half blocks, as is all below
    end = 2 * np.asarray(dims)
    rays = (
        (backproject(item.camera, np.ones(len(rows)), rows + dy, columns + dx) - item.camera.center).T / half
        for dx in shifts
        for dy in shifts
    )
    if library is not None and padded[0] * padded[1] * padded[2] <= _MAX_MARKS:
        from gs2d.kernels.tsdf import mark_on_cpu

        marks = np.zeros(padded, bool)
        for ray in rays:
            mark_on_cpu(library, ray, depth, offsets, start, end, marks)
        first = np.flatnonzero(marks)
    else:
        lowest = [part for ray in rays for part in _lowest_blocks(ray, depth, offsets, start, end, strides)]
        first = _distinct(lowest, padded)
    corners = [sum(strides[axis] * (c >> axis & 1) for axis in range(3)) for c in range(8)]
    blocks = np.stack(np.unravel_index(_distinct([first + corner for corner in corners], padded), padded)) - 1
    x, y, z = blocks[:, ((blocks >= 0) & (blocks < np.asarray(dims)[:, None])).all(axis=0)]
    return (x * dims[1] + y) * dims[2] + z


def _lowest_blocks(
    ray: np.ndarray, depth: np.ndarray, offsets: np.ndarray, start: np.ndarray, end: np.ndarray, strides: Sequence[int]
) -> Iterator[np.ndarray]:
    """For each offset the blocks that ``start + (depth + offset) ray`` lies in, where that is in the grid."""
    for offset in offsets:
        at = start[:, None] + (depth + offset) * ray  # [3, P]
        cells = at[:, ((at >= 0) & (at < end[:, None])).all(axis=0)].astype(np.int64)
        x, y, z = (cells + 1) >> 1
        flat = x * strides[0] + y * strides[1] + z
        yield flat[np.flatnonzero(np.diff(flat, prepend=-1))]  # neighbours mostly share a block


def block_finder(backend: str | Backend, threads: int | None) -> Library | None:
    """Return the native library for ``touched_blocks``, on so many threads; None (numpy) for the reference."""
    if fusion_backend(backend).fusion() is None:
        return None
    from gs2d.kernels.library import available_variants, load

    if not available_variants():
        return None
    library = load()
    if not library.has("gs2d_mark_blocks"):
        return None
    library.use_threads(threads or os.cpu_count() or 1)
    return library


def _distinct(numbers: list[np.ndarray], dims: tuple[int, int, int]) -> np.ndarray:
    """Numbers of a grid's places, sorted, each once: by marking them, or, where the grid is too large, by sorting."""
    places = dims[0] * dims[1] * dims[2]
    if places > _MAX_MARKS:
        return np.unique(np.concatenate(numbers))
    marks = np.zeros(places, bool)
    for some in numbers:
        marks[some] = True
    return np.flatnonzero(marks)


def merged(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """All of two sorted arrays of keys >= 0, sorted, each once."""
    both = np.sort(np.concatenate([one, other]), kind="stable")  # merges what is sorted
    return both[np.flatnonzero(np.diff(both, prepend=-1))]
