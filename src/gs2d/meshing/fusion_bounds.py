"""The limits of fusion, from what the cameras saw: the box, the voxel, the truncation, the depth limit.

No limit comes from the distance of the nearest camera, which is a guess about the capture. All come from percentiles
of the depth maps over all views, so a walk along a wall is fused as well as an orbit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.camera import Camera
from gs2d.errors import ProtocolError
from gs2d.meshing.depth_maps import DepthMap

FAR_FACTOR = 4.0  # times the median depth; beyond it a pixel is wider than four voxels made for the median depth
BOX_PERCENTILES = (1.0, 99.0)
DEPTH_PERCENTILE = 99.5
BOX_MARGIN = 0.25  # of the robust box's longest side, on every side: room for what percentiles cut off
MIN_VOXELS_PER_TRUNCATION = 5.0
MAX_VOXELS_PER_TRUNCATION = 20.0
MAX_TRUNCATION_OF_SIDE = 0.025  # a wider band swallows thin parts
NOISE_PER_TRUNCATION = 20.0  # times the depth noise: maps that disagree need a wider band to average in


@dataclass(frozen=True)
class FusionBounds:
    """Limits of one fusion, with the numbers that they come from. Plain numbers, ready for JSON.

    Attributes
    ----------
    lower, upper : tuple of 3 floats, world units
        Box outside which nothing is fused.
    side : float, world units
        Longest side of the box that holds the 1st to 99th percentile of the points (or of the given bbox).
    voxel, truncation, depth_limit : float, world units
        Depths beyond ``depth_limit`` carry nothing.
    depth_median, depth_high : float, world units
        Median and 99.5th percentile of all depths.
    pixel_footprint : float, world units
        Median width of a pixel on the surface.
    cut_fraction : float
        Part of the seen pixels that depth limit or box leave out. Large: the scene has a background that is not fused.
    depth_noise : float or None, world units
        How far views look through what their neighbours see (``consistency.depth_noise``), where it was measured.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    side: float
    voxel: float
    truncation: float
    depth_limit: float
    depth_median: float
    depth_high: float
    pixel_footprint: float
    cut_fraction: float
    depth_noise: float | None = None


@dataclass(frozen=True, eq=False)
class DepthSample:
    """Some pixels of one view."""

    points: np.ndarray  # [P, 3] float64 world units
    depths: np.ndarray  # [P] world units
    footprints: np.ndarray  # [P] world units, depth / focal length
    center: np.ndarray  # [3] world units, of the camera


