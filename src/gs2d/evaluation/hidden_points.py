"""Detect floaters without ground truth: sparse points that are visible in an image but occluded in its rendering.

A point that structure from motion triangulated from an image is visible in it. If the rendered median depth is clearly
smaller, the splats form floaters between camera and surface.
"""

from __future__ import annotations

import numpy as np

from gs2d.data.prior_maps import PointsInView

NEARER = 0.95  # fraction of a point's depth; a nearer surface occludes it. SfM depths have errors of a few per cent


def hidden_points(depth: np.ndarray, points: PointsInView) -> np.ndarray:
    """Return which points of a view are behind its rendered surface, [M] bool.

    ``depth`` [H, W] world units: rendered median depth; 0 without a surface. ``points``: from
    :meth:`gs2d.data.prior_maps.ObservedPoints.in_view`. A point is hidden if the surface is nearer than ``NEARER`` of
    its depth.
    """
    columns, rows = np.floor(points.pixels).astype(np.int64).T
    surface = np.asarray(depth)[rows, columns]
    return np.asarray((surface > 0) & (surface < NEARER * points.depth))
