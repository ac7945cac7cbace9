"""Splats on a sphere around the scene, to start from where the depth is unknown.

Behind a subject there are walls, people and sky in few images, where sparse points and a plane sweep find nothing.
Without a splat there is no gradient that could create one. A few large splats far away are enough to begin with;
training moves, splits and colours them as all others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation

from gs2d.data.bounds import reach_of
from gs2d.data.scene import Scene
from gs2d.training.start.plane_sweep import Sweep, project, unproject

SPLATS = 500  # on the whole sphere; more of them would overfit the background of each image (notebook/floaters.md)
RADIUS = 3.0  # of the sphere, in units of the scene's reach: its cameras and nearly all sparse and swept points
SIZE = 0.8  # standard deviation of a splat, in units of the distance between neighbours
BESIDE_DEPTH = 3  # px: nearer to a pixel with a depth, a pixel probably shows the same surface
MAX_VIEWS = 200  # images that are used, evenly chosen
STRIDE = 5  # px between swept points that estimate the reach of the scene


def sphere_points(scene: Scene, sweep: Sweep) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, colours in [0, 1], normals (all [P, 3]) and sizes [P] of splats around the scene.

    Positions that no image shows in a pixel of unknown depth are omitted; a colour is the median of such pixels. There
    are none for images with an alpha channel.
    """
    sampled = range(0, len(sweep.views), max(1, -(-len(sweep.views) // MAX_VIEWS)))
    reach = reach_of(scene, _swept_places(sweep, sampled))
    if reach is None or scene.train[0].alpha() is not None:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    radius, directions = RADIUS * reach.radius, evenly_on_sphere(SPLATS)
    rows, colors = _observations(sweep, sampled, reach.center + radius * directions)
    visible, median = _medians(rows, colors)
    size = SIZE * math.sqrt(4 * math.pi / SPLATS) * radius
    return reach.center + radius * directions[visible], median, -directions[visible], np.full(len(visible), size)


def evenly_on_sphere(count: int) -> np.ndarray:
    """Return evenly distributed unit vectors [count, 3] (Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / max(1, count)
    turn = math.pi * (1 + math.sqrt(5)) * index
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _swept_places(sweep: Sweep, sampled: Sequence[int]) -> np.ndarray:
    """Return a subset of the swept points [P, 3]."""
    swept = [np.zeros((0, 3))]
    for index in sampled:
        depth = sweep.depths[index]
        places, valid = unproject(sweep.views[index], depth)[::STRIDE, ::STRIDE], (depth > 0)[::STRIDE, ::STRIDE]
        swept.append(places[valid])
    return np.concatenate(swept)


def _unknown(sweep: Sweep, index: int) -> np.ndarray:
    """Return the pixels [H, W] of a downscaled image with unknown depth."""
    covered = binary_dilation(sweep.depths[index] > 0, iterations=BESIDE_DEPTH)
    return np.asarray(sweep.views[index].usable & ~covered)


def _observations(sweep: Sweep, sampled: Sequence[int], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows [L] of points [N, 3] that images show in pixels of unknown depth, and their colours [L, 3]."""
    rows, colors = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for index in sampled:
        view = sweep.views[index]
        unknown = _unknown(sweep, index)
        _, column, row, inside = project(view, places)
        visible = np.flatnonzero(inside)
        visible = visible[unknown[row[visible], column[visible]]]
        rows.append(visible)
        colors.append(view.color[:, row[visible], column[visible]].numpy().T.astype(np.float64))
    return np.concatenate(rows), np.concatenate(colors)


def _medians(rows: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct rows [P] among [L], ascending, and the median colour of each [P, 3]."""
    order = np.argsort(rows, kind="stable")
    distinct, first = np.unique(rows[order], return_index=True)
    groups = np.split(colors[order], first[1:]) if len(distinct) else []
    return distinct, np.array([np.median(group, axis=0) for group in groups]).reshape(-1, 3)
