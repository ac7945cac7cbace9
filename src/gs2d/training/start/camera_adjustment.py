"""Cameras adjusted before training, so that depth maps of a plane sweep agree (docs/math.md, "Adjusted cameras").

Structure from motion and phone trackers estimate a camera from a few hundred points. Where they are off by half a
pixel, depth maps of different image pairs do not coincide, and training blurs details. The
swept depth maps match thousands of pixels, which a bundle adjustment turns into better poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from gs2d.config.recipe import DenseStart
from gs2d.core.transforms import se3_exp
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.training.start.plane_sweep import SmallView, Sweep, sweep_views

CELL = 5  # px of downscaled images: the pixel with the most texture in each cell of this size is matched
TEXTURE = 2e-5  # squared gradient of grey values, mean of a patch, below which a pixel is not matched
RADIUS = 3  # px: patches have 2 RADIUS + 1 pixels a side, as in the sweep
MIN_NCC = 0.6  # of patches that match
FARTHEST = 1.5  # px: matches are farther from their prediction only by mistake
NOISE = 1 / 255  # standard deviation of grey values
ROUNDS = 4  # of sweep and adjustment; one is enough for errors up to a pixel of downscaled images
TURNS, STEPS = 3, 4  # times that patches are matched again, and Gauss-Newton steps for each
DOUBT = 4.0  # standard deviations of a match at which its weight is halved
INDEPENDENT = 1 / 400  # share of the matches: neighbouring pixels, and pixels on the same highlight, err together
EXPECTED = 0.5  # px of downscaled images: standard deviation of the errors of the initial cameras
GAIN = 0.9  # adjusted cameras are used if the median error across epipolar lines falls below this factor


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels of a view that are matched."""

    at: np.ndarray  # [M, 2] int; column and row
    rays: np.ndarray  # [M, 3] camera coordinates at depth 1
    inverse: np.ndarray  # [M] inverse depth; changed in place


@dataclass(frozen=True, eq=False)
class _Matches:
    """Pixels of a view matched in another one."""

    other: int
    rows: np.ndarray  # [m] int; which of the pixels
    places: np.ndarray  # [m, 2] px; positions in the other view
    information: np.ndarray  # [m, 2, 2] inverse covariance of the places


def adjust_cameras(scene: Scene, settings: DenseStart) -> tuple[Scene, Sweep | None]:
    """Return the scene with adjusted training cameras, and the plane sweep from them.

    The scene is returned unchanged if its cameras are as good as the matches, or if it cannot be swept.
    """
    try:
        for _ in range(ROUNDS):  # from better cameras, more pixels get a depth
            sweep = sweep_views(scene, settings)
            poses = adjusted_poses(sweep)
            if poses is None:
                return scene, sweep
            scene = scene.with_poses({view.name: pose for view, pose in zip(scene.train, poses, strict=True)})
        return scene, sweep_views(scene, settings)
    except DataError:  # the dense start reports it
        return scene, None


def adjusted_poses(sweep: Sweep) -> np.ndarray | None:
    """Return T_cam_world [V, 4, 4] at which the images match best; None if the initial poses match as well."""
    poses = np.stack([view.T for view in sweep.views]).astype(np.float64)
    initial = poses.copy()
    pixels = [_pixels(sweep, index) for index in range(len(poses))]
    before = None
    for _ in range(TURNS):
        matches = [_matched(sweep, index, pixels[index], poses) for index in range(len(poses))]
        before = _across(sweep.views, pixels, matches, poses) if before is None else before
        for _ in range(STEPS):
            _step(sweep.views, pixels, matches, poses, initial)
        if not _across(sweep.views, pixels, matches, poses) < GAIN * before:
            return None
    return poses


def _pixels(sweep: Sweep, index: int) -> _Pixels:
    """Choose the pixels of a view to match: with consistent depth and texture, spread over the image."""
    view, depth = sweep.views[index], sweep.depths[index]
    score = np.zeros(depth.shape)
    inner = (slice(RADIUS, -RADIUS),) * 2
    if sweep.neighbours[index] and min(depth.shape) > max(2 * RADIUS, CELL):
        texture = F.avg_pool2d(_gradients(view)[:, 1:].square().sum(dim=1, keepdim=True), 2 * RADIUS + 1, 1)
        score[inner] = np.where(sweep.consistent(index)[inner], texture[0, 0].numpy(), 0)
    height, width = view.size[0] // CELL, view.size[1] // CELL
    squares = score[: height * CELL, : width * CELL].reshape(height, CELL, width, CELL)
    cells = squares.transpose(0, 2, 1, 3).reshape(height, width, CELL * CELL)
    y, x = np.nonzero(cells.max(axis=2, initial=0) > TEXTURE)
    within = cells[y, x].argmax(axis=1)
    column, row = x * CELL + within % CELL, y * CELL + within // CELL
    rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1) @ np.linalg.inv(view.K).T
    return _Pixels(np.stack([column, row], axis=1), rays, 1 / depth[row, column])


