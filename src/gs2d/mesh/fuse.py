"""A block-sparse truncated signed distance field (Curless and Levoy 1996), fused from depth maps.

Space is a grid of voxels; only blocks of 8^3 that lie near some seen surface exist. A voxel starts unknown (weight 0),
never as inside or outside, so what no view saw makes no surface and no second layer. A view changes a voxel at depth
z, seen through a pixel of depth d, by the running mean of min(1, (d - z) / truncation): free space in front of the
surface clears voxels of existing blocks, and behind the surface the weight falls to zero at the truncation, so that
the two sides of a thin plate do not fight.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from gs2d.errors import ProtocolError
from gs2d.mesh.frames import DepthMap
from gs2d.mesh.limits import FusionLimits, backproject
from gs2d.mesh.sampling import View, block_visibility, prepare

BLOCK = 8  # voxels along the side of a block
VOXELS = BLOCK**3
FULL_WEIGHT_BEHIND = 0.75  # of the truncation: the weight falls from 1 here to 0 at the truncation
_CHUNK = 48  # blocks at a time: the temporaries of a chunk fit the second-level cache


@dataclass(frozen=True, eq=False)
class Volume:
    """The fused field. Voxel (i, j, k) of block b is the point ``lower + (8 blocks[b] + (i, j, k)) * voxel``.

    Attributes
    ----------
    limits : FusionLimits
    dims : tuple of 3 ints
        Blocks that the box would hold along x, y, z.
    keys : ndarray [M] int64
        Sorted: (x * dims[1] + y) * dims[2] + z of each block.
    tsdf : ndarray [M, 512] float32
        In units of the truncation, positive towards the cameras; voxels in x, y, z order, z fastest.
    weight : ndarray [M, 512] float32
        0: unknown.
    color, color_weight : ndarray [M, 512, 3] and [M, 512] float32, or None
        0 to 255, from views that saw the voxel near their surface.
    frames : int
        How many depth maps were fused.
    """

    limits: FusionLimits
    dims: tuple[int, int, int]
    keys: np.ndarray
    tsdf: np.ndarray
    weight: np.ndarray
    color: np.ndarray | None
    color_weight: np.ndarray | None
    frames: int

    @property
    def blocks(self) -> np.ndarray:
        """Block coordinates [M, 3] int64."""
        return np.stack(np.unravel_index(self.keys, self.dims), axis=1)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self.keys, self.tsdf, self.weight, self.color, self.color_weight)
        return sum(a.nbytes for a in arrays if a is not None)


def block_bytes(colored: bool) -> int:
    """Bytes of one block in a Volume."""
    return 8 + VOXELS * 4 * (6 if colored else 2)


def fuse(
    frames: Iterable[DepthMap],
    limits: FusionLimits,
    *,
    max_bytes: int = 4 << 30,
    threads: int | None = None,
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

    Raises
    ------
    ProtocolError
        If the blocks near the surface need more than ``max_bytes`` (the message names a voxel that fits), or the
        depth maps see nothing inside the limits.
    """
    if iter(frames) is frames:
        raise TypeError("frames are read twice: pass a list or a Spool, not an iterator")
    threads = threads or os.cpu_count() or 1
    dims = block_grid(limits)
    budget = Budget(limits, max_bytes)
    keys = np.zeros(0, dtype=np.int64)
    colored, count = False, 0
    for item in frames:
        colored, count = colored or item.color is not None, count + 1
        keys = np.union1d(keys, touched_blocks(item, limits, dims))
        budget.check(len(keys), colored, partial=True)
    budget.check(len(keys), colored, partial=False)
    if not len(keys):
        raise ProtocolError("depth inside the fusion limits was expected, got none; widen bbox or depth_limit")
    volume = unknown_volume(limits, dims, keys, colored=colored, frames=count)
    with ThreadPoolExecutor(threads) as pool:
        for item in frames:
            integrate(volume, prepare(item, limits), pool)
    return volume


