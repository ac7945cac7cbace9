"""A block-sparse truncated signed distance field (Curless and Levoy 1996), fused from depth maps.

Space is a grid of voxels, of which only blocks of 8^3 near observed surfaces are allocated. A voxel starts as unknown
(weight 0), neither inside nor outside, so unobserved space creates no surface. A view updates a voxel at depth z, seen
through a pixel of depth d, with a running mean of min(1, (d - z) / truncation). Free space in front of the surface
clears voxels of allocated blocks. Behind the surface the weight falls to zero at the truncation, so that the two sides
of a thin plate do not interfere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gs2d.errors import ProtocolError
from gs2d.kernels.library import load
from gs2d.kernels.tsdf import FusionOnDevice, arguments_of, fuse_on_cpu, fuse_on_gpu, mark_on_cpu
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.fusion_bounds import FusionBounds, backproject
from gs2d.meshing.sampling import DepthSampler, block_visibility, make_sampler, may_see
from gs2d.render.backends import Backend, get_backend

# -- the volume --------------------------------------------------------------------------------------------------------
BLOCK = 8  # voxels along the side of a block
VOXELS = BLOCK**3
MAX_BLOCKS = 2**30  # of a box; finding the touched ones takes up to a byte for each


@dataclass(frozen=True, eq=False)
class Volume:
    """The fused field. Voxel (i, j, k) of block b is the point ``lower + (8 blocks[b] + (i, j, k)) * voxel``."""

    limits: FusionBounds
    dims: tuple[int, int, int]  # size of the box in blocks along x, y, z
    keys: np.ndarray  # [M] int64, sorted: (x * dims[1] + y) * dims[2] + z of each block
    # [M, 512] float32 in units of the truncation, positive towards the cameras; voxels in x, y, z order, z fastest
    tsdf: np.ndarray
    weight: np.ndarray  # [M, 512] float32; 0 means unknown
    color: np.ndarray | None  # [M, 512, 3] float32, 0 to 255, from views with a surface near the voxel
    color_weight: np.ndarray | None  # [M, 512] float32

    @property
    def blocks(self) -> np.ndarray:
        """Block coordinates [M, 3] int64."""
        return np.stack(np.unravel_index(self.keys, self.dims), axis=1)


def block_bytes(colored: bool) -> int:
    """Return the size of one block of a volume in bytes."""
    return 8 + VOXELS * 4 * (6 if colored else 2)


def invalid_volume(limits: FusionBounds, dims: tuple[int, int, int], keys: np.ndarray, *, colored: bool) -> Volume:
    """Allocate blocks with unknown voxels."""
    m = len(keys)
    return Volume(
        limits=limits,
        dims=dims,
        keys=keys,
        tsdf=np.zeros((m, VOXELS), np.float32),
        weight=np.zeros((m, VOXELS), np.float32),
        color=np.zeros((m, VOXELS, 3), np.float32) if colored else None,
        color_weight=np.zeros((m, VOXELS), np.float32) if colored else None,
    )


def check_truncation(limits: FusionBounds) -> None:
    """Raise ProtocolError if the truncation exceeds the box: then all of it would be near a surface."""
    if not limits.truncation <= max(limits.side, 20 * limits.voxel):
        raise ProtocolError(
            f"the truncation must not exceed the side of the box, {limits.side:.4g} world units, got "
            f"{limits.truncation:.4g}; omit it, or use a larger bbox"
        )


def block_grid(limits: FusionBounds) -> tuple[int, int, int]:
    """Return the size of the box in blocks along x, y, z; ProtocolError if it has more than ``MAX_BLOCKS``."""
    size = np.subtract(limits.upper, limits.lower)
    dims = np.ceil(size / (BLOCK * limits.voxel)) + 1
    if not np.isfinite(dims).all() or np.prod(dims) > MAX_BLOCKS:
        raise ProtocolError(
            f"the voxel is too small for a box of {size.max():.4g} world units, got {limits.voxel:.4g}; increase it"
        )
    return int(dims[0]), int(dims[1]), int(dims[2])


class VolumeTooLargeError(ProtocolError):
    """The volume exceeds its limit; ``voxel``, in world units, is estimated to fit."""

    def __init__(self, voxel: float, message: str) -> None:
        super().__init__(message)
        self.voxel = voxel


@dataclass(frozen=True)
class Budget:
    """Memory limit of a volume, with a hint in its error."""

    limits: FusionBounds
    max_bytes: int
    side: float | None = None  # world units; of a cube that consists of whole steps
    step: int = 1  # voxels

    def check(self, blocks: int, colored: bool, *, partial: bool) -> None:
        """Raise if over the limit. While frames are still counted (``partial``), only at 16 times the limit."""
        need = blocks * block_bytes(colored)
        if need <= self.max_bytes or (partial and need <= 16 * self.max_bytes):
            return
        voxel = self.limits.voxel * (need / self.max_bytes) ** 0.5 * 1.1  # a surface: blocks go with voxel^-2
        if self.side is not None:
            voxel = 1.005 * self.side / (max(1, int(self.side / voxel) // self.step) * self.step)
        least = "at least " if partial else ""
        raise VolumeTooLargeError(
            voxel,
            f"expected a volume of at most {self.max_bytes / 2**30:.3g} GiB, voxels of {self.limits.voxel:.4g} world "
            f"units need {least}{need / 2**30:.3g} GiB; use a voxel of about {voxel:.3g} or more, a smaller bbox, or "
            "more memory",
        )


# -- one view ----------------------------------------------------------------------------------------------------------
FULL_WEIGHT_BEHIND = 0.75  # of the truncation: the weight falls from 1 here to 0 at the truncation

Add = Callable[[DepthSampler], None]


def fusion_backend(backend: str | Backend) -> Backend:
    """Return the backend of the fusion: "cpu" for "auto", and for a backend without fusion of its own."""
    chosen = get_backend("cpu" if backend == "auto" else backend) if isinstance(backend, str) else backend
    return get_backend("cpu") if chosen.fusion() is None else chosen


def _changed(volume: Volume, view: DepthSampler) -> dict[str, np.ndarray | None]:
    """Project the blocks that a view may change into it, by kernel argument.

    ``rows`` [n] int64 are these blocks, ``bases`` [n, 3] float32 (x z, y z, z) of their first voxels, ``offsets``
    [3, 512] float32 of a voxel from there.
    """
    limits, voxel = volume.limits, volume.limits.voxel
    origins = np.asarray(limits.lower) + volume.blocks * (BLOCK * voxel)  # [M, 3] of first voxels
    local = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1) * voxel  # [512, 3] from there
    size = BLOCK * voxel
    radius = 0.5 * np.sqrt(3.0) * size
    rows = block_visibility(view, origins + 0.5 * (size - voxel), radius, limits.truncation)
    rotation, shift = view.projection[:, :3].T, view.projection[:, 3]
    offsets = np.ascontiguousarray((local @ rotation).T, dtype=np.float32)
    bases = (origins[rows] @ rotation + shift).astype(np.float32)
    return {"rows": rows, "bases": bases, "offsets": offsets}


@contextmanager
def integrator(volumes: Sequence[Volume], device: FusionOnDevice | None) -> Iterator[Add]:
    """Yield a function that adds a view to volumes, which hold the result at the end.

    On a GPU (``device``) the volumes stay there until the end. Without one it is the native CPU library, with its
    number of threads, on which the result does not depend.
    """

    def placed(arrays: dict[str, np.ndarray | None]) -> dict[str, Any]:
        if device is None:
            return arrays
        return {name: None if a is None else torch.from_numpy(a).to(device.device) for name, a in arrays.items()}

    volumes = [volume for volume in volumes if len(volume.keys)]
    placed_arrays = [placed(_volume_arrays(volume)) for volume in volumes]
    colored = any(volume.color is not None for volume in volumes)

    def add(view: DepthSampler) -> None:
        image = placed(_view_arrays(view, colored=colored))
        for volume, tensors in zip(volumes, placed_arrays, strict=True):
            arrays = image | placed(_changed(volume, view)) | tensors
            arguments = arguments_of((view.height, view.width), volume.limits.truncation, arrays)
            if device is None:
                fuse_on_cpu(load(), arguments)
            else:
                fuse_on_gpu(device.launcher, arguments)

    yield add
    if device is not None:
        for volume, tensors in zip(volumes, placed_arrays, strict=True):
            for name, array in _volume_arrays(volume).items():
                if array is not None:
                    array[...] = tensors[name].cpu().numpy()


def _view_arrays(view: DepthSampler, *, colored: bool) -> dict[str, np.ndarray | None]:
    """Return the pixel arrays of a view, by kernel argument."""
    arrays = {"depth": view.depth, "slope_x": view.slope_x, "slope_y": view.slope_y}
    return arrays | {"pixel_weight": view.weight, "pixel_color": view.color if colored else None}


def _volume_arrays(volume: Volume) -> dict[str, np.ndarray | None]:
    """Return the arrays that fusion changes, by kernel argument."""
    return {name: getattr(volume, name) for name in ("tsdf", "weight", "color", "color_weight")}


# -- all views ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class VolumeBlocks:
    """The blocks near the surfaces of depth maps; ``dims`` and ``keys`` as in ``Volume``."""

    dims: tuple[int, int, int]
    keys: np.ndarray
    colored: bool  # whether a depth map has colour

    @property
    def nbytes(self) -> int:
        """Size in bytes of a volume with these blocks."""
        return len(self.keys) * block_bytes(self.colored)

    def part(self, start: int, stop: int) -> VolumeBlocks:
        """Return a range of the blocks."""
        return replace(self, keys=self.keys[start:stop])


def find_blocks(
    frames: Iterable[DepthMap],
    limits: FusionBounds,
    *,
    max_bytes: int = 4 << 30,
) -> VolumeBlocks:
    """Find the blocks to fuse.

    Raises ProtocolError if the blocks near the surface need more than ``max_bytes`` (the message suggests a voxel), the
    truncation exceeds the box, or no depth is inside the limits.
    """
    check_truncation(limits)
    dims = block_grid(limits)
    (keys,), colored = gather_keys(frames, lambda item: [touched_blocks(item, limits, dims)], Budget(limits, max_bytes))
    return VolumeBlocks(dims, keys, colored)


def gather_keys(
    frames: Iterable[DepthMap], touched: Callable[[DepthMap], list[np.ndarray]], budget: Budget
) -> tuple[list[np.ndarray], bool]:
    """Return the keys of the blocks near the surfaces of depth maps, and whether any has colour.

    ``touched`` returns those of one depth map, in one array for each level of the volume.
    """
    keys: list[np.ndarray] = []
    colored = False
    for item in frames:
        colored = colored or item.color is not None
        blocks = touched(item)
        keys = [merged(*pair) for pair in zip(keys or blocks, blocks, strict=True)]
        budget.check(sum(map(len, keys)), colored, partial=True)
    budget.check(sum(map(len, keys)), colored, partial=False)
    if not any(map(len, keys)):
        raise ProtocolError("no depth is inside the limits of the fusion; increase bbox or depth_limit")
    return keys, colored


def fuse_blocks(
    frames: Iterable[DepthMap],
    limits: FusionBounds,
    blocks: VolumeBlocks,
    *,
    backend: str | Backend = "auto",
) -> Volume:
    """Fuse depth maps into these blocks; ``backend`` is "cuda", or the native CPU library for every other name."""
    volume = invalid_volume(limits, blocks.dims, blocks.keys, colored=blocks.colored)
    add_all([volume], frames, lambda item: make_sampler(item, limits), backend=backend)
    return volume


def add_all(
    volumes: Sequence[Volume],
    frames: Iterable[DepthMap],
    prepare: Callable[[DepthMap], DepthSampler],
    *,
    backend: str | Backend,
) -> None:
    """Add depth maps to volumes, in place. Views that see no volume are skipped, since preparing a view is slow."""
    boxes = [box_corners(volume) for volume in volumes if len(volume.keys)]
    with integrator(volumes, fusion_backend(backend).fusion()) as add:
        for item in frames:
            if any(may_see(item.camera, box) for box in boxes):
                add(prepare(item))


def box_corners(volume: Volume) -> np.ndarray:
    """Return the corners [8, 3], world units, of the bounding box of a volume's blocks."""
    blocks, size = volume.blocks, BLOCK * volume.limits.voxel
    box = np.array([blocks.min(axis=0) * size, (blocks.max(axis=0) + 1) * size]) + np.asarray(volume.limits.lower)
    return np.array([[box[c >> axis & 1, axis] for axis in range(3)] for c in range(8)])


