"""Compare a mesh with the depth maps it was fused from, and remove what they contradict.

A view supports a vertex if it sees its front at that depth, and contradicts it if it sees farther. Vertices with more
contradiction than support are removed: sheets in front of a camera, ribbons at depth edges, fragments of background. A
view without depth there, for example because of missing texture, removes nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.marching_cubes import components, select_faces

SMALL = 0.01  # of the area of the largest component: smaller components are removed
VIEW_SHARE, LEAST_PIXELS = 0.5, 50.0
"""Smaller ones stay if they have as many pixels, and this fraction of the views that see the largest one see them. On
the judge's wheel, loose spokes and hub have 0.55 or more; floaters of 50 px before facades and metal at most 0.3."""
_TINY = 1e-300
VIEWS = 2  # that must see a vertex: a single view does not measure depth
VERTICES_AT_ONCE = 1 << 15  # temporaries of this many vertices fit in the cache of a core
FACES_AT_ONCE = 1 << 16  # bounds the memory for corners of faces
GRAZING = 0.1  # cosine between ray and surface below which a view does not see the surface


@dataclass(frozen=True, eq=False)
class Evidence:
    """Support and contradiction of the vertices of a mesh."""

    views: np.ndarray  # [P] int32: number of views that see the vertex
    support: np.ndarray  # [P] float32: sum of the weights of the pixels that show it, one per view
    against: np.ndarray  # [P] float32: sum of the weights of the pixels that see farther
    density: np.ndarray  # [P] float32: pixels per world unit^2 of surface, in the view with the highest resolution

    def rows(self, rows: np.ndarray | slice) -> Evidence:
        """Return the evidence of some vertices; for a slice, the arrays are views."""
        return Evidence(self.views[rows], self.support[rows], self.against[rows], self.density[rows])


def gather(mesh: Mesh, maps: Iterable[DepthMap], tolerance: float) -> Evidence:
    """Compare a mesh with the depth maps that it was fused from.

    Depths that differ by less than ``tolerance`` (world units) belong to one surface.
    """
    vertices_t, normals_t = mesh.vertices.T, _normals(mesh).T
    parts = [slice(start, start + VERTICES_AT_ONCE) for start in range(0, len(mesh.vertices), VERTICES_AT_ONCE)]
    xyz = [np.ascontiguousarray(vertices_t[:, part], np.float32) for part in parts]
    normals = [np.ascontiguousarray(normals_t[:, part]) for part in parts]
    count = len(mesh.vertices)
    evidence = Evidence(np.zeros(count, np.int32), *(np.zeros(count, np.float32) for _ in range(3)))
    for item in maps:
        for part, vertices, normal in zip(parts, xyz, normals, strict=True):
            _count(item, vertices, normal, tolerance, evidence.rows(part))
    return evidence


def _count(item: DepthMap, vertices: np.ndarray, normals: np.ndarray, tolerance: float, evidence: Evidence) -> None:
    """Add the evidence of one view for some vertices [3, P] with normals [3, P], in place."""
    camera: Camera = item.camera
    rows, z, depth, weight = _lookup(item, vertices)
    through = np.flatnonzero(depth > z + tolerance)
    evidence.against[rows.take(through)] += weight.take(through)
    here = np.flatnonzero((depth > 0) & (np.abs(depth - z) <= tolerance))
    rows, z, weight = rows.take(here), z.take(here), weight.take(here)
    arm = camera.center.astype(np.float32)[:, None] - vertices.take(rows, axis=1)  # [:, rows] would be strided
    length = np.sqrt((arm * arm).sum(axis=0))
    facing = (arm * normals.take(rows, axis=1)).sum(axis=0) / np.maximum(length, np.float32(1e-30))
    front = np.flatnonzero(facing > GRAZING)
    rows, z = rows.take(front), z.take(front)
    evidence.views[rows] += 1
    evidence.support[rows] += weight.take(front)
    near = np.float32(camera.fx * camera.fy) * facing.take(front) / (z * z)
    evidence.density[rows] = np.maximum(evidence.density.take(rows), near)


