"""Count the views in which points of a triangle mesh are visible."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.ndimage import maximum_filter

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.meshing.raycast import cast_camera

MAX_SIDE = 800  # px, largest side of the depth maps
NEAR = 1e-9  # world units; occluders at any distance count, in captures of any scale


def visible_counts(points: np.ndarray, mesh: Mesh, cameras: Sequence[Camera], *, tolerance: float) -> np.ndarray:
    """Count the views in which each point [P, 3] is visible, int64 [P], with the mesh as the only occluder.

    ``tolerance`` (world units) as of ``shown_points``.
    """
    vertices = mesh.vertices.astype(np.float64)

    def visible(camera: Camera) -> np.ndarray:
        small = _shrunk(camera, MAX_SIDE)
        depths = cast_camera(vertices, mesh.faces, small, near=NEAR).depth
        return shown_points(points, small, depths, tolerance)

    counts = np.zeros(len(points), np.int64)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for in_view in pool.map(visible, cameras):
            counts += in_view
    return counts


def shown_points(points: np.ndarray, camera: Camera, depths: np.ndarray, tolerance: float | np.ndarray) -> np.ndarray:
    """Return which points [P, 3] are visible in an image with these depths [H, W], 0 where there is no surface.

    A point is visible if it is in the image and at most ``tolerance`` world units behind the deepest of the 3x3 pixels
    around it, because the depth of slanted surfaces changes within a pixel.
    """
    deepest = maximum_filter(np.where(depths > 0, depths, np.inf), 3, mode="nearest").reshape(-1)
    inside, pixel, z = _in_image(points, camera)
    return np.asarray(inside & (z <= deepest[pixel] + tolerance))


def frustum_counts(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Count the images that contain each point [P, 3], without occlusion."""
    counts = np.zeros(len(points), np.int64)
    for camera in cameras:
        counts += _in_image(points, camera)[0]
    return counts


def _in_image(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which points [P] are in the image, their flat pixels (0 if outside), and their depths."""
    pixels, z = camera.project(np.asarray(points, np.float64))
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    u, v = np.where(inside[:, None], pixels, 0).astype(np.int64).T
    return inside, v * camera.width + u, z


def _shrunk(camera: Camera, MAX_SIDE: int) -> Camera:
    factor = max(camera.width, camera.height) / MAX_SIDE
    if factor <= 1:
        return camera
    return camera.resized(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))
