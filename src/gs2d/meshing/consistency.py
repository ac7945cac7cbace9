"""Measure how much depth maps of neighbouring views contradict each other.

If a view sees farther than a surface point of another view, at the same pixel, the two maps contradict each other,
whatever the shape of the scene. If it sees nearer, something may occlude the point. The positive residuals therefore
measure the error of the depth maps without ground truth or an occlusion test.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.fusion_bounds import MAX_VOXELS_PER_TRUNCATION, DepthSample, FusionBounds
from gs2d.meshing.sampling import make_sampler

NEIGHBOURS = 8  # views compared with each
PERCENTILE = 75.0  # of the positive residuals
_AT_ONCE = 64  # views per chunk of the distance matrix
_ENOUGH = 100  # residuals needed for an estimate


def depth_noise(maps: Iterable[DepthMap], samples: Sequence[DepthSample], limits: FusionBounds) -> float | None:
    """Return the 75th percentile, in world units, of how much farther views see than their neighbours' points.

    ``samples`` has one for each map, in the same order. A slope of more than the largest truncation per pixel is a
    depth edge. None if too few points are seen by two views.
    """
    if not samples:
        return None
    edge = replace(limits, truncation=MAX_VOXELS_PER_TRUNCATION * limits.voxel)
    neighbours = _nearest(np.array([s.center for s in samples]))
    residuals: list[np.ndarray] = [np.zeros(0)]
    for j, item in enumerate(maps):
        view = make_sampler(item, edge)
        for i in np.flatnonzero((neighbours == j).any(axis=1)).tolist():
            projected = samples[i].points @ view.projection[:, :3].T + view.projection[:, 3]
            projected = projected[projected[:, 2] > 0]
            z = projected[:, 2].copy()
            farther, _ = view.signed_distance(projected[:, 0] / z, projected[:, 1] / z, z)
            residuals.append(farther[farther > 0])  # invalid pixels give large negative values
    positive = np.concatenate(residuals)
    return float(np.percentile(positive, PERCENTILE)) if len(positive) >= _ENOUGH else None


def _nearest(centers: np.ndarray) -> np.ndarray:
    """Return the indices [V, NEIGHBOURS] of the nearest other camera centres [V, 3]; fewer if there are fewer views."""
    count = min(NEIGHBOURS, len(centers) - 1)
    indices = np.empty((len(centers), count), np.int64)
    for start in range(0, len(centers), _AT_ONCE):
        rows = np.arange(start, min(start + _AT_ONCE, len(centers)))
        distance = np.linalg.norm(centers[rows, None] - centers[None], axis=2)
        distance[rows - start, rows] = np.inf
        indices[rows] = np.argsort(distance, axis=1, kind="stable")[:, :count]
    return indices
