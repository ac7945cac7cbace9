"""Points on surfaces, and exact distances from points to triangles."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gs2d.triangles import Mesh

_CANDIDATES = 8  # triangles tried for each point


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread evenly over a mesh: ``points`` [n, 3] float64 and the ``faces`` [n] they lie on."""

    points: np.ndarray
    faces: np.ndarray


def face_areas(mesh: Mesh) -> np.ndarray:
    """Area [F] of every face, wu^2."""
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
    """Distance [Q] of each query to the nearest of the points [P, 3]."""
    return np.asarray(cKDTree(points).query(queries, workers=workers or os.cpu_count() or 1)[0])


def distances_to_mesh(
    queries: np.ndarray, mesh: Mesh, *, samples: int = 200_000, seed: int = 0, workers: int | None = None
) -> np.ndarray:
    """Distance [Q] of each query [Q, 3] to the surface.

    The least of the exact distances to the faces of the eight nearest among all face centroids and ``samples`` points
    of the surface. The spacing of the samples does not enter, as it would in a distance to the nearest sample, but for
    the rare query whose nearest face is large and has no sample near: then the distance is too long by less than it.
    """
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    spread = sample_surface(mesh, samples, seed=seed)
    points = np.concatenate([t.mean(axis=1), spread.points])
    owner = np.concatenate([np.arange(len(t)), spread.faces])
    k = min(_CANDIDATES, len(points))
    _, index = cKDTree(points).query(queries, k=k, workers=workers or os.cpu_count() or 1)
    best = np.full(len(queries), np.inf)
    for column in np.reshape(index, (len(queries), k)).T:
        best = np.minimum(best, point_triangle_distances(queries, t[owner[column]]))
    return best


def point_triangle_distances(p: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Distance [n] of points [n, 3] to triangles [n, 3, 3]: to the plane where the foot lies inside, else the edges."""
    a, b, c = t[:, 0], t[:, 1], t[:, 2]
    normal = np.cross(b - a, c - a)
    squared = np.einsum("ni,ni->n", normal, normal)
    inside = squared > 0
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ni,ni->n", np.cross(v - u, p - u), normal) >= 0
    plane = np.abs(np.einsum("ni,ni->n", p - a, normal)) / np.sqrt(np.where(squared > 0, squared, 1))
    edges = np.minimum(np.minimum(_segment(p, a, b), _segment(p, b, c)), _segment(p, c, a))
    return np.where(inside, plane, edges)


def _segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of points to segments."""
    along = b - a
    length = np.einsum("ni,ni->n", along, along)
    s = np.clip(np.einsum("ni,ni->n", p - a, along) / np.where(length > 0, length, 1), 0, 1)
    return np.asarray(np.linalg.norm(p - a - s[:, None] * along, axis=1))
