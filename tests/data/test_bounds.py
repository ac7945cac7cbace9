"""The box that the cameras look at."""

from __future__ import annotations

import numpy as np
import pytest

from capture_writers import ring
from gs2d.core.camera import Camera, look_at
from gs2d.data.bounds import scene_bounds
from gs2d.data.scene import PointCloud


def moved(cameras: list[Camera], offset: np.ndarray, scale: float = 1.0) -> list[Camera]:
    out = []
    for camera in cameras:
        T = camera.T_cam_world.copy()
        T[:3, 3] = -T[:3, :3] @ (scale * camera.center + offset)
        out.append(Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, T))
    return out


def test_the_box_of_points_ignores_outliers() -> None:
    points = np.random.default_rng(0).uniform((-1, -2, -3), (1, 2, 3), (5000, 3))
    points[:20] = 1e4
    bounds, notes = scene_bounds(ring(6), PointCloud(points))
    np.testing.assert_allclose(bounds, [[-1.2, -2.4, -3.6], [1.2, 2.4, 3.6]], rtol=0.05)
    assert notes == ()


def test_without_points_the_box_is_what_the_cameras_see() -> None:
    """Cameras at distance 4.18 see half widths of 4.18 x 15/35 = 1.8 upwards and 2.4 sideways."""
    bounds, notes = scene_bounds(ring(12), None)
    assert notes == ()
    assert (bounds[0] < -1.2).all()
    assert (bounds[1] > 1.2).all()
    assert np.abs(bounds).max() < 2.8
    offset = np.array([10.0, -20.0, 30.0])
    there, _ = scene_bounds(moved(ring(12), offset, 5.0), None)
    np.testing.assert_allclose(there, 5 * bounds + offset, atol=5 * 4.2 / 20)  # a cell of the search grid


@pytest.mark.parametrize(
    ("cameras", "customary"),
    [
        (ring(8), True),
        (moved(ring(8), np.array([1.0, 0.0, 0.0])), False),  # looks elsewhere
        (ring(8, radius=1.2), False),  # stands inside the box
        (ring(8, radius=400.0), False),  # other units: the box would be a dot
    ],
)
def test_the_box_of_nerf_synthetic_is_used_only_if_the_cameras_agree(cameras: list[Camera], customary: bool) -> None:
    bounds, _ = scene_bounds(cameras, None, is_synthetic=True)
    assert np.array_equal(bounds, [[-1.3] * 3, [1.3] * 3]) == customary
    assert not np.array_equal(scene_bounds(cameras, None)[0], [[-1.3] * 3, [1.3] * 3])


def test_parallel_cameras_get_a_box_ahead_of_them_and_a_note() -> None:
    up = np.array([0.0, -1.0, 0.0])
    cameras = [
        look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 1.0]), up, width=40, height=30, fx=35.0)
        for x in (-1.0, 0.0, 1.0)
    ]
    bounds, notes = scene_bounds(cameras, None)
    # The extent is 1.1: depths from 1.1 to 4.4, and x as far as 1 + 4.4 x 20/35 = 3.514.
    np.testing.assert_allclose(bounds[:, 2], (1.1, 4.4))
    np.testing.assert_allclose(bounds[:, 0], (-3.514286, 3.514286), rtol=1e-6)
    assert "optical axes do not meet" in notes[0]
