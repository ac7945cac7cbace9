"""The reach of a capture: beyond it, depth is unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.data.scene import Scene

NEARLY_ALL = 98.0  # percentile of distances; farther points are outliers or far background


@dataclass(frozen=True, eq=False)
class Reach:
    """A ball that contains the cameras and nearly all sparse points."""

    center: np.ndarray  # [3] world units; mean of the training cameras
    radius: float  # world units

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return which points [P, 3] are inside, [P] bool."""
        return np.asarray(np.linalg.norm(points - self.center, axis=1) <= self.radius)


def reach_of(scene: Scene, further: np.ndarray | None = None) -> Reach | None:
    """Return the reach of a scene; None without points.

    ``further`` [P, 3] world units: points beside the sparse points.
    """
    center = np.stack([view.camera.center for view in scene.train]).mean(axis=0)
    known = [array for array in (None if scene.points is None else scene.points.points, further) if array is not None]
    points = np.concatenate([np.zeros((0, 3)), *known])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    distance = np.linalg.norm(points - center, axis=1)
    return Reach(center, max(scene.extent, float(np.percentile(distance, NEARLY_ALL))))
