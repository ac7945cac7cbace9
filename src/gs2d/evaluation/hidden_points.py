"""Fog without ground truth: sparse points that a photograph shows and that the rendering of its view hides.

A point that structure from motion found in a photograph can be seen from there, so nothing may lie before it. Where the
rendered median depth ends clearly nearer, the splats put a sheet, a streak or fog between camera and surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.data.prior_maps import PointsInView

NEARER = 0.95  # of a point's depth: a surface before that hides it; SfM depths are good to a few percent


@dataclass(frozen=True)
class HiddenPoints:
    """How many points a view shows, and how many of them its rendering hides."""

    shown: int
    hidden: int

    @property
    def fraction(self) -> float | None:
        """Hidden points as a fraction of those shown; None where no point is shown."""
        return self.hidden / self.shown if self.shown else None


def hidden_points(depth: np.ndarray, points: PointsInView, *, nearer: float = NEARER) -> HiddenPoints:
    """Count the points of a view that lie behind its rendered surface.

    Parameters
    ----------
    depth : ndarray [H, W] world units
        Rendered median depth; 0 where nothing was hit, which hides nothing.
    points : PointsInView
        From :meth:`gs2d.data.prior_maps.ObservedPoints.in_view`.
    nearer : float
        A point is hidden where the surface is nearer than this fraction of the point's depth.
    """
    columns, rows = np.floor(points.pixels).astype(np.int64).T
    surface = np.asarray(depth)[rows, columns]
    hidden = (surface > 0) & (surface < nearer * points.depth)
    return HiddenPoints(len(points.depth), int(hidden.sum()))


def total(views: Sequence[HiddenPoints]) -> HiddenPoints:
    """Return the counts of several views together."""
    return HiddenPoints(sum(view.shown for view in views), sum(view.hidden for view in views))
