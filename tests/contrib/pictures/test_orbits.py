"""Orbits around the subject, and the directions to which the page limits visitors."""

from __future__ import annotations

import numpy as np

from gs2d.contrib.pictures.orbits import orbit_cameras
from gs2d.core.camera import Camera, look_at
from gs2d.data.subject_box import Subject
from gs2d.viewer.opening_view import photographed_arc

UP = np.array([0.0, 0.0, 1.0])


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    return look_at(np.array(eye), np.array(target), UP, width=64, height=48, fx=60.0, fy=61.0)


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
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1).max() < 0.5  # also from the last frame on: it swings back
    assert np.linalg.norm(centers[-1] - centers[0]) < 0.1
    for camera in orbit:
        np.testing.assert_allclose(camera.forward, -camera.center / np.linalg.norm(camera.center), atol=1e-9)


def test_a_relief_is_shown_from_the_photographed_heights() -> None:
    turns, heights = np.radians([-30, -10, 10, 30]), (0.6, 1.0, 1.8, 1.2)
    relief = [looking((4 * np.cos(a), 4 * np.sin(a), z), (0, 0, 0)) for a, z in zip(turns, heights, strict=True)]
    orbit = np.array([camera.center[2] for camera in orbit_cameras(relief, 24, np.zeros(3))])
    assert orbit.min() > 0.6
    assert orbit.max() < 1.8
    assert np.ptp(orbit) > 0.3
    subject = Subject("object", -np.ones(3), np.ones(3), np.zeros(3), UP, "a test")
    arc = photographed_arc(relief, subject, UP)
    lowest, highest = np.degrees(np.arctan([0.6 / 4, 1.8 / 4]))
    np.testing.assert_allclose(np.degrees([arc.low, arc.high]), [lowest - 12, highest + 20], atol=1e-6)
    np.testing.assert_allclose([np.degrees(arc.half), *arc.middle], [30 + 12, 1, 0, 0], atol=1e-6)