def touched_blocks(item: DepthMap, limits: FusionBounds, dims: tuple[int, int, int]) -> np.ndarray:
    """Return the sorted keys [K] of the blocks near the surface of one depth map.

    Each valid pixel is sampled along its ray from one truncation in front of the surface to one behind it, in steps of
    half a block; a sample touches the nearest 2^3 blocks. Pixels wider than half a block are sampled at several
    positions.
    """
    half = 0.5 * BLOCK * limits.voxel
    rows, columns = np.nonzero((item.depth > 0) & (item.depth <= limits.depth_limit))
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    depth = item.depth[rows, columns].astype(np.float64)
    width = float(depth.max(initial=0.0)) / min(item.camera.fx, item.camera.fy)  # of the farthest pixel
    parts, steps = max(1, int(np.ceil(width / half))), int(np.ceil(2 * limits.truncation / half)) + 1
    shifts = (np.arange(parts) + 0.5) / parts - 0.5
    offsets = np.linspace(-limits.truncation, limits.truncation, steps)
    # The lower of the two nearest blocks along each axis; the grid has a border of one block.
    padded = (dims[0] + 2, dims[1] + 2, dims[2] + 2)
    strides = (padded[1] * padded[2], padded[2], 1)
    start = (item.camera.center - limits.lower) / half  # in half blocks, as everything below
    end = 2 * np.asarray(dims)
    marks = np.zeros(padded, bool)
    library = load()
    for dx in shifts:
        for dy in shifts:
            ends = backproject(item.camera, np.ones(len(rows)), rows + dy, columns + dx)
            ray = (ends - item.camera.center).T / half
            mark_on_cpu(library, ray, depth, offsets, start, end, marks)
    first = np.flatnonzero(marks)
    corners = [sum(strides[axis] * (c >> axis & 1) for axis in range(3)) for c in range(8)]
    touched = marks.reshape(-1)
    for corner in corners:
        touched[first + corner] = True
    blocks = np.stack(np.unravel_index(np.flatnonzero(touched), padded)) - 1
    x, y, z = blocks[:, ((blocks >= 0) & (blocks < np.asarray(dims)[:, None])).all(axis=0)]
    return (x * dims[1] + y) * dims[2] + z


def merged(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the sorted union of two sorted arrays of keys >= 0."""
    both = np.sort(np.concatenate([one, other]), kind="stable")  # fast, because both parts are sorted
    return both[np.flatnonzero(np.diff(both, prepend=-1))]
