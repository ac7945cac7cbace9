"""Derive the limits of fusion from depth maps: box, voxel, truncation, depth limit.

All limits come from percentiles of the depths of all views, and none from the distance of the nearest camera, so they
fit a walk along a wall as well as an orbit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.camera import Camera
from gs2d.errors import ProtocolError
from gs2d.meshing.depth_maps import DepthMap

FAR_FACTOR = 4.0  # times the median depth; beyond, a pixel is wider than four voxels that fit the median depth
BOX_PERCENTILES = (1.0, 99.0)
DEPTH_PERCENTILE = 99.5
BOX_MARGIN = 0.25  # of the longest side of the percentile box; added on every side
MIN_VOXELS_PER_TRUNCATION = 5.0
MAX_VOXELS_PER_TRUNCATION = 20.0
MAX_TRUNCATION_OF_SIDE = 0.025  # a wider truncation removes thin parts
NOISE_PER_TRUNCATION = 20.0  # times the depth noise: averaging depth maps that disagree needs a wider truncation


@dataclass(frozen=True)
class FusionBounds:
    """Limits of one fusion, and the statistics they are derived from, as plain numbers for JSON (world units)."""

    lower: tuple[float, float, float]  # of the fused box
    upper: tuple[float, float, float]
    side: float  # longest side of the box of the 1st to 99th percentile of the points, or of the requested box
    voxel: float
    truncation: float
    depth_limit: float  # depths beyond are ignored
    depth_median: float  # of all depths
    depth_high: float  # 99.5th percentile of all depths
    pixel_footprint: float  # median width of a pixel on the surface
    cut_fraction: float  # of the valid pixels outside depth limit or box; large if a background is not fused
    depth_noise: float | None = None  # disagreement of neighbouring views, if it was measured


@dataclass(frozen=True, eq=False)
class DepthSample:
    """Sampled pixels of one view."""

    points: np.ndarray  # [P, 3] float64 world units
    depths: np.ndarray  # [P] world units
    footprints: np.ndarray  # [P] world units, depth / focal length
    center: np.ndarray  # [3] world units; camera centre


def backproject(camera: Camera, depth: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the world points [P, 3] of pixel centres (columns, rows) at ``depth`` [P]."""
    x = (columns + 0.5 - camera.cx) / camera.fx * depth
    y = (rows + 0.5 - camera.cy) / camera.fy * depth
    return (np.stack([x, y, depth], axis=1) - camera.T_cam_world[:3, 3]) @ camera.rotation


def sample_depths(item: DepthMap, count: int = 4096) -> DepthSample:
    """Sample about ``count`` valid pixels of a depth map, evenly and deterministically."""
    rows, columns = np.nonzero((item.depth > 0) & np.isfinite(item.depth))
    pick = slice(None, None, max(1, len(rows) // count))
    rows, columns = rows[pick].copy(), columns[pick].copy()  # a view would keep all of them in memory
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
    """Derive the limits from samples of all views; requested limits (world units) override derived ones.

    ``resolution`` is the number of voxels along the longest side of the box of the 1st to 99th percentile of the
    points. The voxel is at least half the median width of a pixel on the surface: smaller voxels contain only
    interpolation. With ``bbox`` [2, 3] this box is fused: it also sets the voxel, and the depth limit includes its
    farthest corner. Raises ProtocolError if no pixel has a depth, or a requested limit is invalid.
    """
    picked = list(samples)
    xyz = np.concatenate([s.points for s in picked]) if picked else np.zeros((0, 3))
    depths = np.concatenate([s.depths for s in picked]) if picked else np.zeros(0)
    footprints = np.concatenate([s.footprints for s in picked]) if picked else np.zeros(0)
    if not len(depths):
        raise ProtocolError("expected depth maps with valid pixels, got none; is the scene empty?")
    check_positive(voxel=voxel, truncation=truncation, depth_limit=depth_limit, resolution=resolution)
    median, high = float(np.median(depths)), float(np.percentile(depths, DEPTH_PERCENTILE))

    if bbox is not None:
        lower, upper = checked_box(bbox)
        limit = _farthest_corner(lower, upper, cameras)
        side = float((upper - lower).max())
    else:
        # the factor keeps surface just beyond the percentile
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
    """Increase the truncation to 20 times the depth noise, but at most to 20 voxels and a 40th of the box."""
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
        raise ProtocolError("expected a bbox in front of a camera, got one behind all; check its coordinate system")
    return float(max(depths))


def check_positive(**values: float | None) -> None:
    """Raise ProtocolError for a number that is not positive and finite; None is accepted."""
    for name, value in values.items():
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ProtocolError(f"{name} must be positive, got {value}")


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
