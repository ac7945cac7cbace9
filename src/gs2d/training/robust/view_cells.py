"""Maps of training views in S x S cells, and what other views show of the surface in a cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.meshing.fusion_bounds import backproject

HIDDEN = 0.05  # a surface is hidden in a view whose depth there is smaller by more than this fraction


@dataclass(frozen=True, eq=False)
class ViewCells:
    """A map of a view: camera, values [S, S], and depth [S, S] in world units, 0 without a surface."""

    camera: Camera
    values: np.ndarray
    depth: np.ndarray


def lower_median_elsewhere(view: ViewCells, others: Sequence[ViewCells]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower median [S, S] of other maps at the surface in each cell, and how many views show it.

    The median is 0 where none does.
    """
    camera, cells = view.camera, len(view.depth)
    centres = (np.arange(cells) + 0.5) / cells
    columns, rows = (axis.ravel() for axis in np.meshgrid(centres * camera.width, centres * camera.height))
    depth = view.depth.ravel().astype(np.float64)
    points, values = backproject(camera, depth, rows - 0.5, columns - 0.5), np.full((len(others), cells**2), np.nan)
    for number, other in enumerate(others):
        pixels, z = other.camera.project(points)
        at = np.floor(pixels / (other.camera.width, other.camera.height) * cells)
        shown = np.flatnonzero((depth > 0) & (z > 0) & (at >= 0).all(axis=1) & (at < cells).all(axis=1))
        column, row = at[shown].astype(int).T
        visible = other.depth[row, column] >= (1 - HIDDEN) * z[shown]
        values[number, shown[visible]] = other.values[row, column][visible]
    values.sort(axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    median = values[np.maximum(count - 1, 0) // 2, np.arange(cells**2)]
    return np.nan_to_num(median).reshape(cells, cells), count.reshape(cells, cells)
