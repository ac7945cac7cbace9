"""Native kernels of mesh refinement; ``meshing/warped_ncc.py`` describes the arrays."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np

from gs2d.core.camera import Camera
from gs2d.kernels.c_structures import structure

if TYPE_CHECKING:
    from gs2d.kernels.library import Library

PLANES = 7  # images in the workspace of a comparison
WARPED, VISIBLE = 0, 2  # of them: the neighbour as the view sees it, and where (1 or 0)
MatchArguments, GatherArguments = (structure(name, "cpu/refine.cpp") for name in ("MatchArguments", "GatherArguments"))


def lens_of(camera: Camera) -> ctypes.Array[ctypes.c_double]:
    """Return fx, fy, cx and cy."""
    return (ctypes.c_double * 4)(camera.fx, camera.fy, camera.cx, camera.cy)


def draw_on_cpu(
    library: Library, vertices: np.ndarray, faces: np.ndarray, camera: Camera, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a mesh; return the nearest face [H, W] and its depth [H, W].

    ``vertices`` are [P, 3] float64, world units, ``faces`` [F, 3] int32. Faces with a vertex nearer than ``near`` are
    left out.
    """
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
    size = (camera.height, camera.width)
    flat = np.empty_like(vertices)
    face, depth = np.empty(size, np.int32), np.empty(size, f"f{library.dtype.itemsize}")
    arrays = {"positions": vertices, "corners": faces, "flat": flat, "face": face, "depth": depth}
    sizes = {"vertices": len(vertices), "faces": len(faces), "width": camera.width, "height": camera.height}
    pose = tuple(camera.T_cam_world[:3].ravel())
    library.call("gs2d_raster_mesh", **arrays, **sizes, lens=lens_of(camera), pose=pose, near=near)
    return face, depth


def gather_on_cpu(library: Library, arguments: ctypes.Structure) -> None:
    """Add derivatives by pixel depth to the vertices."""
    library.call("gs2d_gather_vertices", arguments)


def match_on_cpu(library: Library, arguments: ctypes.Structure) -> None:
    """Add the derivatives of one comparison to the pixels; MemoryError if the rows of a window do not fit."""
    if library.call("gs2d_match_views", arguments) != 0:
        raise MemoryError("gs2d_match_views could not allocate its rows")