def backproject(camera: Camera, depth: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """World points [P, 3] of the centres of pixels (columns, rows) at ``depth`` [P]."""
    x = (columns + 0.5 - camera.cx) / camera.fx * depth
    y = (rows + 0.5 - camera.cy) / camera.fy * depth
    return (np.stack([x, y, depth], axis=1) - camera.T_cam_world[:3, 3]) @ camera.rotation


def sample_depths(item: DepthMap, count: int = 4096) -> DepthSample:
    """About ``count`` seen pixels of a depth map, evenly spread (no randomness)."""
    rows, columns = np.nonzero((item.depth > 0) & np.isfinite(item.depth))
    pick = slice(None, None, max(1, len(rows) // count))
    rows, columns = rows[pick].copy(), columns[pick].copy()  # not a view that holds all of them
    depth = item.depth[rows, columns].astype(np.float64)
    camera = item.camera
    footprint = depth / np.sqrt(camera.fx * camera.fy)
    return DepthSample(backproject(camera, depth, rows, columns), depth, footprint, camera.center)


def derive_limits(
    samples: Iterable[DepthSample],
    cameras: Sequence[Camera],
    *,
    resolution: int = 512,
    bbox: np.ndarray | None = None,
    voxel: float | None = None,
    truncation: float | None = None,
    depth_limit: float | None = None,
) -> FusionBounds:
    """Limits from samples of all views; every named limit overrides the derived one.

    Parameters
    ----------
    samples : iterable of DepthSample
        One for each view.
    cameras : sequence of Camera
    resolution : int
        Voxels along the longest side of the box that holds the 1st to 99th percentile of the points. The voxel is
        never finer than half the median width of a pixel on the surface: finer ones hold nothing but interpolation.
    bbox : array [2, 3] world units, optional
        Fuse this box, whole: it also sets the voxel and lifts the depth limit to its farthest corner.
    voxel, truncation, depth_limit : float world units, optional

    Raises
    ------
    ProtocolError
        If no pixel has a depth, or a given limit makes no sense.
    """
    picked = list(samples)
    xyz = np.concatenate([s.points for s in picked]) if picked else np.zeros((0, 3))
    depths = np.concatenate([s.depths for s in picked]) if picked else np.zeros(0)
    footprints = np.concatenate([s.footprints for s in picked]) if picked else np.zeros(0)
    if not len(depths):
        raise ProtocolError("depth maps with at least one seen pixel were expected, got none; is the scene empty?")
    check_positive(voxel=voxel, truncation=truncation, depth_limit=depth_limit, resolution=resolution)
    median, high = float(np.median(depths)), float(np.percentile(depths, DEPTH_PERCENTILE))

    if bbox is not None:
        lower, upper = checked_box(bbox)
        limit = _farthest_corner(lower, upper, cameras)
        side = float((upper - lower).max())
    else:
        # the margin on the percentile keeps what a few views saw just beyond it
        limit = min(high * 1.25, FAR_FACTOR * median) if depth_limit is None else depth_limit
        near = xyz[depths <= limit]
        if not len(near):
            raise ProtocolError(
                f"depth_limit must exceed the nearest depth, {depths.min():.4g} world units, got {limit:g}"
            )
        lower, upper = np.percentile(near, BOX_PERCENTILES, axis=0)
        side = float((upper - lower).max())
        lower, upper = lower - BOX_MARGIN * side, upper + BOX_MARGIN * side
    limit = limit if depth_limit is None else depth_limit
    near_footprints = footprints[depths <= limit]
    footprint = float(np.median(near_footprints if len(near_footprints) else footprints))
    size = voxel if voxel is not None else max(side / resolution, 0.5 * footprint)
    kept = (depths <= limit) & ((xyz >= lower) & (xyz <= upper)).all(axis=1)
    return FusionBounds(
        lower=_triple(lower),
        upper=_triple(upper),
        side=side,
        voxel=float(size),
        truncation=float(truncation if truncation is not None else MIN_VOXELS_PER_TRUNCATION * size),
        depth_limit=float(limit),
        depth_median=median,
        depth_high=high,
        pixel_footprint=footprint,
        cut_fraction=float(1.0 - kept.mean()),
    )


def widen_truncation(limits: FusionBounds, noise: float | None) -> FusionBounds:
    """Widen the truncation to 20 times the depth noise, if that is more: up to 20 voxels, a 40th of the box."""
    if noise is None:
        return limits
    most = min(MAX_VOXELS_PER_TRUNCATION * limits.voxel, MAX_TRUNCATION_OF_SIDE * limits.side)
    wide = min(NOISE_PER_TRUNCATION * noise, most)
    return replace(limits, truncation=max(limits.truncation, wide), depth_noise=noise)


def checked_box(bbox: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both corners of a box, or ProtocolError."""
    box = np.asarray(bbox, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
        raise ProtocolError(f"bbox must be a lower and a higher corner [2, 3], got {np.asarray(bbox).tolist()}")
    return box[0], box[1]


def _farthest_corner(lower: np.ndarray, upper: np.ndarray, cameras: Sequence[Camera]) -> float:
    corners = np.array([[(lower, upper)[c >> a & 1][a] for a in range(3)] for c in range(8)])
    depths = [camera.project(corners)[1].max() for camera in cameras]
    if not depths or max(depths) <= 0:
        raise ProtocolError("a bbox in front of some camera was expected, got one behind all; check its frame")
    return float(max(depths))


def check_positive(**values: float | None) -> None:
    """Raise ProtocolError for a given number that is not positive and finite."""
    for name, value in values.items():
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ProtocolError(f"{name} must be positive, got {value}")


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
