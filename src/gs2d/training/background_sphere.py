"""Splats on a sphere around everything, to start from: what photographs show beyond all that depths are known of.

Behind a subject there are walls, people and sky that few photographs show, and no two alike: sparse points and a plane
sweep find nothing there, and where there is no splat there is no gradient that would ever make one. A few large ones
far out are enough to begin with; training moves, splits and colours them, and they are ordinary splats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation

from gs2d.config.robust import BackgroundSphere
from gs2d.data.reach import reach_of
from gs2d.data.scene import Scene
from gs2d.training.plane_sweep import Sweep, project, unproject

BESIDE_KNOWN = 3  # px: so near to a pixel of known depth, another one is probably of the same thing
MAX_VIEWS = 200  # that are looked at, evenly chosen
STRIDE = 5  # px between those of which places are looked at


def sphere_points(
    scene: Scene, sweep: Sweep, settings: BackgroundSphere
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return places, colours in [0, 1], normals (all [P, 3]) and sizes [P] of splats around everything.

    Places are left out that no photograph shows in a pixel of unknown depth; a colour is the median of those pixels.
    There are none where photographs have an alpha channel, which says what is empty.

    Parameters
    ----------
    scene : Scene
    sweep : Sweep
        Of the scene: its photographs, shrunk, and the depths that are known.
    settings : BackgroundSphere
    """
    looked_at = range(0, len(sweep.views), max(1, -(-len(sweep.views) // MAX_VIEWS)))
    reach = reach_of(scene, _swept_places(sweep, looked_at))
    if reach is None or scene.train[0].alpha() is not None:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    radius, directions = settings.radius * reach.radius, evenly_on_sphere(settings.splats)
    rows, colors = _looks(sweep, looked_at, reach.center + radius * directions)
    kept, median = _medians(rows, colors)
    size = settings.size * math.sqrt(4 * math.pi / settings.splats) * radius
    return reach.center + radius * directions[kept], median, -directions[kept], np.full(len(kept), size)


def evenly_on_sphere(count: int) -> np.ndarray:
    """Return unit vectors [count, 3], each with about as much of the sphere around it (Fibonacci's spiral)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / max(1, count)
    turn = math.pi * (1 + math.sqrt(5)) * index
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _swept_places(sweep: Sweep, looked_at: Sequence[int]) -> np.ndarray:
    """Return some of the places [P, 3] of known depth."""
    found = [np.zeros((0, 3))]
    for index in looked_at:
        depth = sweep.depths[index]
        places, known = unproject(sweep.views[index], depth)[::STRIDE, ::STRIDE], (depth > 0)[::STRIDE, ::STRIDE]
        found.append(places[known])
    return np.concatenate(found)


def _unknown(sweep: Sweep, index: int) -> np.ndarray:
    """Return the pixels [H, W] of a shrunk photograph that show something of unknown depth."""
    known = binary_dilation(sweep.depths[index] > 0, iterations=BESIDE_KNOWN)
    return np.asarray(sweep.views[index].usable & ~known)


def _looks(sweep: Sweep, looked_at: Sequence[int], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the places [N, 3] photographs show in pixels of unknown depth, and in what colour: [L], [L, 3]."""
    rows, colors = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for index in looked_at:
        view = sweep.views[index]
        unknown = _unknown(sweep, index)
        _, column, row, inside = project(view, places)
        shown = np.flatnonzero(inside)
        shown = shown[unknown[row[shown], column[shown]]]
        rows.append(shown)
        colors.append(view.color[:, row[shown], column[shown]].numpy().T.astype(np.float64))
    return np.concatenate(rows), np.concatenate(colors)


def _medians(rows: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers [P] that appear among rows [L], ascending, and the median of the colours of each [P, 3]."""
    order = np.argsort(rows, kind="stable")
    kept, first = np.unique(rows[order], return_index=True)
    groups = np.split(colors[order], first[1:]) if len(kept) else []
    return kept, np.array([np.median(group, axis=0) for group in groups]).reshape(-1, 3)
