"""Fog is counted by the sparse points that it hides."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.core.camera import Camera
from gs2d.data.prior_maps import ObservedPoints, PointsInView
from gs2d.evaluation.hidden_points import hidden_points

POINTS = PointsInView(np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [3.5, 0.5]]), np.full(4, 10.0))


def test_a_clearly_nearer_surface_occludes_a_point() -> None:
    depth = np.array([[9.4, 9.6, 0.0, 20.0]])  # nearer than 9.5; about there; nothing hit; behind the point
    assert hidden_points(depth, POINTS).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("row", "reason"), [(0, "shown"), (1, "too few photographs"), (2, "error"), (3, "outside"), (4, "behind")]
)
def test_points_of_a_view_are_reliable_and_inside_the_image(row: int, reason: str) -> None:
    camera = Camera(10, 10, fx=10.0, fy=10.0, cx=5.0, cy=5.0, T_cam_world=np.eye(4))
    xyz = np.array([[0.0, 0, 2], [0, 0, 2], [0, 0, 2], [2.0, 0, 2], [0, 0, -2]])
    error, track = np.array([1.0, 1, 3, 1, 1]), np.array([3, 2, 3, 3, 3])
    observed = ObservedPoints(xyz, error, track, {"a": np.array([row])})
    found = observed.in_view("a", camera)
    assert len(found.depth) == (1 if reason == "shown" else 0)
    assert len(observed.in_view("b", camera).depth) == 0
