"""Points in gaps of the plane sweep: a minimum cut closes the gaps between swept points.

On bare walls, ceilings and table tops, images do not match. Lines of sight to the swept points determine which
tetrahedra between the points are free, and the cut closes the rest with little area: a rim becomes a ceiling. The
result is a guess, so a point is used where no view sees through it and, in wide gaps, where views show it without
texture. Formulas: docs/math.md, "Dense start".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gs2d.kernels.library import Library
from gs2d.losses.formulas import flatness
from gs2d.meshing.minimum_cut import Lines, cast_votes, outside
from gs2d.meshing.tetrahedra import FACES, divide
from gs2d.training.start.plane_sweep import AGREE, BARE, VOTES, Sweep, project

UNSURE = 2.0  # px: standard deviation of swept depths along their lines of sight, as a width at that depth
# Spacings: facets with an edge longer than the first cross a gap, those with one longer than the last are no surface.
GAP, NARROW, LONGEST = 2.0, 10.0, 60.0
LINES = 8  # of sight, at most, to a point; more of them take memory and change little
THROUGH = 0.03  # a view sees through a point if its depth is larger by this fraction
FACING = 0.1  # smallest cosine between a facet's normal and the direction to a camera that sees it


def gap_points(
    sweep: Sweep, places: np.ndarray, pixel: np.ndarray, cell: float, library: Library
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return points in the gaps between swept points: places [M, 3], colours [M, 3], normals [M, 3], pixel sizes [M].

    ``places`` [P, 3] and ``pixel`` [P], the size of a pixel there, are of the swept points, which are ``cell`` pixels
    apart.
    """
    depths = {
        index: np.where(sweep.consistent(index), sweep.depths[index], 0)
        for index in range(len(sweep.views))
        if sweep.neighbours[index]
    }
    centers = np.stack([-view.T[:3, :3].T @ view.T[:3, 3] for view in sweep.views])
    spacing = cell * pixel
    faces = _facets(sweep, depths, centers, places, pixel, spacing, library)
    corners = places[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1) / spacing[faces].max(axis=1)
    crossing = (edges > GAP) & (edges <= LONGEST)
    samples, which = _spread(corners[crossing], spacing[faces[crossing]].max(axis=1))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[crossing]
    normals = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))[which]
    valid, colors = _supported(sweep, depths, centers, samples, normals, (edges[crossing] <= NARROW)[which])
    return samples[valid], colors[valid], normals[valid], pixel[faces[crossing]].mean(axis=1)[which][valid]


def _facets(
    sweep: Sweep,
    depths: Mapping[int, np.ndarray],
    centers: np.ndarray,
    places: np.ndarray,
    pixel: np.ndarray,
    spacing: np.ndarray,
    library: Library,
) -> np.ndarray:
    """Return the facets of the minimum cut, rows of ``places`` [F, 3], counter-clockwise seen from free space."""
    ends, cameras, count = [], [], np.zeros(len(places), np.int64)
    for index in np.random.default_rng(0).permutation(list(depths)):
        z, column, row, inside = project(sweep.views[index], places)
        visible = inside & (np.abs(depths[index][row, column] - z) <= AGREE * z) & (count < LINES)
        count += visible
        ends.append(np.flatnonzero(visible))
        cameras.append(np.full(len(ends[-1]), index))
    end = np.concatenate(ends)
    space = divide(places, centers, library)
    lines = Lines(
        end.astype(np.int32), centers[np.concatenate(cameras)], UNSURE * pixel[end], np.ones(len(end)), len(end)
    )
    out = outside(space, cast_votes(space, lines, library), library, spacing=spacing)
    inner, facet = np.nonzero(~out[:, None] & (space.neighbours >= 0) & out[space.neighbours])
    faces = np.take_along_axis(space.corners[inner], FACES[facet], 1)[:, [0, 2, 1]]
    return np.asarray(faces[(faces < len(places)).all(axis=1)])


def _spread(corners: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return random points on triangles [F, 3, 3], about one in each square of the spacing [F], and their triangles."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    which = np.repeat(np.arange(len(corners)), np.ceil(area / spacing**2).astype(np.int64))
    u, v = np.random.default_rng(0).random((2, len(which), 1))
    root = np.sqrt(u)  # Turk 1990: uniform over the triangle
    a, b, c = (corners[which, k] for k in range(3))
    return (1 - root) * a + root * (1 - v) * b + root * v * c, which


def _supported(
    sweep: Sweep,
    depths: Mapping[int, np.ndarray],
    centers: np.ndarray,
    places: np.ndarray,
    normals: np.ndarray,
    narrow: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return which points most views show in bare pixels and no view sees through, and their mean colours there.

    A view sees a point that faces it if its own depth there is unknown or the same. In ``narrow`` gaps [M], pixels may
    have texture.
    """
    bare, other, through = (np.zeros(len(places), np.int64) for _ in range(3))
    colors = np.zeros((len(places), 3))
    for index, depth in depths.items():
        view = sweep.views[index]
        z, column, row, inside = project(view, places)
        there, color = depth[row, column], view.color.permute(1, 2, 0)
        ray = centers[index] - places
        facing = (ray * normals).sum(axis=1) > FACING * np.linalg.norm(ray, axis=1)
        visible = inside & facing & ((there == 0) | (np.abs(there - z) <= THROUGH * z))
        flat = visible & view.usable[row, column] & (narrow | (flatness(color).numpy() > BARE)[row, column])
        bare += flat
        other += visible & ~flat
        through += inside & (there > (1 + THROUGH) * z)
        colors += flat[:, None] * color.numpy()[row, column]
    return (bare >= np.maximum(VOTES, other)) & (through == 0), colors / np.maximum(bare, 1)[:, None]
