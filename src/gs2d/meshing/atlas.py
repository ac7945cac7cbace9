"""From a mesh to a texture atlas: fewer faces, charts, and which point of the surface every texel shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.extras import install
from gs2d.core.mesh import Mesh
from gs2d.errors import BackendError, ProtocolError
from gs2d.meshing.raycast import cast_camera

PADDING = 4  # texels between charts: two smaller copies of the texture do not mix them
_BAND = 1 << 20  # texels that are drawn at a time


@dataclass(frozen=True, eq=False)
class Atlas:
    """A mesh whose vertices are split along the seams of a texture.

    Attributes
    ----------
    mesh : Mesh
        As it was before the split.
    source : ndarray [Q] int64
        Vertex of ``mesh`` that each split vertex is.
    faces : ndarray [F, 3] int32
        Split vertices; face f is face f of ``mesh``.
    uv : ndarray [Q, 2] float32
        In [0, 1], from the upper left corner.
    charts : int
    """

    mesh: Mesh
    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    charts: int


@dataclass(frozen=True, eq=False)
class Texels:
    """The T texels of a texture that lie on the mesh, in the order of rows.

    Attributes
    ----------
    size : int
        Side of the square texture.
    index : ndarray [T] int32
        row * size + column.
    face : ndarray [T] int32
    weights : ndarray [T, 2] float32
        Barycentric coordinates of the texel's centre for the first two corners of its face.
    """

    size: int
    index: np.ndarray
    face: np.ndarray
    weights: np.ndarray

    def interpolated(self, values: np.ndarray, faces: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """Vertex values [P, C] at the texels of ``part``, float32 [t, C]."""
        corners = faces[self.face[part]]
        w = self.weights[part]
        values = values.astype(np.float32, copy=False)
        result = values[corners[:, 2]]
        for k in range(2):
            result += w[:, k, None] * (values[corners[:, k]] - values[corners[:, 2]])
        return np.asarray(result)


def required(module: str) -> Any:
    """Return a package of the extra ``texture``.

    Raises
    ------
    BackendError
        It is not installed.
    """
    import importlib

    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise BackendError(
            f"--texture needs {module}, which is not installed; {install('texture')}, or leave --texture out"
        ) from error


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Simplify to at most ``faces`` triangles, by quadric edge collapse; a changed mesh has no vertex colours.

    Raises
    ------
    BackendError, ProtocolError
    """
    if faces < 4:
        raise ProtocolError(f"--faces must be a whole number >= 4, got {faces}")
    if len(mesh.faces) <= faces:
        return mesh
    vertices = mesh.vertices.astype(np.float64)
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0  # the library works in floats
    points, triangles = required("fast_simplification").simplify(
        np.ascontiguousarray((vertices - middle) / size, np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
        target_count=faces,
    )
    return Mesh((points.astype(np.float64) * size + middle).astype(mesh.vertices.dtype), triangles.astype(np.int32))


def unwrap(mesh: Mesh, size: int) -> Atlas:
    """Cut a mesh into charts and pack them into the unit square, ``PADDING`` texels of a texture of ``size`` apart.

    Raises
    ------
    BackendError
        The package xatlas is missing.
    ProtocolError
        The mesh has no faces.
    """
    xatlas = required("xatlas")
    if not len(mesh.faces):
        raise ProtocolError("a texture needs a mesh with faces, got none; extract it with other limits")
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, PADDING, True
    vertices = mesh.vertices.astype(np.float64)
    vertices = (vertices - vertices.mean(axis=0)) / (float(np.ptp(vertices, axis=0).max()) or 1.0)
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack, False)
    source, faces, uv = atlas[0]
    uv = np.nan_to_num(uv.astype(np.float32))  # faces without area have no place in it
    return Atlas(mesh, source.astype(np.int64), faces.astype(np.int32), uv, int(atlas.chart_count))


def texels_of(atlas: Atlas, size: int) -> Texels:
    """Return the texels whose centres lie in a chart, drawn a band of rows at a time.

    The charts lie on the plane z = 1 before a camera with f = 1, so the ray caster of the demo draws them.
    """
    rows = max(1, _BAND // size)
    flat = np.concatenate([atlas.uv.astype(np.float64) * size, np.ones((len(atlas.uv), 1))], axis=1)
    index, face, weights = [], [], []
    for row in range(0, size, rows):
        camera = Camera(size, min(rows, size - row), 1.0, 1.0, 0.0, float(-row), np.eye(4))
        hits = cast_camera(flat, atlas.faces, camera)
        hit = np.flatnonzero(hits.face.reshape(-1) >= 0)
        index.append((hit + row * size).astype(np.int32))
        face.append(hits.face.reshape(-1)[hit])
        weights.append(hits.weights.reshape(-1, 3)[hit, :2])
    return Texels(size, np.concatenate(index), np.concatenate(face), np.concatenate(weights))


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return unit normals [P, 3] float32: face normals weighted by area; (0, 0, 1) at vertices of no area."""
    vertices = mesh.vertices.astype(np.float64)
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    summed = np.zeros_like(vertices)
    for axis in range(3):
        for k in range(3):
            summed[:, axis] += np.bincount(mesh.faces[:, k], areas[:, axis], len(vertices))
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.where(length > 0, summed / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0)).astype(np.float32)
