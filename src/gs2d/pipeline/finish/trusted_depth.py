"""Decide where rendered depth is a surface: splats also render the sky and the distant background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.transforms import up_direction
from gs2d.data import Scene, View
from gs2d.data.bounds import Reach, reach_of
from gs2d.meshing.fusion_bounds import backproject
from gs2d.meshing.sky import sky_pixels
from gs2d.meshing.sky_distance import at_infinity, smooth_area
from gs2d.pipeline.prepare.loaded import Trained

BEYOND = 1.25  # times the reach of a scene (``data/bounds.py``); depth beyond it is ignored
MIN_POINTS = 20  # sparse points in a photograph to search it for sky
COMPARED = 48  # photographs, evenly chosen, that tell whether smooth areas are sky


def believed_reach(scene: Scene) -> Reach | None:
    """Return the region of valid depths, a little larger than that of the sparse points; None without points.

    Splats of the background sphere (``training/start/background_sphere.py``) are beyond it.
    """
    if scene.points is None:
        return None
    reach = reach_of(scene)
    return None if reach is None else replace(reach, radius=BEYOND * reach.radius)


def surface_reach(trained: Trained) -> Reach | None:
    """Return the region of surfaces; None (unlimited) for protocols of data sets, which have limits of their own."""
    return believed_reach(trained.scene) if trained.protocol.fusion.subject else None


def within_reach(reach: Reach, camera: Camera, depths: np.ndarray) -> np.ndarray:
    """Return which depths [H, W] are of points within reach, [H, W] bool."""
    rows, columns = np.indices(depths.shape).reshape(2, -1)
    places = backproject(camera, depths.reshape(-1).astype(np.float64), rows, columns)
    return reach.contains(places).reshape(depths.shape)


def sky_direction(trained: Trained) -> np.ndarray | None:
    """Return the up direction [3], in which sky is searched; None if the photographs show none.

    Protocols of data sets have limits of their own, and alpha channels mark what is empty. In a room, walls
    and ceilings are smooth; photographs tell that they are near (``meshing/sky_distance.py``).
    """
    scene = trained.scene
    observed = scene.observed()
    if not trained.protocol.fusion.subject or observed is None or scene.train[0].alpha() is not None:
        return None
    up = up_direction([view.camera for view in scene.train])
    areas = []
    for index in np.unique(np.linspace(0, len(scene.train) - 1, min(len(scene.train), COMPARED)).round().astype(int)):
        view = scene.train[index]
        sky, shown = sky_of(trained, view, up), observed.in_view(view.name, view.camera)
        if sky.any() and len(shown.depth):
            image = view.target(trained.settings.background)
            areas.append(smooth_area(view.camera, image, sky, shown.pixels, shown.depth))
    return up if at_infinity(areas) else None


def sky_of(trained: Trained, view: View, up: np.ndarray) -> np.ndarray:
    """Return the pixels of a photograph that show sky, [H, W] bool; ``up`` [3] is the direction of the sky."""
    camera = view.camera
    observed = trained.scene.observed()
    points = np.zeros((0, 2)) if observed is None else observed.inside(camera, min_track=2).pixels
    if len(points) < MIN_POINTS:
        return np.zeros((camera.height, camera.width), bool)
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    rays = backproject(camera, np.ones(len(rows)), rows, columns) - camera.center
    above = (rays @ up > 0).reshape(camera.height, camera.width)
    return sky_pixels(view.target(trained.settings.background), points, above, view.valid())


def usable_pixels(trained: Trained, view: View) -> np.ndarray | None:
    """Return the pixels that show the surface: not masked, and on the object if fusion used its mask."""
    masks = [view.mask(), view.object_mask() if trained.protocol.use_mask_in_fusion else None]
    present = [mask for mask in masks if mask is not None]
    return np.logical_and.reduce(present) if present else None
