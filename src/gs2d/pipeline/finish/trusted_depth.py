"""Where rendered depths are believed: training also draws the sky and what is beyond any known depth, at some depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.transforms import up_direction
from gs2d.data import Scene, View
from gs2d.data.reach import Reach, reach_of
from gs2d.meshing.fusion_bounds import backproject
from gs2d.meshing.sky import sky_pixels
from gs2d.pipeline.prepare.loaded import RenderedScene

BEYOND = 1.25  # times the reach of a scene (``data/reach.py``), past which no depth is believed
MIN_POINTS = 20  # sparse points in a photograph, below which they do not say where it shows nothing


def believed_reach(scene: Scene) -> Reach | None:
    """Return how far depths are believed: a little farther than sparse points go; None where there are no points.

    What is drawn beyond stands on a sphere (``training/background_sphere.py``).
    """
    if scene.points is None:
        return None
    reach = reach_of(scene)
    return None if reach is None else replace(reach, radius=BEYOND * reach.radius)


def surface_reach(loaded: RenderedScene) -> Reach | None:
    """Return how far surfaces are taken; None, as far as they go, by the protocols of data sets: they have limits."""
    return believed_reach(loaded.scene) if loaded.protocol.fusion.subject else None


def within_reach(reach: Reach, camera: Camera, depths: np.ndarray) -> np.ndarray:
    """Return the pixels [H, W] bool of depths that show places within reach."""
    rows, columns = np.indices(depths.shape).reshape(2, -1)
    places = backproject(camera, depths.reshape(-1).astype(np.float64), rows, columns)
    return reach.holds(places).reshape(depths.shape)


def sky_direction(loaded: RenderedScene) -> np.ndarray | None:
    """Return the direction [3] of the sky: up. None where the photographs are not searched for sky.

    The fusions of data sets have limits of their own, and an alpha channel says itself what is empty.
    """
    scene = loaded.scene
    if not loaded.protocol.fusion.subject or scene.observed() is None or scene.train[0].alpha() is not None:
        return None
    return up_direction([view.camera for view in scene.train])


def sky_of(loaded: RenderedScene, view: View, up: np.ndarray) -> np.ndarray:
    """Return the pixels [H, W] bool in which a photograph shows the sky, which is in the direction ``up`` [3]."""
    camera = view.camera
    observed = loaded.scene.observed()
    points = np.zeros((0, 2)) if observed is None else observed.inside(camera, min_track=2).pixels
    if len(points) < MIN_POINTS:
        return np.zeros((camera.height, camera.width), bool)
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    rays = backproject(camera, np.ones(len(rows)), rows, columns) - camera.center
    above = (rays @ up > 0).reshape(camera.height, camera.width)
    return sky_pixels(view.target(loaded.settings.background), points, above, view.valid())
