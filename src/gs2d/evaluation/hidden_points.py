"""Detect floaters without ground truth: sparse points that an image shows but its rendering occludes.

A point that structure from motion triangulated from an image is visible in it. If the rendered median depth is clearly
smaller, the splats form floaters between camera and surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.data.prior_maps import PointsInView

NEARER = 0.95  # of a point's depth: a nearer surface occludes it; SfM depths have errors of a few percent


@dataclass(frozen=True)
class HiddenPoints:
    """Number of sparse points in a view, and how many of them its rendering occludes."""

    shown: int
    hidden: int

    @property
    def fraction(self) -> float | None:
        """Fraction of the points that are occluded; None without points."""
        return self.hidden / self.shown if self.shown else None


def hidden_points(depth: np.ndarray, points: PointsInView, *, nearer: float = NEARER) -> HiddenPoints:
    """Count the points of a view that are behind its rendered surface.

    Parameters
    ----------
    depth : ndarray [H, W] world units
        Rendered median depth; 0 without a surface.
    points : PointsInView
        From :meth:`gs2d.data.prior_maps.ObservedPoints.in_view`.
    nearer : float
        A point is hidden if the surface is nearer than this fraction of its depth.
    """
    columns, rows = np.floor(points.pixels).astype(np.int64).T
    surface = np.asarray(depth)[rows, columns]
    hidden = (surface > 0) & (surface < nearer * points.depth)
    return HiddenPoints(len(points.depth), int(hidden.sum()))


def total(views: Sequence[HiddenPoints]) -> HiddenPoints:
    """Sum the counts of several views."""
    return HiddenPoints(sum(view.shown for view in views), sum(view.hidden for view in views))
