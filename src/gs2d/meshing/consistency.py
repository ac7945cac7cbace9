"""How much depth maps of neighbouring views contradict each other.

A seen point of one view that another view looks *through* (that sees farther, at the same pixel) is a contradiction
whatever the shape of the scene; a view that sees nearer may just see something in front. So the positive residuals
measure the error of the depth maps, without ground truth and without a guess about occlusion.
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
_AT_ONCE = 64  # views whose distances from all others are in memory
_ENOUGH = 100  # residuals, below which there is no estimate


def depth_noise(maps: Iterable[DepthMap], samples: Sequence[DepthSample], limits: FusionBounds) -> float | None:
    """75th percentile, world units, of how far views look through points that their neighbours see.

    Parameters
    ----------
    maps : iterable of DepthMap
    samples : sequence of DepthSample
        One for each map, in order.
    limits : FusionBounds
        Steeper slopes than its largest truncation in a pixel are depth edges; deeper pixels than its limit are unseen.

    Returns
    -------
    float or None
        None where too few points are seen twice.
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
            residuals.append(farther[farther > 0])  # where unseen it is hugely negative
    positive = np.concatenate(residuals)
    return float(np.percentile(positive, PERCENTILE)) if len(positive) >= _ENOUGH else None


def _nearest(centers: np.ndarray) -> np.ndarray:
    """Return the nearest others of each place [V, 3], some at a time: [V, NEIGHBOURS], fewer where there are fewer."""
    count = min(NEIGHBOURS, len(centers) - 1)
    found = np.empty((len(centers), count), np.int64)
    for start in range(0, len(centers), _AT_ONCE):
        rows = np.arange(start, min(start + _AT_ONCE, len(centers)))
        distance = np.linalg.norm(centers[rows, None] - centers[None], axis=2)
        distance[rows - start, rows] = np.inf
        found[rows] = np.argsort(distance, axis=1, kind="stable")[:, :count]
    return found
