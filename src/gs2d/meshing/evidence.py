"""What the photographs say about each part of a mesh, and a mesh that holds no more than they do.

A view supports a vertex if it looks at its front and has its own surface there, and contradicts it if it sees farther.
A vertex goes if more views contradict it than support it: sheets before a camera, ribbons at depth edges and shreds of
background do. A view that says nothing, for example because of missing texture, removes nothing. Faces are as many as
the pixels that saw the surface best, not as the voxels that it was cut from.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.marching_cubes import components, select_faces
from gs2d.meshing.simplify import collapse

SMALL = 0.01  # of the largest component's area: smaller ones go
VIEWS = 2  # that see a vertex: a single view does not measure depth
FACES_A_PIXEL = 2.0  # a depth map has as many
VERTICES_AT_ONCE = 1 << 15  # by all views in turn: what is made of so many stays in a core's cache
FACES_AT_ONCE = 1 << 16  # corners of all faces, nine numbers each, were most of what cleaning a mesh took
GRAZING = 0.1  # cosine between a view's ray and a face, below which the view does not see it


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the views say of the vertices of a mesh.

    Attributes
    ----------
    views : ndarray [P] int32
        Views that see it.
    support : ndarray [P] float32
        Sum of the weights of the pixels that show it, one of each view.
    against : ndarray [P] float32
        The same of the pixels that see farther where it lies.
    density : ndarray [P] float32
        Pixels per world unit^2 of surface in the view that saw it best.
    """

    views: np.ndarray
    support: np.ndarray
    against: np.ndarray
    density: np.ndarray

    def rows(self, rows: np.ndarray | slice) -> Evidence:
        """Return the evidence of some vertices; a view of it for a slice."""
        return Evidence(self.views[rows], self.support[rows], self.against[rows], self.density[rows])


def gather(mesh: Mesh, maps: Iterable[DepthMap], tolerance: float) -> Evidence:
    """Compare a mesh with the depth maps that it was fused from.

    Parameters
    ----------
    mesh : Mesh
    maps : iterable of DepthMap
    tolerance : float
        World units. Depths that differ by less are of one surface.
    """
    places, normals = mesh.vertices.T, _normals(mesh).T
    parts = [slice(start, start + VERTICES_AT_ONCE) for start in range(0, len(mesh.vertices), VERTICES_AT_ONCE)]
    xyz = [np.ascontiguousarray(places[:, part], np.float32) for part in parts]
    ahead = [np.ascontiguousarray(normals[:, part]) for part in parts]
    count = len(mesh.vertices)
    found = Evidence(np.zeros(count, np.int32), *(np.zeros(count, np.float32) for _ in range(3)))
    for item in maps:
        for part, vertices, normal in zip(parts, xyz, ahead, strict=True):
            _count(item, vertices, normal, tolerance, found.rows(part))
    return found


def _count(item: DepthMap, vertices: np.ndarray, normals: np.ndarray, tolerance: float, found: Evidence) -> None:
    """Add what one view says of some vertices [3, P] with normals [3, P] to their evidence, in place."""
    camera: Camera = item.camera
    rows, z, seen, weight = _look(item, vertices)
    through = np.flatnonzero(seen > z + tolerance)
    found.against[rows.take(through)] += weight.take(through)
    here = np.flatnonzero((seen > 0) & (np.abs(seen - z) <= tolerance))
    rows, z, weight = rows.take(here), z.take(here), weight.take(here)
    arm = camera.center.astype(np.float32)[:, None] - vertices.take(rows, axis=1)  # [:, rows] would be strided
    length = np.sqrt((arm * arm).sum(axis=0))
    facing = (arm * normals.take(rows, axis=1)).sum(axis=0) / np.maximum(length, np.float32(1e-30))
    front = np.flatnonzero(facing > GRAZING)
    rows, z = rows.take(front), z.take(front)
    found.views[rows] += 1
    found.support[rows] += weight.take(front)
    near = np.float32(camera.fx * camera.fy) * facing.take(front) / (z * z)
    found.density[rows] = np.maximum(found.density.take(rows), near)


