"""Simplify meshes by quadric edge collapse: fewer faces where the surface is flat, within an error in image pixels.

The two vertices of an edge move to one point x. A vertex that stands for the faces f, with areas a_f, planes
n_f.x + d_f = 0 and image resolutions s_f (pixels per world unit), is then wrong by

    e^2 = sum a_f s_f^2 (n_f.x + d_f)^2 / sum a_f        [px^2]

(Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997). The cost of an edge is the
larger e^2 of its two vertices, so that a large flat region does not average a small detail away, plus a part for the
length of the edge and one for the change of colour. Edges collapse in the order of their costs, up to the square of the
allowed error. Edges of borders add planes perpendicular to the surface, which keep outlines in place.

``kernels/cpu/collapse.cpp`` has the algorithm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.kernels.native_collapse import CollapseArrays, CollapseRules, collapse

POINTS_AT_ONCE = 1 << 16  # temporaries of this many vertices fit in the cache of a core
ACROSS = 1000.0  # px: size of a mesh without cameras
LENGTH = 1e-3  # px of error per px of edge length: limits faces to a thousand times the error, and orders flat ones
TINT = 5.0  # px of error per unit of colour: fine drawings on a flat wall keep some of their vertices
BORDER = 10.0  # weight of the plane of a border edge, times its squared length
TURN = 0.2  # cosine between a face before and after a collapse from which it counts as turned over
PULL = 1e-3  # of the trace of A, towards the middle of the edge: places x where planes do not determine it


def simplify(mesh: Mesh, *, error: float = math.inf, cameras: Sequence[Camera] = (), faces: int = 0) -> Mesh:
    """Simplify a mesh to an error in pixels, or to a number of faces, whichever is reached first.

    ``error`` is the root mean square distance from the surface, px of the nearest image, that collapses may cause;
    without cameras the longest side of the mesh has 1000 px. Vertices get the mean colour of the surface that they
    replace.
    """
    if len(mesh.faces) <= max(faces, 4) or error <= 0:
        return mesh
    vertices = mesh.vertices.astype(np.float64)
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    scale = pixel_scale(vertices, cameras) * size if cameras else np.full(len(vertices), ACROSS)
    colors = None if mesh.colors is None else mesh.colors / 255.0
    arrays = CollapseArrays.of((vertices - middle) / size, mesh.faces, scale, colors)
    del vertices, scale, colors
    rules = CollapseRules(max(faces, 4), error**2, LENGTH**2, TINT**2, BORDER, TURN, PULL)
    collapse(arrays, rules)
    remaining = arrays.corners[arrays.corners[:, 0] >= 0]
    used = np.zeros(len(mesh.vertices), bool)
    used[remaining] = True
    points = arrays.points[used] * size + middle
    painted = None
    if mesh.colors is not None:
        area = np.maximum(arrays.quadric[used, 10:11], np.finfo(np.float64).tiny)
        mean = np.where(area > np.finfo(np.float64).tiny, arrays.color[used, :3] / area, mesh.colors[used] / 255.0)
        painted = np.rint(np.clip(255.0 * mean, 0, 255)).astype(np.uint8)
    return Mesh(points.astype(mesh.vertices.dtype), (np.cumsum(used) - 1)[remaining].astype(np.int32), painted)


def pixel_scale(vertices: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return how many pixels a world unit has at each vertex [P], in the nearest image that it is inside of.

    Occlusion is ignored, which errs towards more pixels. Vertices outside of all images get the median of the others,
    or 1 if there are none.
    """
    scale = np.zeros(len(vertices))
    for start in range(0, len(vertices), POINTS_AT_ONCE):
        points, part = vertices[start : start + POINTS_AT_ONCE].T, scale[start : start + POINTS_AT_ONCE]
        for camera in cameras:
            x, y, z = camera.rotation @ points + camera.T_cam_world[:3, 3:]
            z[~(z > 0)] = np.nan
            column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            np.maximum(part, np.where(inside, math.sqrt(camera.fx * camera.fy) / z, 0), out=part)
    covered = scale > 0
    return np.where(covered, scale, np.median(scale[covered]) if covered.any() else 1.0)
