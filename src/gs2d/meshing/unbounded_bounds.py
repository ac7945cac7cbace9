"""The limits of an unbounded scene: a nest of cubes, each twice as large as the one inside it and half as fine.

All cubes have one centre and the same number of voxels along a side. A level owns its cube without the cube inside, so
every place belongs to exactly one level, and a voxel grows with the distance from the centre as the width of a pixel
does. Truncation follows the voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.camera import Camera
from gs2d.errors import ProtocolError
from gs2d.meshing.bounds import (
    BOX_PERCENTILES,
    DEPTH_PERCENTILE,
    FAR_FACTOR,
    MIN_VOXELS_PER_TRUNCATION,
    DepthSample,
    FusionBounds,
    check_positive,
    checked_box,
)
from gs2d.meshing.volume import BLOCK

STEP = 4 * BLOCK  # voxels along a side are a multiple: the middle half of a level is made of whole blocks
MAX_LEVELS = 24
PIXEL_ERROR = 0.5  # px, of matching between views: decides how far away depth is still known


@dataclass(frozen=True)
class TsdfCascade:
    """Levels of an unbounded fusion, finest first.

    Attributes
    ----------
    levels : tuple of FusionLimits
        ``lower`` of a level is its first voxel, half a voxel inside its cube.
    voxels : int
        Along a side of every level, a multiple of ``STEP``.
    center : tuple of 3 floats, world units
    half : float, world units
        Half the side of the innermost cube.
    """

    levels: tuple[FusionBounds, ...]
    voxels: int
    center: tuple[float, float, float]
    half: float

    @property
    def dims(self) -> tuple[int, int, int]:
        """Blocks along x, y, z of every level."""
        return (self.voxels // BLOCK,) * 3

    @property
    def hole(self) -> tuple[int, int]:
        """First block of the middle half of a level, along each axis, and the first one after it."""
        return self.voxels // STEP, 3 * self.voxels // STEP

    def level_of(self, points: np.ndarray) -> np.ndarray:
        """Level [P] that owns each point [P, 3]; ``len(levels)`` outside of all."""
        distance = np.abs(points - np.asarray(self.center)).max(axis=1) / self.half
        return np.clip(np.ceil(np.log2(np.maximum(distance, 1.0))), 0, len(self.levels)).astype(np.int64)

    def with_truncation(self, truncation: float, noise: float | None) -> TsdfCascade:
        """Another truncation of the innermost level; the others follow."""
        levels = tuple(
            replace(level, truncation=truncation * 2**k, depth_noise=noise) for k, level in enumerate(self.levels)
        )
        return replace(self, levels=levels)


def derive_cascade(
    samples: Sequence[DepthSample],
    cameras: Sequence[Camera],
    *,
    resolution: int = 512,
    bbox: np.ndarray | None = None,
    voxel: float | None = None,
    truncation: float | None = None,
    depth_limit: float | None = None,
) -> TsdfCascade:
    """Return the nest of a scene, from samples of all views; every named limit overrides the derived one.

    The innermost cube holds the 1st to 99th percentile of the nearer half of all that was seen. The outermost holds
    what is nearer than the depth limit: 1.25 times the 99.5th percentile of depth, but no farther than depth is known
    to within the truncation (``valid_depth``); beyond it the sky and bare walls make surfaces of their own.

    Parameters
    ----------
    samples : sequence of DepthSample
    cameras : sequence of Camera
    resolution : int
        Voxels along the side of the innermost cube, not finer than half the median pixel on the nearer half.
    bbox : array [2, 3] world units, optional
        The innermost cube is the cube around it.
    voxel, truncation : float world units, optional
        Of the innermost level.
    depth_limit : float world units, optional

    Raises
    ------
    ProtocolError
        If no pixel has a depth, or a given limit makes no sense.
    """
    xyz = np.concatenate([s.points for s in samples]) if samples else np.zeros((0, 3))
    depths = np.concatenate([s.depths for s in samples]) if samples else np.zeros(0)
    if not len(depths):
        raise ProtocolError("depth maps with at least one seen pixel were expected, got none; is the scene empty?")
    check_positive(voxel=voxel, truncation=truncation, depth_limit=depth_limit, resolution=resolution)
    footprints = np.concatenate([s.footprints for s in samples])
    median, high = float(np.median(depths)), float(np.percentile(depths, DEPTH_PERCENTILE))
    near = depths <= median
    footprint = float(np.median(footprints[near]))
    lower, upper = np.percentile(xyz[near], BOX_PERCENTILES, axis=0) if bbox is None else checked_box(bbox)
    side = float((upper - lower).max())
    if not side > 0:
        raise ProtocolError("depth maps that span some space were expected, got a single point; give a bbox")
    size = voxel if voxel is not None else max(side / resolution, 0.5 * footprint)
    voxels = max(1, int(np.ceil(side / size / STEP - 1e-9))) * STEP
    half, center = 0.5 * voxels * size, (lower + upper) / 2
    band = truncation if truncation is not None else MIN_VOXELS_PER_TRUNCATION * size
    limit = depth_limit
    if limit is None:
        limit = min(high * 1.25, max(valid_depth(cameras, band / half), FAR_FACTOR * median))
    kept = depths <= limit
    if not kept.any():
        raise ProtocolError(f"depth_limit must exceed the nearest depth, {depths.min():.4g} world units, got {limit:g}")
    reach = float(np.abs(xyz[kept] - center).max()) / half
    count = min(MAX_LEVELS, 1 + int(np.ceil(np.log2(max(reach, 1.0)))))
    levels = []
    for k in range(count):
        first = center - half * 2**k + 0.5 * size * 2**k
        last = center + half * 2**k
        levels.append(
            FusionBounds(
                lower=(float(first[0]), float(first[1]), float(first[2])),
                upper=(float(last[0]), float(last[1]), float(last[2])),
                side=2 * half * 2**k,
                voxel=float(size * 2**k),
                truncation=float(band * 2**k),
                depth_limit=float(limit),
                depth_median=median,
                depth_high=high,
                pixel_footprint=footprint,
                cut_fraction=float(1 - kept.mean()),
            )
        )
    middle = (float(center[0]), float(center[1]), float(center[2]))
    return TsdfCascade(tuple(levels), voxels, middle, float(half))


def valid_depth(cameras: Sequence[Camera], band: float) -> float:
    """Depth, world units, at which half a pixel of parallax moves a point by as much as the truncation there.

    A point at depth z seen from a baseline b with a focal length f has a depth uncertainty of e z^2 / (b f), with e the
    error of matching in px; the truncation is ``band`` z. So z = band b f / e. The baseline is twice the median
    distance of the cameras from their mean. Infinite for cameras in one place, which know no depth by parallax.
    """
    centers = np.array([camera.center for camera in cameras])
    baseline = 2 * float(np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
    focal = float(np.median([np.sqrt(camera.fx * camera.fy) for camera in cameras]))
    return band * baseline * focal / PIXEL_ERROR if baseline > 0 else float("inf")
