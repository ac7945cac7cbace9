"""Camera paths: flights along the photographs, and orbits."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.pipeline.finish.camera_paths import flight_cameras, orbit_cameras
from tiny import ball_cameras

UP = np.array([0.0, 0.0, 1.0])


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    return look_at(np.array(eye), np.array(target), UP, width=64, height=48, fx=60.0, fy=61.0)


def ring(count: int, height: float = -0.4) -> list[Camera]:
    """Level cameras on a circle, a little below what they look at."""
    angles = 2 * np.pi * np.arange(count) / count
    return [looking((3 * np.cos(a), 3 * np.sin(a), height), (0, 0, 0)) for a in angles]


def corridor(count: int) -> list[Camera]:
    """Level cameras in a row that look straight ahead."""
    return [looking((0.3 * i, 0, 1), (0.3 * i, 5, 1)) for i in range(count)]


def paces(flight: list[Camera]) -> np.ndarray:
    return np.linalg.norm(np.diff([camera.center for camera in flight], axis=0), axis=1)


def test_a_flight_along_a_ring_is_closed_and_stays_on_it() -> None:
    flight = flight_cameras(ring(24), 90)
    assert len(flight) == 90
    centers = np.array([camera.center for camera in flight])
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), np.hypot(3, 0.4), rtol=1e-3)
    np.testing.assert_allclose(centers[:, 2], -0.4, atol=1e-3)  # a great circle between two would dip below
    for camera in flight:
        np.testing.assert_allclose(camera.forward, -camera.center / np.linalg.norm(camera.center), atol=5e-3)
        assert abs(camera.rotation[0] @ UP) < 1e-9
    steps = np.append(paces(flight), np.linalg.norm(centers[0] - centers[-1]))  # the last frame leads to the first
    np.testing.assert_allclose(steps, 2 * np.pi * 3 / 90, rtol=0.1)


def test_a_flight_along_a_walk_keeps_order_direction_and_ends() -> None:
    walk = corridor(30)
    flight = flight_cameras(walk, 60)
    np.testing.assert_allclose(flight[0].T_cam_world, walk[0].T_cam_world, atol=1e-6)
    np.testing.assert_allclose(flight[-1].T_cam_world, walk[-1].T_cam_world, atol=1e-6)
    x = [camera.center[0] for camera in flight]
    np.testing.assert_allclose(np.diff(x), 0.3 * 29 / 59, rtol=0.02)
    assert (flight[7].width, flight[7].height, flight[7].fx, flight[7].fy) == (64, 48, 60.0, 61.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_flight_works_with_few_photographs(count: int) -> None:
    flight = flight_cameras(ball_cameras(6)[:count], 7)
    assert len(flight) == 7
    assert np.isfinite([camera.T_cam_world for camera in flight]).all()
    np.testing.assert_allclose(flight[0].center, ball_cameras(6)[0].center, atol=1e-9)


def test_an_orbit_stays_within_the_photographed_arc() -> None:
    turns = np.radians(np.linspace(-40, 70, 12))
    spread = [looking(((3 + a) * np.cos(a), (3 + a) * np.sin(a), 0.5 + a), (0, 0, 0)) for a in turns]
    orbit = orbit_cameras(spread, 48, np.zeros(3))
    centers = np.array([camera.center for camera in orbit])
    angles = np.arctan2(centers[:, 1], centers[:, 0])
    assert turns[0] - 1e-6 <= angles.min() < turns[0] + 0.01
    assert turns[-1] - 0.01 < angles.max() <= turns[-1] + 1e-6
    radii = np.linalg.norm(centers[:, :2], axis=1)
    np.testing.assert_allclose(radii, 3 + angles, atol=0.35)  # as far as the photographs there, and as high
    np.testing.assert_allclose(centers[:, 2], 0.5 + angles, atol=0.35)
    assert paces(orbit).max() < 0.5  # also from the last frame on: it swings back
    assert np.linalg.norm(centers[-1] - centers[0]) < 0.1
    for camera in orbit:
        np.testing.assert_allclose(camera.forward, -camera.center / np.linalg.norm(camera.center), atol=1e-9)
