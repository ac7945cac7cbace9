"""The pinhole camera: OpenCV axes, corner-origin pixels, rigid pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.core.camera import Camera, look_at
from gs2d.errors import ShapeError

EYE4 = np.eye(4)


def test_points_project_with_x_right_and_y_down_of_the_corner() -> None:
    # (1, 2, 4) with f = (8, 10), c = (5, 3): x = 8 / 4 + 5 = 7, y = 10 * 2 / 4 + 3 = 8, depth 4.
    camera = Camera(20, 20, 8.0, 10.0, 5.0, 3.0, EYE4)
    pixels, depth = camera.project(np.array([[1.0, 2.0, 4.0], [0.0, 0.0, -1.0]]))
    assert pixels[0] == pytest.approx([7, 8])
    assert depth == pytest.approx([4, -1])


def test_center_and_forward_invert_the_pose() -> None:
    camera = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=6, height=4, fx=5)
    assert camera.center == pytest.approx([1, 2, 3])
    assert camera.forward == pytest.approx(np.array([-1, -2, -3]) / np.sqrt(14))
    assert camera.rotation @ camera.rotation.T == pytest.approx(np.eye(3))
    assert np.linalg.det(camera.rotation) == pytest.approx(1)


def test_look_at_puts_the_target_in_the_middle_and_up_towards_the_top() -> None:
    camera = look_at(np.array([4.0, 0, 0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=6, height=4, fx=5)
    pixels, depth = camera.project(np.array([[0.0, 0, 0], [0.0, 0, 1], [0.0, 1, 0]]))
    assert pixels[0] == pytest.approx([3, 2])
    assert depth[0] == pytest.approx(4)
    assert pixels[1, 1] < 2  # up is a smaller row
    assert pixels[2] == pytest.approx([3 + 5 / 4, 2])  # looking along -x with z up, +y is to the right


def test_downscaling_cuts_leftover_pixels_and_keeps_rays() -> None:
    # 21 x 11 by 2: 10 x 5, intrinsics halved (not scaled by 10 / 21): the box filter covers the first 20 x 10 pixels.
    camera = Camera(21, 11, 8.0, 10.0, 5.0, 3.0, EYE4)
    small = camera.downscaled(2)
    assert (small.width, small.height, small.fx, small.fy, small.cx, small.cy) == (10, 5, 4.0, 5.0, 2.5, 1.5)
    with pytest.raises(ShapeError, match="leave"):
        camera.downscaled(12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_cam_world": np.eye(3)}, r"T_cam_world must be \[4, 4\], got \[3, 3\]"),
        ({"T_cam_world": EYE4 * np.nan}, "finite"),
        ({"T_cam_world": EYE4 + np.eye(4)[:, ::-1]}, "last row"),
        ({"T_cam_world": np.diag([2.0, 2.0, 2.0, 1.0])}, "determinant"),
        ({"T_cam_world": np.diag([1.0, -1.0, 1.0, 1.0])}, "determinant -1 .*mirroring"),
        ({"T_cam_world": np.diag([1e308, 1.0, 1.0, 1.0])}, "translation"),
        ({"cx": float("nan")}, "finite"),
        ({"fx": float("inf")}, "must be finite"),
        ({"width": 0}, "positive size"),
        ({"fx": -1.0}, "positive"),
    ],
)
def test_invalid_cameras_are_errors(change: dict[str, object], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        replace(Camera(4, 4, 5.0, 5.0, 2.0, 2.0, EYE4), **change)  # type: ignore[arg-type]


def test_a_pose_that_requires_a_gradient_is_kept_as_its_tensor() -> None:
    T = torch.eye(4, requires_grad=True)
    camera = Camera(20, 10, 8.0, 10.0, 5.0, 3.0, T)
    assert camera.pose is T
    assert camera.T_cam_world.dtype == np.float64
    assert camera.resized(10, 5).pose is T
    assert camera.downscaled(2).pose is T
    assert Camera(20, 10, 8.0, 10.0, 5.0, 3.0, torch.eye(4)).pose is None  # it learns nothing
    assert replace(camera, pose=None).pose is None


def test_a_pose_that_differs_from_the_camera_is_an_error() -> None:
    camera = Camera(20, 10, 8.0, 10.0, 5.0, 3.0, torch.eye(4, requires_grad=True))
    with pytest.raises(ShapeError, match="T_cam_world"):
        replace(camera, T_cam_world=EYE4 + np.eye(4, k=3))
