"""Rotations, rigid motions, neighbour distances, and scale, focus and up direction from cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.sh import turns_of_harmonics
from gs2d.core.splats import Splats
from gs2d.errors import ShapeError

OUTLIER = 50  # multiple of the median distance; below, training is not affected
_SPREAD = 0.02  # smallest mean square spread of the horizontal axes for estimating up


def quats_to_matrices(quats: Tensor) -> Tensor:
    """Convert quaternions (w, x, y, z) [N, 4] of any non-zero length to rotation matrices [N, 3, 3].

    A zero quaternion gives NaN, which the rasterizers cull.
    """
    check_shapes({"quats": (quats, "N 4")})
    too_long = quats.detach().abs().amax(dim=1, keepdim=True) > 1e15  # its square overflows float32
    quats = torch.where(too_long, quats * 2.0**-80, quats)
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def se3_exp(motion: Tensor) -> Tensor:
    """Return the rigid motion [..., 4, 4] of a twist [..., 6]: exact, and differentiable at 0 too.

    A twist is a rotation vector (axis times angle, rad), then a velocity (world units): the motion of a body that
    rotates and moves at these rates for one unit of time.
    """
    if not motion.ndim or motion.shape[-1] != 6:
        raise ShapeError(f"motion must be [..., 6], a rotation vector and a velocity, got {list(motion.shape)}")
    x, y, z, u, v, w = motion.unbind(-1)
    o = torch.zeros_like(x)
    rows = ((o, -z, y, u), (z, o, -x, v), (-y, x, o, w), (o, o, o, o))
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2))


@overload
def perturb_pose(camera: Camera, motion: Tensor) -> Camera: ...
@overload
def perturb_pose(camera: Tensor, motion: Tensor) -> Tensor: ...
def perturb_pose(camera: Camera | Tensor, motion: Tensor) -> Camera | Tensor:
    """Move cameras in their own frames: ``T_cam_world`` becomes ``exp(motion) @ T_cam_world``.

    The rotation is about the camera's own centre. The motion is exact and has a gradient everywhere, also at 0. Where
    ``motion`` or the pose requires a gradient, ``gs2d.rasterize`` carries it through the result.

    Parameters
    ----------
    camera : Camera or Tensor [..., 4, 4]
        One camera, or world-to-camera poses.
    motion : Tensor [..., 6]
        Rotation vector (axis times angle, rad), then velocity (world units); without rotation the velocity is the
        translation in the camera's frame. [6] for a Camera; leading dimensions broadcast against those of poses.
        Prefer float64: a Camera keeps all digits.

    Returns
    -------
    Camera or Tensor [..., 4, 4]
        The moved camera or poses; a tensor has the dtype and the device of ``motion``.

    Raises
    ------
    ShapeError
        If a shape is wrong, leading dimensions do not broadcast, or there are several motions for one Camera.

    Examples
    --------
    >>> import torch
    >>> poses = torch.eye(4).expand(3, 4, 4)
    >>> perturb_pose(poses, torch.zeros(3, 6)).shape
    torch.Size([3, 4, 4])
    """
    T = se3_exp(motion)
    if isinstance(camera, Camera):
        if motion.ndim != 1:
            raise ShapeError(
                f"motion must be [6] for one camera, got {list(motion.shape)}; pass poses [..., 4, 4] to move several"
            )
        pose = torch.as_tensor(camera.T_cam_world) if camera.pose is None else camera.pose
        placed: Any = T @ pose.to(T)
        return replace(camera, T_cam_world=placed, pose=None)
    if camera.shape[-2:] != (4, 4):
        raise ShapeError(f"poses must be [..., 4, 4], got {list(camera.shape)}")
    try:
        torch.broadcast_shapes(camera.shape[:-2], motion.shape[:-1])
    except RuntimeError as error:
        shapes = f"poses {list(camera.shape)} and motion {list(motion.shape)}"
        raise ShapeError(f"leading dimensions must broadcast, got {shapes}; pass one motion per pose") from error
    return T @ camera.to(T)


def similarity_motions(poses: np.ndarray, extent: float) -> np.ndarray:
    """Return the derivative [V, 6, 7] of camera motions by a small similarity of the scene.

    The motions of the cameras with ``poses`` T_cam_world [V, 4, 4] are in camera frames (rad, extents). The similarity
    is the rotation of the scene about the mean camera centre (rad), its translation (extents) and its relative scale.
    """
    R = poses[:, :3, :3]
    centers = -np.einsum("vji,vj->vi", R, poses[:, :3, 3])
    arms = (centers - centers.mean(axis=0)) / extent  # [V, 3]
    x, y, z = arms.T
    o = np.zeros_like(x)
    J = np.zeros((len(poses), 6, 7))
    J[:, :3, :3] = J[:, 3:, 3:6] = -R
    J[:, 3:, :3] = R @ np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)  # -R (w x arm)
    J[:, 3:, 6] = -np.einsum("vij,vj->vi", R, arms)
    return J


def common_motion(motions: np.ndarray, by_similarity: np.ndarray) -> np.ndarray:
    """Fit the similarity [7] whose camera motions are nearest to ``motions`` [V, 6] (least squares)."""
    products = np.einsum("via,vib->ab", by_similarity, by_similarity)
    inverse = np.linalg.pinv(products, rcond=1e-9, hermitian=True)  # singular for one camera, or equal centres
    return np.asarray(inverse @ np.einsum("via,vi->a", by_similarity, motions))


def nearest_distances(points: np.ndarray, k: int = 3) -> np.ndarray:
    """Return the root mean square distance [P] of each point to its k nearest others (initial scale of a splat).

    Points [P, 3] and distances are in world units, float64; coincident points have 0. With fewer than k others all
    count. Raises ShapeError if there are fewer than two points, k is not positive, or a coordinate is not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    check_shapes({"points": (points, "P 3")})
    if len(points) < 2 or k < 1:
        raise ShapeError(f"nearest_distances needs at least 2 points and k >= 1, got {len(points)} points and k={k}")
    if not np.isfinite(points).all():
        raise ShapeError("nearest_distances needs finite points, got NaN or infinity; remove those points")
    k = min(k, len(points) - 1)
    distances = np.asarray(cKDTree(points).query(points, k=k + 1)[0])  # the first is the point itself
    return np.asarray(np.sqrt(np.mean(distances[:, 1:] ** 2, axis=1)))