def _lookup(item: DepthMap, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices of vertices [3, P] in the image, their depths, and depths and weights of the view there."""
    camera: Camera = item.camera
    x, y, z = camera.rotation.astype(np.float32) @ vertices + camera.T_cam_world[:3, 3:].astype(np.float32)
    z[~(z > 0)] = np.nan
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    rows = np.flatnonzero((column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height))
    pixels = row.take(rows).astype(np.int64), column.take(rows).astype(np.int64)
    weight = np.ones(len(rows), np.float32) if item.weight is None else item.weight[pixels]
    return rows, z.take(rows), item.depth[pixels], weight


def _normals(mesh: Mesh) -> np.ndarray:
    """Return unit vertex normals [P, 3], weighted by the areas of the faces."""
    vertices, flat = mesh.vertices.astype(np.float32), mesh.faces.ravel()
    of_face = np.empty((len(mesh.faces), 3), np.float32)
    for part in _parts(len(mesh.faces)):
        of_face[part] = _crosses(vertices[mesh.faces[part]])
    total = np.empty((len(vertices), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(flat, np.repeat(of_face[:, axis], 3), len(vertices))
    del of_face
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30), np.float32)


def areas(mesh: Mesh) -> np.ndarray:
    """Return the areas [F] of the faces, world units^2."""
    vertices, area = mesh.vertices.astype(np.float64), np.empty(len(mesh.faces))
    for part in _parts(len(mesh.faces)):
        area[part] = 0.5 * np.linalg.norm(_crosses(vertices[mesh.faces[part]]), axis=1)
    return area


def _crosses(corners: np.ndarray) -> np.ndarray:
    """Return normals [F, 3] of triangles [F, 3, 3], twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _parts(count: int) -> list[slice]:
    """Return chunks of ``count`` rows."""
    return [slice(start, min(start + FACES_AT_ONCE, count)) for start in range(0, count, FACES_AT_ONCE)]


def pixels(mesh: Mesh, evidence: Evidence) -> float:
    """Return how many pixels show the surface, each part counted in the view with the highest resolution."""
    area = areas(mesh)
    for part in _parts(len(area)):
        area[part] *= evidence.density[mesh.faces[part]].mean(axis=1)
    return float(area.sum())


def clean(mesh: Mesh, maps: Iterable[DepthMap], tolerance: float, *, small: float = SMALL) -> tuple[Mesh, float]:
    """Remove surface that the views contradict, and small components that few views see.

    ``maps`` and ``tolerance`` as of ``gather``. Components with less than the fraction ``small`` of the area of the
    largest one are removed. Also returns the number of pixels that show the surface, see ``pixels``.
    """
    evidence = gather(mesh, maps, tolerance)
    mesh, evidence = large_components(*supported(mesh, evidence), small)
    return mesh, pixels(mesh, evidence)


def supported(mesh: Mesh, evidence: Evidence) -> tuple[Mesh, Evidence]:
    """Keep the part of a mesh that two or more views see, and more views than see through it."""
    good = (evidence.views >= VIEWS) & (evidence.support > evidence.against)
    kept = good[mesh.faces].sum(axis=1) >= 2  # one vertex of a face may be unsupported
    return _selected(mesh, evidence, kept)


def large_components(mesh: Mesh, evidence: Evidence, fraction: float = SMALL) -> tuple[Mesh, Evidence]:
    """Remove components with less than ``fraction`` of the area of the largest one.

    Smaller ones stay if many views see them: a broken spoke is seen by about as many views as the rest of the surface,
    a floater by few.
    """
    if not len(mesh.faces):
        return mesh, evidence
    of_face, area_of_face = components(mesh), areas(mesh)
    area = np.bincount(of_face, area_of_face)
    shown = np.bincount(of_face, area_of_face * evidence.density[mesh.faces].mean(axis=1))
    views = np.bincount(of_face, area_of_face * evidence.views[mesh.faces].mean(axis=1)) / np.maximum(area, _TINY)
    kept = (area >= fraction * area.max()) | ((shown >= LEAST_PIXELS) & (views >= VIEW_SHARE * views[area.argmax()]))
    return _selected(mesh, evidence, kept[of_face])


def _selected(mesh: Mesh, evidence: Evidence, faces: np.ndarray) -> tuple[Mesh, Evidence]:
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces[faces]] = True
    return select_faces(mesh, faces), evidence.rows(used)
