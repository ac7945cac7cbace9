"""Move splats on shiny surface outward, to where the outlines of the subject are.

Reflections look alike in neighbouring photographs at a depth behind the surface, so matching and training put splats
there. Outlines do not depend on reflections: where a photograph shows what lies behind the subject, there is no
surface. A splat on convex surface moves along its normal, towards the cameras, until views see past it, as in space
carving (Kutulakos and Seitz 2000). Hollows have no outlines. Formulas: docs/math.md, "Normal smoothness".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from gs2d.core.image_arrays import enlarged
from gs2d.training.robust.view_cells import ViewCells

WINDOW = 13  # cells, of the mean of a map: shiny things have spots that look matt
SHINY = 0.3  # mean over the views from which a splat may move: 0.8 of bronze and copper have more, 0.06 of marble
SEEN = 0.05  # a view shows a splat if its depth there differs by at most this fraction
LEAST_SEEN = 2  # views that must show it
PAST, FAR = 0.02, 0.03
"""Fractions of the depth. A view sees past a splat if its depth is larger by PAST. Where enough views do, the splat
stops; if they do not see FAR past it, it has only left its own flat surface, and stays where it was."""
LEAST_PAST = 3  # views that see past it: fewer may be wrong
STEP, STEPS = 0.0025, 12  # fraction of the depth; what would have to move farther is hollow, as a bowl is
REACH, CELLS_IN_REACH, NEIGHBOURS = 0.06, 4, 96
"""Of a neighbourhood: fraction of the median depth; it is thinned to one point in a cell, as many to its radius."""
ROWS_AT_ONCE = 1 << 14  # their neighbours take 100 MB
MOST_VIEWS = 48  # that are compared, evenly chosen


def moved_outward(means: np.ndarray, normals: np.ndarray, views: Sequence[ViewCells]) -> np.ndarray:
    """Return the centres [N, 3] float64 of splats after shiny ones have moved.

    Parameters
    ----------
    means, normals : ndarray [N, 3]
        World units; unit normals of either sign.
    views : sequence of ViewCells
        How shiny the surface is [S, S], from 0 to 1, and depth [H, W] world units, 0 without a surface.
    """
    moved, count = means.astype(np.float64), len(means)
    shine, depth, seen, towards = (np.zeros((count, *shape)) for shape in ((), (), (), (3,)))
    for view in views:
        rows, z, at = _shown(view, moved)
        visible = np.abs(view.depth[at] - z) <= SEEN * z
        rows, z = rows[visible], z[visible]
        smooth = uniform_filter(view.values, WINDOW, mode="nearest")
        shine[rows] += enlarged(smooth, *view.depth.shape)[at][visible]
        depth[rows] += z
        seen[rows] += 1
        ray = view.camera.center - moved[rows]
        towards[rows] += ray / np.linalg.norm(ray, axis=1, keepdims=True)
    rows = np.flatnonzero((seen >= LEAST_SEEN) & (shine > SHINY * seen) & np.isfinite(normals).all(axis=1))
    if not len(rows):
        return moved
    outward = normals[rows] * np.sign((normals[rows] * towards[rows]).sum(axis=1, keepdims=True))
    depth = depth[rows] / seen[rows]
    bulges = _bulges(moved[rows], outward, REACH * float(np.median(depth)))
    rows, step = rows[bulges], STEP * (depth[:, None] * outward)[bulges]
    moved[rows] += _steps(moved[rows], step, views)[:, None] * step
    return moved


def _bulges(positions: np.ndarray, outward: np.ndarray, reach: float) -> np.ndarray:
    """Return where a surface is convex, bool [M], by points on it [M, 3] and its normals: its neighbours lie lower."""
    cells = np.floor(positions / (reach / CELLS_IN_REACH)).astype(np.int64)
    some = np.unique(cells, axis=0, return_index=True)[1]
    tree, count = cKDTree(positions[some]), np.arange(1, min(NEIGHBOURS, len(some)) + 1)
    convex = np.zeros(len(positions), bool)
    for rows in np.array_split(np.arange(len(positions)), len(positions) // ROWS_AT_ONCE + 1):
        distance, near = map(np.asarray, tree.query(positions[rows], k=count, distance_upper_bound=reach))
        weight = np.isfinite(distance)
        near = some[np.where(weight, near, 0)]
        weight &= np.einsum("ma,mka->mk", outward[rows], outward[near]) > 0  # the other side of a thin wall faces away
        height = np.einsum("ma,mka->mk", outward[rows], positions[near] - positions[rows, None])
        convex[rows] = (weight * height).sum(axis=1) < 0
    return convex


def _steps(positions: np.ndarray, step: np.ndarray, views: Sequence[ViewCells]) -> np.ndarray:
    """Return the number of steps [M] that positions [M, 3] take before views see past them; 0 if none do."""
    steps, waiting = np.zeros(len(positions)), np.arange(len(positions))
    for taken in range(STEPS + 1):
        past, far = np.zeros((2, len(waiting)), np.int64)
        now = positions[waiting] + taken * step[waiting]
        for view in views:
            rows, z, at = _shown(view, now)
            past[rows] += view.depth[at] > (1 + PAST) * z
            far[rows] += view.depth[at] > (1 + FAR) * z
        stops = past >= LEAST_PAST
        steps[waiting[stops & (far >= LEAST_PAST)]] = max(taken - 1, 0)
        waiting = waiting[~stops]
    return steps


def _shown(view: ViewCells, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return which positions [M, 3] are inside an image, their depths, and the rows and columns of their pixels."""
    pixels, z = view.camera.project(positions)
    inside = (z > 0) & (pixels >= 0).all(axis=1) & (pixels < (view.camera.width, view.camera.height)).all(axis=1)
    rows = np.flatnonzero(inside)
    column, row = pixels[rows].astype(np.int64).T
    return rows, z[rows], (row, column)