def unknown_volume(
    limits: FusionLimits, dims: tuple[int, int, int], keys: np.ndarray, *, colored: bool, frames: int
) -> Volume:
    """Blocks of which nothing is known yet."""
    m = len(keys)
    return Volume(
        limits=limits,
        dims=dims,
        keys=keys,
        tsdf=np.zeros((m, VOXELS), np.float32),
        weight=np.zeros((m, VOXELS), np.float32),
        color=np.zeros((m, VOXELS, 3), np.float32) if colored else None,
        color_weight=np.zeros((m, VOXELS), np.float32) if colored else None,
        frames=frames,
    )


def block_grid(limits: FusionLimits) -> tuple[int, int, int]:
    """How many blocks the box holds along x, y, z.

    Raises
    ------
    ProtocolError
        If the box is so large that blocks cannot be numbered: the voxel is far too small for it.
    """
    size = np.subtract(limits.upper, limits.lower)
    dims = np.ceil(size / (BLOCK * limits.voxel)) + 1
    if not np.isfinite(dims).all() or np.prod(dims) > 2**60:
        raise ProtocolError(f"a voxel that fits the box of {size.max():.4g} wu was expected, got {limits.voxel:.4g} wu")
    return int(dims[0]), int(dims[1]), int(dims[2])


def touched_blocks(item: DepthMap, limits: FusionLimits, dims: tuple[int, int, int]) -> np.ndarray:
    """Keys [K] of the blocks near what one depth map saw: sorted, each once.

    Each seen pixel is sampled along its ray from one truncation before to one behind the surface, in steps of half a
    block; a sample takes the 2^3 blocks nearest to it. Where a pixel is wider than half a block, it is sampled at
    several places of its square.
    """
    half = 0.5 * BLOCK * limits.voxel
    rows, columns = np.nonzero((item.depth > 0) & (item.depth <= limits.depth_limit))
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    depth = item.depth[rows, columns].astype(np.float64)
    width = float(depth.max()) / min(item.camera.fx, item.camera.fy)
    parts = max(1, int(np.ceil(width / half)))
    shifts = (np.arange(parts) + 0.5) / parts - 0.5
    steps = int(np.ceil(2 * limits.truncation / half)) + 1
    found: list[np.ndarray] = []
    lower, half_dims = np.asarray(limits.lower), 2 * np.asarray(dims)
    for dx in shifts:
        for dy in shifts:
            for offset in np.linspace(-limits.truncation, limits.truncation, steps):
                points = backproject(item.camera, depth + offset, rows + dy, columns + dx)
                cells = np.floor((points - lower) / half).astype(np.int64)
                cells = cells[((cells >= 0) & (cells < half_dims)).all(axis=1)]
                flat = (cells[:, 0] * half_dims[1] + cells[:, 1]) * half_dims[2] + cells[:, 2]
                # neighbours in a row mostly share a cell: drop repeats before sorting
                found.append(np.unique(flat[np.flatnonzero(np.diff(flat, prepend=-1))]))
    flat = np.unique(np.concatenate(found))
    cells = np.stack(np.unravel_index(flat, tuple(half_dims)), axis=1)
    base = (cells - 1) >> 1  # the lower of the two nearest blocks along each axis
    keys = []
    for corner in range(8):
        block = base + np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        block = block[((block >= 0) & (block < dims)).all(axis=1)]
        keys.append((block[:, 0] * dims[1] + block[:, 1]) * dims[2] + block[:, 2])
    return np.unique(np.concatenate(keys))


