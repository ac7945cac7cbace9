"""How far a capture goes: beyond that, nothing says how far away a thing is that photographs show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.data.scene import Scene

NEARLY_ALL = 98.0  # percentile of distances: what is beyond it are mistakes, or a hilltop


@dataclass(frozen=True, eq=False)
class Reach:
    """A ball that holds the cameras and nearly all sparse points.

    Attributes
    ----------
    center : ndarray [3] world units
        The mean of the training cameras.
    radius : float, world units
    """

    center: np.ndarray
    radius: float

    def holds(self, places: np.ndarray) -> np.ndarray:
        """Return which places [P, 3] lie in it, [P] bool."""
        return np.asarray(np.linalg.norm(places - self.center, axis=1) <= self.radius)


def reach_of(scene: Scene, places: np.ndarray | None = None) -> Reach | None:
    """Return the reach of a scene; None where nothing is known of places.

    Parameters
    ----------
    scene : Scene
    places : ndarray [P, 3] world units, optional
        Others that are known, beside the sparse points.
    """
    center = np.stack([view.camera.center for view in scene.train]).mean(axis=0)
    known = [array for array in (None if scene.points is None else scene.points.points, places) if array is not None]
    points = np.concatenate([np.zeros((0, 3)), *known])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    distance = np.linalg.norm(points - center, axis=1)
    return Reach(center, max(scene.extent, float(np.percentile(distance, NEARLY_ALL))))
