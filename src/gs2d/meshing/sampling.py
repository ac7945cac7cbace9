"""Interpolate depth maps, and find the blocks that a view can change.

Depth between pixel centres is that of a plane through the nearest pixel. Its slope along each axis is the smaller of
the two one-sided differences (minmod; 0 if their signs differ). On smooth surfaces this is as exact as bilinear
interpolation. At a depth edge the slope comes from one side alone, so no depth between two surfaces is invented, and a
pixel beside the background keeps its full square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.fusion_bounds import FusionBounds

INVALID_DEPTH = np.float32(-1e30)  # depth of invalid pixels: so small that every weight becomes 0, without NaN


@dataclass(frozen=True, eq=False)
class DepthSampler:
    """One depth map, prepared for lookups. Pixel arrays are flat, with a border of one invalid pixel on every side."""

    projection: np.ndarray  # [3, 4] float64: (x z, y z, z), x and y in px including the border
    width: int  # including the border
    height: int
    focal: float  # px, the larger one
    principal: tuple[float, float]  # px, including the border
    depth: np.ndarray  # [P] float32, INVALID_DEPTH at invalid pixels
    slope_x: np.ndarray  # [P] float32 world units/px
    slope_y: np.ndarray
    color: np.ndarray | None  # [P, 3] float32
    weight: np.ndarray | None  # [P] float32
    farthest: tuple[np.ndarray, ...]  # pyramid: largest depth around tiles of 2^(l + 2) px; 0 if invalid

    def signed_distance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the depth at (x, y) px minus z (large and negative if invalid), and flat pixels. Overwrites x, y."""
        np.clip(x, 0, self.width - 1, out=x)
        np.clip(y, 0, self.height - 1, out=y)
        column, row = np.floor(x), np.floor(y)
        pixel = row.astype(np.int64)
        pixel *= self.width
        pixel += column.astype(np.int64)
        x -= column
        y -= row
        x -= np.float32(0.5)
        y -= np.float32(0.5)
        x *= self.slope_x[pixel]
        y *= self.slope_y[pixel]
        depth = self.depth[pixel]
        depth += x
        depth += y
        depth -= z
        return depth, pixel


def make_sampler(item: DepthMap, limits: FusionBounds, truncation: np.ndarray | None = None) -> DepthSampler:
    """Prepare a depth map: apply the depth limit, pad, compute slopes and the pyramid of largest depths.

    ``truncation`` [H, W] world units is that of each pixel, if it varies.
    """
    camera = item.camera
    K = camera.K.copy()
    K[:2, 2] += 1.0  # the border
    depth = np.pad(np.where(item.depth <= limits.depth_limit, item.depth, 0), 1).astype(np.float32)
    valid_depth = np.where(depth > 0, depth, np.float32(np.nan))
    # A slope changes depth by at most half a truncation within the pixel; a steeper one is an edge.
    largest = limits.truncation if truncation is None else np.pad(truncation, 1)
    slope_x = _minmod(valid_depth, axis=1, largest=largest)
    slope_y = _minmod(valid_depth, axis=0, largest=largest)
    color = None if item.color is None else np.pad(item.color, ((1, 1), (1, 1), (0, 0))).astype(np.float32)
    return DepthSampler(
        projection=K @ camera.T_cam_world[:3],
        width=camera.width + 2,
        height=camera.height + 2,
        focal=max(camera.fx, camera.fy),
        principal=(K[0, 2], K[1, 2]),
        depth=np.where(depth > 0, depth, INVALID_DEPTH).reshape(-1),
        slope_x=slope_x.reshape(-1),
        slope_y=slope_y.reshape(-1),
        color=None if color is None else color.reshape(-1, 3),
        weight=None if item.weight is None else np.pad(item.weight, 1).reshape(-1),
        farthest=_pyramid(depth),
    )


def _minmod(depth: np.ndarray, *, axis: int, largest: float | np.ndarray) -> np.ndarray:
    """Return the smaller one-sided difference along an axis; 0 beside invalid pixels, at sign changes and edges."""
    step = np.diff(depth, axis=axis)
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 0)
    back = np.pad(step, pad, constant_values=np.nan)
    pad[axis] = (0, 1)
    ahead = np.pad(step, pad, constant_values=np.nan)
    slope = np.where(np.abs(back) < np.abs(ahead), back, ahead)
    slope = np.where(np.isnan(ahead), back, np.where(np.isnan(back), ahead, slope))  # at a border, only one exists
    slope = np.where(back * ahead < 0, 0, slope)
    return np.where(np.abs(slope) <= largest, slope, 0).astype(np.float32)


def _pyramid(depth: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the largest depth of tiles of 4, 8, 16, ... px and their eight neighbours, up to one tile."""
    levels = []
    size = 4
    while True:
        height, width = -(-depth.shape[0] // size), -(-depth.shape[1] // size)
        padded = np.zeros((height * size, width * size), np.float32)
        padded[: depth.shape[0], : depth.shape[1]] = depth
        tiles = padded.reshape(height, size, width, size).max(axis=(1, 3))
        around = np.pad(tiles, 1)
        columns = np.maximum(np.maximum(around[:, :-2], around[:, 1:-1]), around[:, 2:])
        levels.append(np.maximum(np.maximum(columns[:-2], columns[1:-1]), columns[2:]))
        if height == 1 and width == 1:
            return tuple(levels)
        size *= 2


def may_see(camera: Camera, corners: np.ndarray) -> bool:
    """Whether a camera may see a part of a box with these corners [8, 3].

    False if all corners are behind the camera or beyond one side of the image, including the border.
    """
    x, y, z = (corners @ camera.rotation.T + camera.T_cam_world[:3, 3]).T
    across, down = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z  # px times z, which may be negative
    outside = (z <= 0, across < -z, across > (camera.width + 1) * z, down < -z, down > (camera.height + 1) * z)
    return not any(side.all() for side in outside)


def block_visibility(view: DepthSampler, centers: np.ndarray, radius: float, truncation: float) -> np.ndarray:
    """Return the indices [n] of the blocks (spheres with ``centers`` [M, 3] and ``radius``) that a view may change.

    These are in front of the camera, in the image over a valid pixel, and not more than the truncation behind the
    surface.
    """
    projected = centers @ view.projection[:, :3].T + view.projection[:, 3]
    z = projected[:, 2]
    rows = np.flatnonzero(z > 1.01 * radius)
    z = z[rows]
    x, y = projected[rows, 0] / z, projected[rows, 1] / z
    # |grad (X / Z)| = sqrt(1 + (X / Z)^2) / Z bounds how far from its centre the sphere reaches in the image
    slant = np.hypot(1.0, np.hypot(x - view.principal[0], y - view.principal[1]) / view.focal)
    reach = 1.2 * view.focal * radius / (z - radius) * slant + 1.0  # px
    inside = (x + reach > 0) & (x - reach < view.width) & (y + reach > 0) & (y - reach < view.height)
    rows, x, y, z, reach = rows[inside], x[inside], y[inside], z[inside], reach[inside]
    level = np.ceil(np.log2(np.maximum(reach, 4.0) / 4.0)).astype(np.int64)
    farthest = np.full(len(rows), np.inf)
    for l, tiles in enumerate(view.farthest):
        at = np.flatnonzero(level == l)
        size = 4 << l
        i = np.clip((y[at] // size).astype(np.int64), 0, tiles.shape[0] - 1)
        j = np.clip((x[at] // size).astype(np.int64), 0, tiles.shape[1] - 1)
        farthest[at] = tiles[i, j]
    return rows[(farthest > 0) & (z - radius - 2 * truncation < farthest)]