@dataclass(frozen=True)
class Budget:
    """The bound on memory, and the advice when it is reached."""

    limits: FusionLimits
    max_bytes: int
    side: float | None = None  # wu, of a cube that is made of whole steps of blocks
    step: int = 1  # voxels

    def check(self, blocks: int, colored: bool, *, partial: bool) -> None:
        """Stop when over the bound. While frames still come, count on (keys are small) up to 16 times the bound."""
        need = blocks * block_bytes(colored)
        if need <= self.max_bytes or (partial and need <= 16 * self.max_bytes):
            return
        voxel = self.limits.voxel * (need / self.max_bytes) ** 0.5 * 1.1  # a surface: blocks go with voxel^-2
        if self.side is not None:
            voxel = 1.005 * self.side / (max(1, int(self.side / voxel) // self.step) * self.step)
        least = "at least " if partial else ""
        raise ProtocolError(
            f"a volume of at most {self.max_bytes / 2**30:.3g} GiB was expected, voxels of {self.limits.voxel:.4g} wu "
            f"need {least}{need / 2**30:.3g} GiB; use a voxel of about {voxel:.3g} wu, a smaller bbox, or more memory"
        )


def integrate(volume: Volume, view: View, pool: ThreadPoolExecutor) -> None:
    """Add one view to every block it can see."""
    size = BLOCK * volume.limits.voxel
    origins = np.asarray(volume.limits.lower) + volume.blocks * size  # [M, 3]
    radius = 0.5 * np.sqrt(3.0) * size
    rows = block_visibility(view, origins + 0.5 * (size - volume.limits.voxel), radius, volume.limits.truncation)
    local = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1) * volume.limits.voxel  # [512, 3]
    offsets = np.ascontiguousarray((local @ view.projection[:, :3].T).T, dtype=np.float32)  # [3, 512] of (x z, y z, z)
    bases = (origins @ view.projection[:, :3].T + view.projection[:, 3]).astype(np.float32)  # [M, 3]
    chunks = [rows[i : i + _CHUNK] for i in range(0, len(rows), _CHUNK)]
    for done in pool.map(lambda chunk: _integrate_chunk(volume, view, chunk, bases[chunk], offsets), chunks):
        assert done is None  # exhausts the map: an exception in a thread is raised here


def _integrate_chunk(volume: Volume, view: View, rows: np.ndarray, bases: np.ndarray, offsets: np.ndarray) -> None:
    """Add one view to some blocks; chunks share no block, so threads do not meet."""
    truncation = np.float32(volume.limits.truncation)
    z = bases[:, 2:] + offsets[2]  # [n, 512]
    x = (bases[:, :1] + offsets[0]) / z
    y = (bases[:, 1:2] + offsets[1]) / z
    distance, pixel = view.signed_distance(x, y, z)  # hugely negative where the pixel saw nothing
    distance /= truncation
    weight = (distance + np.float32(1)) / np.float32(1 - FULL_WEIGHT_BEHIND)
    np.clip(weight, 0, 1, out=weight)
    if view.weight is not None:
        weight *= view.weight[pixel]
    if volume.color is not None and volume.color_weight is not None and view.color is not None:
        _blend_colors(volume.color, volume.color_weight, view, rows, distance, weight, pixel)
    np.minimum(distance, 1, out=distance)
    old = volume.weight[rows]
    total = old + weight
    tsdf = volume.tsdf[rows]
    step = weight / np.maximum(total, np.float32(1e-20))
    distance -= tsdf
    distance *= step
    tsdf += distance
    volume.tsdf[rows] = tsdf
    volume.weight[rows] = total


def _blend_colors(
    color: np.ndarray,
    color_weight: np.ndarray,
    view: View,
    rows: np.ndarray,
    distance: np.ndarray,
    weight: np.ndarray,
    pixel: np.ndarray,
) -> None:
    """Running mean of colour, in the voxels near the surface of this view; the nearer, the more it counts."""
    assert view.color is not None
    near = np.flatnonzero((weight > 0) & (distance < 1))  # flat in the chunk
    flat = rows[near >> 9] * VOXELS + (near & (VOXELS - 1))
    w = weight.reshape(-1)[near] * (1 - np.abs(distance.reshape(-1)[near]))
    colors, weights = color.reshape(-1, 3), color_weight.reshape(-1)
    total = weights[flat] + w
    old = colors[flat]
    old += (view.color[pixel.reshape(-1)[near]] - old) * (w / np.maximum(total, np.float32(1e-20)))[:, None]
    colors[flat] = old
    weights[flat] = total
