"""How far rendered depths are believed: training also draws what is beyond any known depth, at a depth it made up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gs2d.core.camera import Camera
from gs2d.data import Scene
from gs2d.data.reach import Reach, reach_of
from gs2d.meshing.bounds import backproject
from gs2d.pipeline.job import RenderedScene

BEYOND = 1.25  # times the reach of a scene (``data/reach.py``), past which no depth is believed


def believed_reach(scene: Scene) -> Reach | None:
    """Return how far depths are believed: a little farther than sparse points go; None where there are no points.

    What is drawn beyond stands on a sphere (``training/background_sphere.py``).
    """
    if scene.points is None:
        return None
    reach = reach_of(scene)
    return None if reach is None else replace(reach, radius=BEYOND * reach.radius)


def surface_reach(job: RenderedScene) -> Reach | None:
    """Return how far surfaces are taken; None, as far as they go, by the protocols of data sets: they have limits."""
    return believed_reach(job.scene) if job.protocol.fusion.subject else None


def within_reach(reach: Reach, camera: Camera, depths: np.ndarray) -> np.ndarray:
    """Return the pixels [H, W] bool of depths that show places within reach."""
    rows, columns = np.indices(depths.shape).reshape(2, -1)
    places = backproject(camera, depths.reshape(-1).astype(np.float64), rows, columns)
    return reach.holds(places).reshape(depths.shape)
