"""Rotations, neighbour distances, and scale from cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gs2d.core.camera import Camera, look_at
from gs2d.core.transforms import (
    camera_extent,
    camera_outliers,
    focus_point,
    nearest_distances,
    perturb_pose,
    quats_to_matrices,
    se3_exp,
)

UP = np.array([0.0, 0.0, 1.0])


def test_quaternions_are_wxyz_rotations_of_any_length() -> None:
    q = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = Rotation.from_quat(q.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(quats_to_matrices(q).numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(quats_to_matrices(-7 * q).numpy(), expected, atol=1e-12)


def test_a_rigid_motion_rotates_by_its_vector_and_moves_along_its_arc() -> None:
    # A quarter turn about z at speed 2 along x: a quarter of a circle of radius 2 / (pi / 2), to (r, r, 0).
    quarter, r = math.pi / 2, 2 / (math.pi / 2)
    T = se3_exp(torch.tensor([0, 0, quarter, 2, 0, 0], dtype=torch.float64))
    expected = torch.tensor([[0.0, -1, 0, r], [1, 0, 0, r], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(T, expected)
    turn = np.array([0.3, -2.0, 1.1])
    found = se3_exp(torch.tensor([*turn, 0, 0, 0], dtype=torch.float64))[:3, :3].numpy()
    np.testing.assert_allclose(found, Rotation.from_rotvec(turn).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1.0])
def test_a_rigid_motion_is_differentiable_everywhere(size: float) -> None:
    motion = (size * torch.tensor([0.3, -0.2, 0.5, 1, 2, -1], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(se3_exp, (motion,), atol=1e-7)
    assert torch.equal(se3_exp(torch.zeros(6)), torch.eye(4))


def test_a_moved_camera_rotates_about_its_centre_and_moves_along_its_axes() -> None:
    camera = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3), UP, width=6, height=4, fx=5)
    turned = perturb_pose(camera, torch.tensor([0.1, 0.2, 0.3, 0, 0, 0], dtype=torch.float64))
    np.testing.assert_allclose(turned.center, camera.center, atol=1e-14)
    assert turned.pose is None  # nothing learns
    shifted = perturb_pose(camera, torch.tensor([0, 0, 0, 0.0, 0, 0.5], dtype=torch.float64))
    np.testing.assert_allclose(shifted.center, camera.center - 0.5 * camera.forward, atol=1e-14)
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    twice = perturb_pose(perturb_pose(camera, motion), motion)
    assert twice.pose is not None
    twice.pose[0, 3].backward()
    assert motion.grad is not None
    assert motion.grad[3] == pytest.approx(2)  # carried through both


def test_nearest_distances_are_the_rms_to_the_three_nearest_others() -> None:
    # From 0 on a line: the others are at 1, 2, 4, 9; rms of 1, 2, 4 = sqrt(21 / 3).
    points = np.zeros((5, 3))
    points[:, 0] = [0, 1, 2, 4, 9]
    distances = nearest_distances(points)
    assert distances[0] == pytest.approx(math.sqrt(7))
    assert distances[1] == pytest.approx(math.sqrt((1 + 1 + 9) / 3))
    assert nearest_distances(points, k=1)[4] == pytest.approx(5)


def test_the_focus_point_is_where_the_optical_axes_meet() -> None:
    target = np.array([1.0, -2.0, 0.5])
    eyes = target + np.array([[3.0, 0, 0], [0, 4, 1], [-2, -2, 2]])
    cameras = [look_at(eye, target, UP, width=8, height=8, fx=8) for eye in eyes]
    np.testing.assert_allclose(focus_point(cameras), target, atol=1e-12)


def test_the_focus_point_of_parallel_axes_stays_beside_the_cameras() -> None:
    # Axes along +x through (0, +-1, 0): any (x, 0, 0) is as near; the mean centre (0, 0, 0) is taken.
    cameras = [look_at(np.array([0, y, 0]), np.array([5.0, y, 0]), UP, width=8, height=8, fx=8) for y in (-1.0, 1.0)]
    np.testing.assert_allclose(focus_point(cameras), np.zeros(3), atol=1e-9)


def test_the_extent_is_a_tenth_more_than_the_farthest_camera_from_their_mean() -> None:
    # Centres at x = 0, 0, 3: mean 1, farthest 2.
    eyes = [np.array([x, 0.0, 0.0]) for x in (0, 0, 3)]
    cameras = [look_at(eye, np.array([0.0, 9.0, 0.0]), UP, width=8, height=8, fx=8) for eye in eyes]
    assert camera_extent(cameras) == pytest.approx(2.2)
    assert camera_extent(cameras[:1]) == 0


def on_a_ring(*distances: float) -> list[Camera]:
    """Cameras that look at the origin from evenly spread directions, at these distances."""
    angles = np.arange(len(distances)) * 2 * np.pi / len(distances)
    eyes = [r * np.array([np.cos(a), np.sin(a), 0.2]) for r, a in zip(distances, angles, strict=True)]
    return [look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]), width=8, height=8, fx=8) for eye in eyes]


def test_a_camera_far_beyond_all_others_is_an_outlier_and_does_not_set_the_extent() -> None:
    cameras = on_a_ring(1, 1, 1, 1, 1000, 1, 1, 1e100, 1)
    assert list(camera_outliers(cameras)) == [4, 7]
    assert camera_outliers(cameras)[4] == pytest.approx(1000, rel=0.3)
    assert camera_extent(cameras) == camera_extent([c for i, c in enumerate(cameras) if i not in (4, 7)])
    assert camera_extent(cameras) == pytest.approx(1.1, rel=0.5)


@pytest.mark.parametrize(
    "distances",
    [(1,) * 8 + (30,), (1,) * 6 + (100,) * 4, (1, 1, 1000), (1e-12,) * 7 + (1,)],
    ids=["thirty times", "two scales", "three cameras", "most at one place"],
)
def test_plausible_cameras_are_not_outliers_and_set_the_extent(distances: tuple[float, ...]) -> None:
    cameras = on_a_ring(*distances)
    centers = np.stack([camera.center for camera in cameras])
    assert camera_outliers(cameras) == {}
    assert camera_extent(cameras) == 1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()


def test_poses_are_moved_in_batches_as_one_camera_is() -> None:
    generator = torch.Generator().manual_seed(1)
    motions = 0.3 * torch.randn(2, 3, 6, generator=generator, dtype=torch.float64)
    poses = perturb_pose(torch.eye(4, dtype=torch.float64), 0.3 * torch.randn(3, 6, generator=generator).double())
    moved = perturb_pose(poses, motions)
    assert moved.shape == (2, 3, 4, 4)
    for i in range(2):
        for k in range(3):
            camera = Camera(8, 6, 5.0, 5.0, 4.0, 3.0, poses[k].numpy())
            np.testing.assert_allclose(moved[i, k], perturb_pose(camera, motions[i, k]).T_cam_world, atol=1e-12)
    motions = torch.zeros(3, 6, requires_grad=True)
    perturb_pose(poses, motions)[:, :3, 3].sum().backward()
    assert motions.grad is not None
    assert torch.equal(motions.grad[:, 3:], torch.ones(3, 3))