def focus_point(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the point [3] with the least sum of squared distances to the optical axes, world units.

    Where the axes do not determine it (parallel axes, one camera), the point nearest to the mean camera centre is used.
    """
    centers = np.stack([camera.center for camera in cameras])  # [V, 3]
    axes = np.stack([camera.forward for camera in cameras])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [V, 3, 3] onto the plane across each axis
    origin = centers.mean(axis=0)
    right = np.einsum("vij,vj->i", projectors, centers - origin)
    offset = np.linalg.lstsq(projectors.sum(axis=0), right, rcond=1e-9)[0]
    return np.asarray(origin + offset)


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Estimate the up direction [3], unit, from cameras held level: perpendicular to their horizontal axes.

    If these are nearly parallel, the mean of the up vectors of the cameras is returned. Unlike that mean, the estimate
    is not tilted if all cameras look down from one side.
    """
    rotations = np.stack([camera.rotation for camera in cameras])  # [V, 3, 3]
    mean_up = -rotations[:, 1].mean(axis=0)
    squares, directions = np.linalg.eigh(rotations[:, 0].T @ rotations[:, 0] / len(cameras))  # ascending
    up = directions[:, 0] if squares[1] > max(_SPREAD, 4 * squares[0]) else mean_up
    if not np.linalg.norm(up) > 1e-9:
        up = -rotations[0, 1]
    up = up / np.linalg.norm(up)
    return np.asarray(up if up @ mean_up >= 0 else -up)


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Return 1.1 x the largest distance of a camera from the mean centre, world units (scene extent of 2DGS).

    Ignores outliers (:func:`camera_outliers`). 0 for a single camera.
    """
    outliers = camera_outliers(cameras)
    centers = np.stack([camera.center for i, camera in enumerate(cameras) if i not in outliers])
    return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def camera_outliers(cameras: Sequence[Camera]) -> dict[int, float]:
    """Return cameras with implausible positions, which structure from motion leaves sometimes.

    They are indices in ``cameras``, with their distance divided by the median distance. An outlier is more than
    ``OUTLIER`` times as far from the median centre as the median camera. If this holds for more than a quarter of the
    cameras, or most centres coincide, none is an outlier.
    """
    if len(cameras) < 4:
        return {}
    centers = np.stack([camera.center for camera in cameras])
    middle = np.median(centers, axis=0)
    with np.errstate(over="ignore"):
        distances = np.linalg.norm(centers - middle, axis=1)
    typical = float(np.median(distances))
    far = np.flatnonzero(distances > OUTLIER * typical)
    if typical <= 1e-9 * (1 + np.abs(middle).max()) or 4 * len(far) > len(cameras):
        return {}
    return {int(i): float(distances[i] / typical) for i in far}


def transform_splats(splats: Splats, scale: float, rotation: np.ndarray, translation: np.ndarray) -> Splats:
    """Apply x -> scale * rotation @ x + translation to splats, including their SH.

    Computed in float64; returns float32 on the CPU.
    """
    from scipy.spatial.transform import Rotation

    R, turn = torch.from_numpy(np.asarray(rotation, np.float64)), Rotation.from_matrix(np.asarray(rotation, np.float64))
    x, y, z, w = turn.as_quat()
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    a = {name: tensor.detach().to("cpu", torch.float64) for name, tensor in splats.items()}
    shN = a["shN"]
    if shN.shape[1]:
        rate = torch.einsum("a,ajk->jk", torch.from_numpy(turn.as_rotvec()), turns_of_harmonics(splats.sh_degree))
        shN = torch.einsum("jk,nkc->njc", torch.linalg.matrix_exp(rate), shN)  # orthogonal: coefficients turn as values
    return Splats(
        means=scale * (a["means"] @ R.T) + torch.from_numpy(np.asarray(translation, np.float64)),
        quats=a["quats"] @ left.T,
        log_scales=a["log_scales"] + float(np.log(scale)),
        opacity_logits=a["opacity_logits"],
        sh0=a["sh0"],
        shN=shN,
    ).to(torch.float32)


def perpendicular(units: Tensor) -> Tensor:
    """Return two unit vectors [..., 2, 3] at right angles to each unit vector [..., 3] and to each other.

    They are the axes x and y, turned with the axis z to the vector (with -z, where that is nearer).
    """
    x, y, z = units.unbind(dim=-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(units)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    return torch.stack([first, torch.stack([b, sign + y * y * a, -y], dim=-1)], dim=-2)
