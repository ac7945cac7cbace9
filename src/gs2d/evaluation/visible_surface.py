"""Settings of the visible-surface evaluation. All are decisions of this project ([d]): no public protocol exists."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VisibleSurfaceProtocol:
    """Our own: Chamfer and F-score over the surface that the training cameras see (docs/guides/evaluation.md).

    Attributes
    ----------
    samples : int
        Points on each surface, area-weighted, from a seed.
    fractions : tuple of float
        Thresholds, of the diagonal of the true bounding box; the headline figures are those at the first.
    min_views : int
        True surface seen by fewer training views does not count.
    seen_tolerance : float
        Of the diagonal: how far behind the depth buffer a point still counts as visible.
    """

    samples: int = 200_000  # [d] all of it: no public protocol exists for NeRF-Synthetic meshes
    fractions: tuple[float, ...] = (0.0025, 0.005, 0.01)  # [d] the strictest first: at 0.5 % all methods look alike
    min_views: int = 3  # [d] fewer views cannot tell where a surface is
    seen_tolerance: float = 0.002  # [d] against ray-cast counts: 2 % of the area more, 0.2 % less


VISIBLE_SURFACE = VisibleSurfaceProtocol()
