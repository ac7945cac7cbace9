"""Adding depth maps to volumes: in numpy, in native code, or on a GPU, with the same bits in single precision.

numpy is the reference, and runs everywhere. Which of the three adds a view is the matter of a backend.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gs2d.kernels.tsdf import FusionOnHost
from gs2d.meshing.sampling import DepthSampler, block_visibility
from gs2d.meshing.volume import BLOCK, VOXELS, Volume
from gs2d.render.backends import Backend, get_backend

if TYPE_CHECKING:
    import torch

    from gs2d.kernels.cuda.launch import Launcher
    from gs2d.kernels.library import Library

FULL_WEIGHT_BEHIND = 0.75  # of the truncation: the weight falls from 1 here to 0 at the truncation
_CHUNK = 48  # blocks at a time in numpy: the temporaries of a chunk fit the second-level cache

Add = Callable[[DepthSampler], None]


def fusion_backend(backend: str | Backend) -> Backend:
    """Return what will add views: "auto" is the processor's, the native library where it was built, else numpy.

    Raises
    ------
    BackendError
        If the name is unknown, or that backend cannot run here.
    """
    return get_backend(backend, "cpu") if isinstance(backend, str) else backend


def integrator(
    volumes: Sequence[Volume], backend: str | Backend, threads: int | None = None
) -> AbstractContextManager[Add]:
    """Return a context in which views can be added to all volumes; their arrays hold the result after it.

    Parameters
    ----------
    volumes : sequence of Volume
    backend : str or Backend
        "auto", "cpu", "cuda", "reference", or another's name.
    threads : int, optional
        Default: as many as the machine has. The result does not depend on it.

    Raises
    ------
    BackendError
        If the backend is unknown or cannot run here.
    """
    threads = threads or os.cpu_count() or 1
    fusion = fusion_backend(backend).fusion()
    if fusion is None:
        return add_in_numpy(volumes, threads)
    if isinstance(fusion, FusionOnHost):
        return add_natively(volumes, fusion.library, threads)
    return add_on_gpu(volumes, fusion.launcher, fusion.device)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where the blocks of a volume lie."""

    volume: Volume
    origins: np.ndarray  # [M, 3] world units, of each block's first voxel
    local: np.ndarray  # [512, 3] world units, of a voxel from there


@dataclass(frozen=True, eq=False)
class _Change:
    """The blocks that a view may change, and where it sees them."""

    rows: np.ndarray  # [n] int64
    bases: np.ndarray  # [n, 3] float32 (x z, y z, z) of each block's first voxel
    offsets: np.ndarray  # [3, 512] float32, of a voxel from there


def _grids(volumes: Sequence[Volume]) -> list[_Grid]:
    found = []
    for volume in volumes:
        voxel = volume.limits.voxel
        origins = np.asarray(volume.limits.lower) + volume.blocks * (BLOCK * voxel)
        local = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1) * voxel
        if len(volume.keys):
            found.append(_Grid(volume, origins, local))
    return found


def _change(grid: _Grid, view: DepthSampler) -> _Change:
    limits = grid.volume.limits
    size = BLOCK * limits.voxel
    radius = 0.5 * np.sqrt(3.0) * size
    rows = block_visibility(view, grid.origins + 0.5 * (size - limits.voxel), radius, limits.truncation)
    rotation, shift = view.projection[:, :3].T, view.projection[:, 3]
    offsets = np.ascontiguousarray((grid.local @ rotation).T, dtype=np.float32)
    bases = (grid.origins[rows] @ rotation + shift).astype(np.float32)
    return _Change(rows, bases, offsets)


@contextmanager
def add_in_numpy(volumes: Sequence[Volume], threads: int) -> Iterator[Add]:
    """By numpy, on so many threads; the reference of the others."""
    grids = _grids(volumes)
    with ThreadPoolExecutor(threads) as pool:

        def add(view: DepthSampler) -> None:
            for grid in grids:
                change = _change(grid, view)
                starts = range(0, len(change.rows), _CHUNK)
                chunks = [
                    replace(change, rows=change.rows[i : i + _CHUNK], bases=change.bases[i : i + _CHUNK])
                    for i in starts
                ]
                for done in pool.map(lambda chunk, volume=grid.volume: _add_chunk(volume, view, chunk), chunks):
                    assert done is None  # exhausts the map: an exception in a thread is raised here

        yield add


def _add_chunk(volume: Volume, view: DepthSampler, chunk: _Change) -> None:
    """Add one view to some blocks; chunks share no block, so threads do not meet."""
    rows, bases, offsets = chunk.rows, chunk.bases, chunk.offsets
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
    view: DepthSampler,
    rows: np.ndarray,
    distance: np.ndarray,
    weight: np.ndarray,
    pixel: np.ndarray,
) -> None:
    """Update the mean colour of the voxels near the surface of this view; the nearer, the more it counts."""
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


@contextmanager
def add_natively(volumes: Sequence[Volume], library: Library, threads: int) -> Iterator[Add]:
    """By the native library, on so many threads."""
    from gs2d.kernels.tsdf import arguments_of, fuse_on_cpu

    grids = _grids(volumes)

    def add(view: DepthSampler) -> None:
        library.use_threads(threads)
        for grid in grids:
            volume, change = grid.volume, _change(grid, view)
            arrays = _view_arrays(view, colored=volume.color is not None)
            arrays |= {"rows": change.rows, "bases": change.bases, "offsets": change.offsets}
            arrays |= _volume_arrays(volume)
            fuse_on_cpu(library, arguments_of((view.height, view.width), volume.limits.truncation, arrays))

    yield add


@contextmanager
def add_on_gpu(volumes: Sequence[Volume], launcher: Launcher, device: torch.device) -> Iterator[Add]:
    """On a device: the volumes lie there until the end; each view and its list of blocks go there."""
    import torch

    from gs2d.kernels.tsdf import arguments_of, fuse_on_gpu

    def to_device(arrays: dict[str, np.ndarray | None]) -> dict[str, torch.Tensor | None]:
        return {name: None if a is None else torch.from_numpy(a).to(device) for name, a in arrays.items()}

    grids = _grids(volumes)
    held = [to_device(_volume_arrays(grid.volume)) for grid in grids]

    def add(view: DepthSampler) -> None:
        colored = any(grid.volume.color is not None for grid in grids)
        image = to_device(_view_arrays(view, colored=colored))
        for grid, volume in zip(grids, held, strict=True):
            change = _change(grid, view)
            blocks = to_device({"rows": change.rows, "bases": change.bases, "offsets": change.offsets})
            size, truncation = (view.height, view.width), grid.volume.limits.truncation
            fuse_on_gpu(launcher, arguments_of(size, truncation, image | blocks | volume))

    yield add
    for grid, tensors in zip(grids, held, strict=True):
        for name, array in _volume_arrays(grid.volume).items():
            tensor = tensors[name]
            if array is not None and tensor is not None:
                array[...] = tensor.cpu().numpy()


def _view_arrays(view: DepthSampler, *, colored: bool) -> dict[str, np.ndarray | None]:
    """Return the pixels of a view, by the names of the kernels' arguments."""
    arrays = {"depth": view.depth, "slope_x": view.slope_x, "slope_y": view.slope_y}
    return arrays | {"pixel_weight": view.weight, "pixel_color": view.color if colored else None}


def _volume_arrays(volume: Volume) -> dict[str, np.ndarray | None]:
    """Return what fusion changes, by the names of the kernels' arguments."""
    return {name: getattr(volume, name) for name in ("tsdf", "weight", "color", "color_weight")}