def _gradients(view: SmallView) -> torch.Tensor:
    """Return grey values and their derivatives along x and y, [1, 3, H, W]."""
    grey = view.grey
    along_x = F.pad(grey, (1, 1, 0, 0), mode="replicate")
    along_y = F.pad(grey, (0, 0, 1, 1), mode="replicate")
    steps = (along_x[..., 2:] - along_x[..., :-2], along_y[..., 2:, :] - along_y[..., :-2, :])
    return torch.cat([grey, *(0.5 * step for step in steps)], dim=1)


def _matched(sweep: Sweep, index: int, pixels: _Pixels, poses: np.ndarray) -> list[_Matches]:
    """Match patches around pixels of a view in its neighbours: one step of Lucas and Kanade from the prediction.

    Patches are compared at zero mean and equal variance, so exposure does not matter.
    """
    view, matches = sweep.views[index], []
    near = np.arange(-RADIUS, RADIUS + 1)
    columns = (pixels.at[:, :1] + np.tile(near, len(near))).clip(0, view.size[1] - 1)  # [M, K]
    rows = (pixels.at[:, 1:] + np.repeat(near, len(near))).clip(0, view.size[0] - 1)
    own = view.grey[0, 0].numpy()[rows, columns].astype(np.float64)
    own -= own.mean(axis=1, keepdims=True)
    spread = own.std(axis=1) + NOISE
    centres = np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)], axis=-1)
    for other in sweep.neighbours[index] if len(own) else ():
        target = sweep.views[other]
        motion = poses[other] @ np.linalg.inv(poses[index])
        turned = centres @ (target.K @ motion[:3, :3] @ np.linalg.inv(view.K)).T
        turned += (target.K @ motion[:3, 3]) * pixels.inverse[:, None, None]
        at = turned[..., :2] / np.maximum(turned[..., 2:], 1e-9)  # [M, K, 2]
        size = np.array(target.size[::-1])
        usable = ((turned[..., 2:] > 0) & (at > 1) & (at < size - 1)).all(axis=(1, 2))
        grid = torch.from_numpy(2 * at / size - 1).float()[None]
        there = F.grid_sample(_gradients(target), grid, align_corners=False, padding_mode="border")[0].double().numpy()
        there -= there.mean(axis=2, keepdims=True)
        scale = there[0].std(axis=1) + NOISE
        usable &= (own * there[0]).mean(axis=1) / (spread * scale) > MIN_NCC
        slope = np.moveaxis(there[1:], 0, -1)  # [M, K, 2]
        rest = own * (scale / spread)[:, None] - there[0]
        products = np.einsum("mka,mkb->mab", slope, slope)
        shift = np.einsum("mab,mb->ma", np.linalg.pinv(products, hermitian=True), np.einsum("mka,mk->ma", slope, rest))
        noise = (rest - np.einsum("mka,ma->mk", slope, shift)).var(axis=1) + NOISE**2
        which = np.flatnonzero(usable & (np.abs(shift) < FARTHEST).all(axis=1))
        places = at[which, len(near) ** 2 // 2] + shift[which]
        matches.append(_Matches(other, which, places, products[which] / noise[which, None, None]))
    return matches


@dataclass(frozen=True, eq=False)
class _Linear:
    """Errors of matches, and derivatives of the predictions."""

    errors: np.ndarray  # [m, 2] px: match minus prediction
    by_own: np.ndarray  # [m, 2, 6] motion of the camera of the view
    by_other: np.ndarray  # [m, 2, 6] of the other
    by_inverse: np.ndarray  # [m, 2] inverse depth


def _linear(target: SmallView, pixels: _Pixels, index: int, match: _Matches, poses: np.ndarray) -> _Linear:
    """Linearise the predictions of matches at the current poses and depths."""
    own = pixels.rays[match.rows] / pixels.inverse[match.rows, None]
    motion = poses[match.other] @ np.linalg.inv(poses[index])
    there = own @ motion[:3, :3].T + motion[:3, 3]
    z, focal = np.maximum(there[:, 2:], 1e-9), np.diag(target.K)[:2]
    flat = there[:, :2] / z
    by_point = np.zeros((len(own), 2, 3))
    by_point[:, (0, 1), (0, 1)] = focal / z
    by_point[:, :, 2] = -focal * flat / z
    back = by_point @ motion[:3, :3]
    by_inverse = np.einsum("mab,mb->ma", back, -own / pixels.inverse[match.rows, None])
    errors = match.places - (flat * focal + target.K[:2, 2])
    return _Linear(errors, -back @ _moved(own), by_point @ _moved(there), by_inverse)


def _moved(points: np.ndarray) -> np.ndarray:
    """Return the derivative [m, 3, 6] of points [m, 3] by a small motion: rotation vector and shift."""
    result = np.zeros((len(points), 3, 6))
    x, y, z = points.T
    for (row, column), value in {(0, 1): z, (0, 2): -y, (1, 0): -z, (1, 2): x, (2, 0): y, (2, 1): -x}.items():
        result[:, row, column] = value
    result[:, (0, 1, 2), (3, 4, 5)] = 1
    return result


def _across(
    views: Sequence[SmallView], pixels: Sequence[_Pixels], matches: Sequence[list[_Matches]], poses: np.ndarray
) -> float:
    """Return the median error across epipolar lines, px: depth cannot explain it."""
    parts = [np.zeros(0)]
    for index, some in enumerate(matches):
        for match in some:
            linear = _linear(views[match.other], pixels[index], index, match, poses)
            line = linear.by_inverse / np.maximum(np.linalg.norm(linear.by_inverse, axis=1, keepdims=True), 1e-12)
            parts.append(np.abs(linear.errors[:, 0] * line[:, 1] - linear.errors[:, 1] * line[:, 0]))
    errors = np.concatenate(parts)
    return float(np.median(errors)) if len(errors) else 0.0


def _step(
    views: Sequence[SmallView],
    pixels: Sequence[_Pixels],
    matches: Sequence[list[_Matches]],
    poses: np.ndarray,
    initial: np.ndarray,
) -> None:
    """Do a Gauss-Newton step for poses and depths, in place.

    A match in a view involves the camera of that view, one other camera and one depth; the depths are eliminated view
    by view (Schur complement).
    """
    parts, right, depths = [], np.zeros((len(views), 6)), []
    for index, some in enumerate(matches):
        cameras = [index, *(match.other for match in some)]
        count, size = len(pixels[index].inverse), 6 * len(cameras)
        mixed, own, force = np.zeros((count, size)), np.zeros(count), np.zeros(count)
        normal, push = np.zeros((size, size)), np.zeros(size)
        for place, match in enumerate(some, start=1):
            linear = _linear(views[match.other], pixels[index], index, match, poses)
            off = np.einsum("ma,mab,mb->m", linear.errors, match.information, linear.errors)
            weights = match.information * (INDEPENDENT / (1 + off / DOUBT**2))[:, None, None]
            columns = np.r_[0:6, 6 * place : 6 * place + 6]
            by_camera = np.concatenate([linear.by_own, linear.by_other], axis=2)  # [m, 2, 12]
            weighted = weights @ by_camera
            normal[np.ix_(columns, columns)] += np.einsum("mac,mad->cd", by_camera, weighted)
            push[columns] += np.einsum("mac,ma->c", weighted, linear.errors)
            mixed[np.ix_(match.rows, columns)] += np.einsum("mac,ma->mc", weighted, linear.by_inverse)
            heavy = np.einsum("mab,mb->ma", weights, linear.by_inverse)
            own[match.rows] += (linear.by_inverse * heavy).sum(axis=1)
            force[match.rows] += (linear.errors * heavy).sum(axis=1)
        constrained = own > 0
        inverse = np.where(constrained, 1 / np.where(constrained, own, 1), 0)
        normal -= mixed.T @ (mixed * inverse[:, None])
        push -= mixed.T @ (inverse * force)
        at = (6 * np.array(cameras)[:, None] + np.arange(6)).reshape(-1)
        parts.append((np.repeat(at, size), np.tile(at, size), normal.reshape(-1)))
        np.add.at(right.reshape(-1), at, push)
        depths.append((inverse, force, mixed, at))
    focal = np.array([view.K[0, 0] for view in views])
    middle = np.array([np.median(own.inverse) if len(own.inverse) else 1.0 for own in pixels])
    stiff = (focal / EXPECTED)[:, None] * np.stack([np.ones_like(middle)] * 3 + [middle] * 3, axis=1)
    moved = poses @ np.linalg.inv(initial)
    turns = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()
    right -= stiff**2 * np.concatenate([turns, moved[:, :3, 3]], axis=1)
    rows, columns, values = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    matrix = coo_matrix((values, (rows, columns)), shape=(right.size, right.size)).tocsc()
    motion = spsolve(matrix + diags(stiff.reshape(-1) ** 2, format="csc"), right.reshape(-1))
    for index, (inverse, force, mixed, at) in enumerate(depths):
        now = pixels[index].inverse
        np.clip(now + inverse * (force - mixed @ motion[at]), 0.9 * now, 1.1 * now, out=now)
        own_motion = torch.from_numpy(motion[6 * index : 6 * index + 6])
        poses[index] = se3_exp(own_motion).numpy() @ poses[index]
