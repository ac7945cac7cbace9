"""Adding one depth map to a volume, natively and on a GPU: the formulas are in ``kernels/core/fuse.h``.

Shapes and types are those of ``meshing/tsdf_volume.py``, the only caller.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.c_structures import filled, structure
from gs2d.kernels.cuda.kernel_arguments import THREADS

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from gs2d.kernels.cuda.launch import Launcher
    from gs2d.kernels.library import Library

VOXELS = 512  # per block


@dataclass(frozen=True)
class FusionOnDevice:
    """Fusion by CUDA kernels, into volumes in device memory."""

    launcher: Launcher
    device: torch.device


def mark_on_cpu(
    library: Library,
    rays: np.ndarray,
    depth: np.ndarray,
    offsets: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    marks: np.ndarray,
) -> None:
    """Mark the blocks of the grid near the samples ``start + (depth + offset) rays``.

    All positions are in halves of a block. ``rays`` [3, P] are float64 directions per world unit of depth, ``depth``
    [P] and ``offsets`` [S] float64 world units, ``start`` [3] is the origin of the rays and ``end`` [3] the end of the
    grid, which begins at 0. ``marks`` [X, Y, Z] bool includes a border of one block on all sides and is changed in
    place.
    """
    rays, depth, offsets = (np.ascontiguousarray(a, np.float64) for a in (rays, depth, offsets))
    arrays = {"rays": rays, "depth": depth, "offsets": offsets, "marks": marks}
    grid = {"start": tuple(start), "end": tuple(end), "padded": marks.shape}
    library.call("gs2d_mark_blocks", **arrays, **grid, count=len(depth), steps=len(offsets))


def arguments_of(
    size: tuple[int, int], truncation: float, arrays: dict[str, np.ndarray | None] | dict[str, Tensor | None]
) -> ctypes.Structure:
    """Return the arguments for a depth map of ``size`` (height, width).

    ``arrays`` has the names of the fields. The arrays must be contiguous float32 (``rows``: int64) and outlive the
    result.
    """
    rows = arrays["rows"]
    assert rows is not None
    for name, array in arrays.items():
        if array is None:
            continue
        dtype = "int64" if name == "rows" else "float32"
        contiguous = array.flags.c_contiguous if isinstance(array, np.ndarray) else array.is_contiguous()
        if not contiguous or str(array.dtype).removeprefix("torch.") != dtype:
            raise ShapeError(f"{name} must be contiguous {dtype} for the fusion kernels, got {array.dtype}")
    sizes = {"blocks": len(rows), "height": size[0], "width": size[1]}
    return filled(structure("FuseArguments", "core/fuse.h"), **arrays, **sizes, truncation=truncation)


def fuse_on_cpu(library: Library, arguments: ctypes.Structure) -> None:
    """Fuse the depth map, with the library's number of threads; BackendError if the library computes in float64."""
    if library.dtype.itemsize != 4:
        raise BackendError(
            f"depth maps are fused in float32, got the {library.variant} kernels; unset GS2D_CPU_VARIANT"
        )
    library.call("gs2d_fuse", arguments)


def fuse_on_gpu(launcher: Launcher, arguments: ctypes.Structure) -> None:
    """Fuse the depth map: one launch on the current stream."""
    launcher.launch("fuse_voxels", arguments.blocks * (VOXELS // THREADS), THREADS, arguments)