def _look(item: DepthMap, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return indices of the vertices [3, P] in the image, their depths, and the view's own depths and weights there."""
    camera: Camera = item.camera
    x, y, z = camera.rotation.astype(np.float32) @ vertices + camera.T_cam_world[:3, 3:].astype(np.float32)
    z[~(z > 0)] = np.nan
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    rows = np.flatnonzero((column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height))
    pixels = row.take(rows).astype(np.int64), column.take(rows).astype(np.int64)
    weight = np.ones(len(rows), np.float32) if item.weight is None else item.weight[pixels]
    return rows, z.take(rows), item.depth[pixels], weight


def _normals(mesh: Mesh) -> np.ndarray:
    """Return unit normals [P, 3] of the vertices, by the areas of their faces."""
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
    vertices, found = mesh.vertices.astype(np.float64), np.empty(len(mesh.faces))
    for part in _parts(len(mesh.faces)):
        found[part] = 0.5 * np.linalg.norm(_crosses(vertices[mesh.faces[part]]), axis=1)
    return found


def _crosses(corners: np.ndarray) -> np.ndarray:
    """Return normals [F, 3] of triangles [F, 3, 3], twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _parts(count: int) -> list[slice]:
    """Rows, some at a time."""
    return [slice(start, min(start + FACES_AT_ONCE, count)) for start in range(0, count, FACES_AT_ONCE)]


def pixels(mesh: Mesh, evidence: Evidence) -> float:
    """Return how many pixels the surface has, each part of it in the view that saw it best."""
    found = areas(mesh)
    for part in _parts(len(found)):
        found[part] *= evidence.density[mesh.faces[part]].mean(axis=1)
    return float(found.sum())


@dataclass(frozen=True)
class Cleaned:
    """A mesh that holds what the views saw, and what was found on the way.

    Attributes
    ----------
    mesh : Mesh
    pixels : float
        That its surface has, each part of it in the view that saw it best.
    unsupported, small : float
        Parts of the area that went because views contradict them, and because they lay apart.
    """

    mesh: Mesh
    pixels: float
    unsupported: float
    small: float


def clean(mesh: Mesh, maps: Iterable[DepthMap], tolerance: float) -> Cleaned:
    """Leave of a mesh what the views saw.

    Parameters
    ----------
    maps : iterable of DepthMap
        Those that it was fused from.
    tolerance : float
        As for ``gather``.
    """
    evidence = gather(mesh, maps, tolerance)
    left = [float(areas(mesh).sum())]
    mesh, evidence = supported(mesh, evidence)  # what is left takes the name: one is held, not three
    left.append(float(areas(mesh).sum()))
    mesh, evidence = large_components(mesh, evidence)
    left.append(float(areas(mesh).sum()))
    found = pixels(mesh, evidence)
    parts = [area / max(left[0], 1e-300) for area in left[1:]]
    return Cleaned(mesh, found, 1 - parts[0], parts[0] - parts[1])


def simplified(cleaned: Cleaned) -> Cleaned:
    """Return a mesh in as many faces as the pixels of its surface carry."""
    return replace(cleaned, mesh=simplified_to(cleaned.mesh, int(FACES_A_PIXEL * cleaned.pixels)))


def supported(mesh: Mesh, evidence: Evidence) -> tuple[Mesh, Evidence]:
    """Return the part of a mesh that two views see, and more than see through it, and its evidence."""
    good = (evidence.views >= VIEWS) & (evidence.support > evidence.against)
    kept = good[mesh.faces].sum(axis=1) >= 2  # the border may hang over by a vertex
    return _selected(mesh, evidence, kept)


def large_components(mesh: Mesh, evidence: Evidence, fraction: float = SMALL) -> tuple[Mesh, Evidence]:
    """Return a mesh without components of less than ``share`` of the area of the largest."""
    if not len(mesh.faces):
        return mesh, evidence
    of_face = components(mesh)
    area = np.bincount(of_face, areas(mesh))
    return _selected(mesh, evidence, (area >= fraction * area.max())[of_face])


def _selected(mesh: Mesh, evidence: Evidence, faces: np.ndarray) -> tuple[Mesh, Evidence]:
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces[faces]] = True
    return select_faces(mesh, faces), evidence.rows(used)


def simplified_to(mesh: Mesh, faces: int) -> Mesh:
    """Return a mesh of about so many faces, by quadric edge collapse; vertices have the colour nearest to them."""
    if len(mesh.faces) <= max(faces, 4):
        return mesh
    vertices = mesh.vertices.astype(np.float64)
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    scaled = np.ascontiguousarray((vertices - middle) / size, np.float32)
    del vertices
    triangles = np.ascontiguousarray(mesh.faces, np.int32)
    points, left = collapse(scaled, triangles, max(faces, 4))
    del scaled, triangles
    points = points * size + middle
    colors = None if mesh.colors is None else mesh.colors[cKDTree(mesh.vertices.astype(np.float64)).query(points)[1]]
    small = Mesh(points.astype(mesh.vertices.dtype), np.asarray(left, np.int32), colors)
    return select_faces(small, np.ones(len(small.faces), bool))
