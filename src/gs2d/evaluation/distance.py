"""Points on surfaces, and exact distances from points to triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gs2d.core.mesh import Mesh
from gs2d.evaluation.nearest import Cloud

_CANDIDATES = 8  # triangles tried for each point
_CHUNK = 1 << 16  # points and triangles at a time


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread evenly over a mesh: ``points`` [n, 3] float64 and the ``faces`` [n] they lie on."""

    points: np.ndarray
    faces: np.ndarray


def face_areas(mesh: Mesh) -> np.ndarray:
    """Area [F] of every face, world units^2."""
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    return np.asarray(0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1))


def sample_surface(mesh: Mesh, count: int, *, seed: int = 0, mask: np.ndarray | None = None) -> SurfaceSamples:
    """``count`` points, area-weighted and stratified along the order of the faces; the same for the same seed.

    Parameters
    ----------
    mask : ndarray [F] bool, optional
        Only these faces.

    Returns
    -------
    SurfaceSamples
        Empty where there is no area.
    """
    areas = face_areas(mesh)
    if mask is not None:
        areas = np.where(mask, areas, 0.0)
    ends = np.cumsum(areas)
    if not len(ends) or ends[-1] <= 0:
        return SurfaceSamples(np.zeros((0, 3)), np.zeros(0, np.int64))
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.random(count)) / count * ends[-1]  # one in each of `count` equal parts of the area
    faces = np.minimum(np.searchsorted(ends, at, side="right"), len(ends) - 1)
    u, v = rng.random((2, count))
    root = np.sqrt(u)  # Turk 1990: (1 - sqrt u) A + sqrt u (1 - v) B + sqrt u v C is uniform
    t = mesh.vertices.astype(np.float64)[mesh.faces[faces]]
    points = (1 - root)[:, None] * t[:, 0] + (root * (1 - v))[:, None] * t[:, 1] + (root * v)[:, None] * t[:, 2]
    return SurfaceSamples(points, faces)


def distances_to_points(queries: np.ndarray, points: np.ndarray, *, workers: int | None = None) -> np.ndarray:
    """Return the distance [Q] of each query to the nearest of the points [P, 3]."""
    return Cloud(points, workers=workers).nearest(queries)[0][:, 0]


def distances_to_mesh(
    queries: np.ndarray,
    mesh: Mesh,
    *,
    samples: int = 200_000,
    seed: int = 0,
    workers: int | None = None,
) -> np.ndarray:
    """Distance [Q] of each query [Q, 3] to the surface.

    The least of the exact distances to the faces of the eight nearest among all face centroids and ``samples`` points
    of the surface. The spacing of the samples does not enter, as it would in a distance to the nearest sample, but for
    the rare query whose nearest face is large and has no sample near: then the distance is too long by less than it.
    """
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    spread = sample_surface(mesh, samples, seed=seed)
    points = np.concatenate([t.mean(axis=1), spread.points])
    _, index = Cloud(points, workers=workers).nearest(queries, neighbours=_CANDIDATES)
    owner = np.concatenate([np.arange(len(t)), spread.faces, [0]])  # there may be fewer than eight points: any face
    return _min_distances(queries, t, owner[index])


def _min_distances(queries: np.ndarray, t: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Least distance [Q] of each query to some of the triangles [F, 3, 3], ``faces`` [Q, K]."""
    corners = _tensor(t)
    best = np.empty(len(queries))
    for start in range(0, len(queries), _CHUNK):
        part = slice(start, start + _CHUNK)
        p, columns = _tensor(queries[part]), _tensor(faces[part], np.int64).unbind(dim=1)
        found = [_triangle_distances(p, corners[column]) for column in columns]
        best[part] = torch.stack(found).amin(dim=0).numpy()
    return best


def point_triangle_distances(p: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Distance [n] of points [n, 3] to triangles [n, 3, 3]: to the plane where the foot lies inside, else the edges."""
    return np.asarray(_triangle_distances(_tensor(p), _tensor(t)).numpy())


def _tensor(array: np.ndarray, dtype: type = np.float64) -> Tensor:
    """Return an array as a tensor: the same memory if it has that type and is writable (torch warns of others)."""
    return torch.from_numpy(np.require(array, dtype, ["C", "W"]))


def _triangle_distances(p: Tensor, t: Tensor) -> Tensor:
    a, b, c = t.unbind(dim=1)
    normal = torch.linalg.cross(b - a, c - a)
    squared = normal.square().sum(dim=1)
    inside = squared > 0
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (torch.linalg.cross(v - u, p - u) * normal).sum(dim=1) >= 0
    plane = ((p - a) * normal).sum(dim=1).abs() / squared.where(squared > 0, 1).sqrt()
    edges = _segment(p, a, b).minimum(_segment(p, b, c)).minimum(_segment(p, c, a))
    return plane.where(inside, edges)


def _segment(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Distance of points to segments."""
    along = b - a
    length = along.square().sum(dim=1)
    s = (((p - a) * along).sum(dim=1) / length.where(length > 0, 1)).clamp(0, 1)
    return (p - a - s[:, None] * along).square().sum(dim=1).sqrt()
