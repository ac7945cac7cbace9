"""Compute oriented points of the surface, with the number of views that observe each.

Most points are vertices of the fused surface, which average the depth maps of all views, thinned to one to two pixels.
Where fusion has no surface, pixels of the depth maps are merged instead; each moves along its normal to the mean of the
depth maps that observe it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import DepthMap, Spool
from gs2d.meshing.evidence import GRAZING, VIEWS
from gs2d.meshing.fusion_bounds import FusionBounds
from gs2d.meshing.sampling import DepthSampler, make_sampler
from gs2d.meshing.simplify import pixel_scale
from gs2d.meshing.texture import vertex_normals

PIXELS_APART = 1.5  # width of a voxel: finer ones have more noise than shape
ROUNDS = 2  # iterations of moving the points; a third one changes nothing
KEYS = 21  # bits of a voxel coordinate
MERGE_AT_ONCE = 1 << 21  # pixels that are merged together
APART = 2.0  # spacings: merged pixels closer to a vertex of the fused surface are dropped
SIDES = 60  # first bit of the side that a vertex faces, in a key


@dataclass(frozen=True, eq=False)
class OrientedPoints:
    """Points on the surface, thinned to the resolution of the images."""

    xyz: np.ndarray  # [P, 3] float64, world units
    normals: np.ndarray  # [P, 3] float32 unit vectors towards the cameras
    spacing: np.ndarray  # [P] float32: width of the voxel of the point, world units
    # [P] float32: standard deviation of the depth maps around the point, along its normal, world units
    spread: np.ndarray
    views: np.ndarray  # [P] int32: number of views that observe the point
    colors: np.ndarray | None  # [P, 3] uint8

    def rows(self, rows: np.ndarray) -> OrientedPoints:
        """Return some of the points."""
        chosen: list[Any] = [None if values is None else values[rows] for values in vars(self).values()]
        return OrientedPoints(*chosen)

    def joined(self, others: OrientedPoints) -> OrientedPoints:
        """Return these and other points; without colours, if either has none."""
        pairs = zip(vars(self).values(), vars(others).values(), strict=True)
        both: list[Any] = [None if a is None or b is None else np.concatenate([a, b]) for a, b in pairs]
        return OrientedPoints(*both)

    def apart_from(self, others: OrientedPoints) -> OrientedPoints:
        """Return the points that are farther than ``APART`` spacings from all ``others``."""
        if not len(others.xyz):
            return self
        return self.rows(np.flatnonzero(cKDTree(others.xyz).query(self.xyz)[0] > APART * self.spacing))


def merge_vertices(mesh: Mesh, cameras: Sequence[Camera], limits: FusionBounds, *, apart: float) -> OrientedPoints:
    """Merge the vertices of a fused surface in voxels, as ``merge_pixels`` does, but never those of opposite sides."""
    xyz, normals = mesh.vertices.astype(np.float64), vertex_normals(mesh).astype(np.float64)
    base = apart * limits.pixel_footprint
    levels = np.clip(np.rint(np.log2(apart / pixel_scale(xyz, cameras) / base)), -12, 12).astype(np.int8)
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (normals[np.arange(len(axis)), axis] > 0)
    keys = _keys(xyz, levels, np.asarray(limits.lower), base) ^ (side.astype(np.uint64) << np.uint64(SIDES))
    colors = np.zeros((len(xyz), 0)) if mesh.colors is None else mesh.colors.astype(np.float64)
    merged = _merged([_Voxels(keys, levels, np.concatenate([np.ones((len(xyz), 1)), xyz, normals, colors], axis=1))])
    return _points(merged, base, colored=mesh.colors is not None)


def merge_pixels(maps: Iterable[DepthMap], limits: FusionBounds, *, apart: float) -> OrientedPoints:
    """Merge the valid pixels of all maps in voxels of 2^k times a base width, which is chosen by the width of a pixel.

    ``limits`` are the box and depth limit of the pixels; ``apart`` is the width of a voxel, px. Where voxels of several
    scales overlap, only the finest remain.
    """
    base = apart * limits.pixel_footprint
    merged: list[_Voxels] = []
    waiting: list[_Voxels] = []
    for item in maps:
        waiting.append(_voxels(item, limits, base, apart))
        if sum(len(part.keys) for part in waiting) > MERGE_AT_ONCE:
            merged, waiting = [_merged(merged + waiting)], []
    return _points(_finest(_merged(merged + waiting), np.asarray(limits.lower), base), base, colored=False)


def _points(merged: _Voxels, base: float, *, colored: bool) -> OrientedPoints:
    means = merged.sums[:, 1:] / merged.sums[:, :1]
    normals = means[:, 3:6] / np.maximum(np.linalg.norm(means[:, 3:6], axis=1, keepdims=True), 1e-30)
    count = len(means)
    return OrientedPoints(
        means[:, :3],
        normals.astype(np.float32),
        (base * 2.0**merged.levels).astype(np.float32),
        np.zeros(count, np.float32),
        np.zeros(count, np.int32),
        np.rint(means[:, 6:9]).astype(np.uint8) if colored else None,
    )


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Sums of weight, weighted position, weighted normal and possibly weighted colour in voxels."""

    keys: np.ndarray  # [N] uint64
    levels: np.ndarray  # [N] int8
    sums: np.ndarray  # [N, 7 or 10] float64


def _voxels(item: DepthMap, limits: FusionBounds, base: float, apart: float) -> _Voxels:
    view, camera = make_sampler(item, limits), item.camera
    inner = np.zeros((view.height, view.width), bool)
    inner[1:-1, 1:-1] = True
    pixel = np.flatnonzero((view.depth > 0) & inner.ravel())
    rows, columns = np.divmod(pixel, view.width)
    depth = view.depth[pixel].astype(np.float64)
    u, v = (columns - 0.5 - camera.cx) / camera.fx, (rows - 0.5 - camera.cy) / camera.fy
    local = np.stack([u * depth, v * depth, depth], axis=1)
    xyz = (local - camera.T_cam_world[:3, 3]) @ camera.rotation
    # the surface is (u z, v z, z) of the pixel coordinates, with slopes of z
    across, down = view.slope_x[pixel].astype(np.float64), view.slope_y[pixel].astype(np.float64)
    along_x = np.stack([u * across + depth / camera.fx, v * across, across], axis=1)
    along_y = np.stack([u * down, v * down + depth / camera.fy, down], axis=1)
    normal = -np.cross(along_x, along_y)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    normal = normal @ camera.rotation
    weight = np.ones(len(pixel)) if view.weight is None else view.weight[pixel].astype(np.float64)
    inside = ((xyz >= limits.lower) & (xyz <= limits.upper)).all(axis=1) & (weight > 0)
    xyz, normal, weight, depth = xyz[inside], normal[inside], weight[inside], depth[inside]
    footprint = apart * depth / np.sqrt(camera.fx * camera.fy)
    levels = np.clip(np.rint(np.log2(footprint / base)), -12, 12).astype(np.int8)
    keys = _keys(xyz, levels, np.asarray(limits.lower), base)
    sums = np.concatenate([weight[:, None], weight[:, None] * xyz, weight[:, None] * normal], axis=1)
    return _merged([_Voxels(keys, levels, sums)])


def _keys(xyz: np.ndarray, levels: np.ndarray, lower: np.ndarray, base: float) -> np.ndarray:
    """Return the voxel of each point at its level; the level itself is not part of the key."""
    cells = np.floor((xyz - lower) / (base * 2.0**levels)[:, None]).astype(np.int64) & ((1 << KEYS) - 1)
    return np.asarray(cells[:, 0] | cells[:, 1] << KEYS | cells[:, 2] << 2 * KEYS).astype(np.uint64)


def _merged(parts: list[_Voxels]) -> _Voxels:
    keys = np.concatenate([part.keys for part in parts])
    levels = np.concatenate([part.levels for part in parts])
    sums = np.concatenate([part.sums for part in parts])
    order = np.lexsort((keys, levels))
    keys, levels, sums = keys[order], levels[order], sums[order]
    first = np.flatnonzero(np.r_[len(keys) > 0, (keys[1:] != keys[:-1]) | (levels[1:] != levels[:-1])])
    return _Voxels(keys[first], levels[first], np.add.reduceat(sums, first, axis=0))


def _finest(voxels: _Voxels, lower: np.ndarray, base: float) -> _Voxels:
    """Drop voxels that contain finer ones."""
    xyz = voxels.sums[:, 1:4] / voxels.sums[:, :1]
    keep = np.ones(len(xyz), bool)
    for level in np.unique(voxels.levels):
        here, finer = np.flatnonzero(voxels.levels == level), np.flatnonzero((voxels.levels < level) & keep)
        covered = _keys(xyz[finer], np.full(len(finer), level), lower, base)
        keep[here] = ~np.isin(voxels.keys[here], covered)
    return _Voxels(voxels.keys[keep], voxels.levels[keep], voxels.sums[keep])


@dataclass(frozen=True, eq=False)
class _Observation:
    """Points that a view observes, and points in the free space in front of its surface."""

    rows: np.ndarray  # [S] of observed points
    moves: np.ndarray  # [S] float32 world units along the normal, to the depth of the view
    weights: np.ndarray  # [S] float32
    facing: np.ndarray  # [S] float32 cosine between ray and normal
    pixels: np.ndarray  # [S] of the view
    through: np.ndarray  # [T] rows of points in free space
    against: np.ndarray  # [T] float32 their weights


def _observe(item: DepthMap, view: DepthSampler, points: OrientedPoints, reach: np.ndarray) -> _Observation:
    """Compare points with a view, which observes those within ``reach`` [P] of its depth, along their normals."""
    projected = points.xyz @ view.projection[:, :3].T + view.projection[:, 3]
    z = projected[:, 2].copy()
    z[~(z > 0)] = np.nan
    x, y = projected[:, 0] / z, projected[:, 1] / z
    rows = np.flatnonzero((x >= 1) & (y >= 1) & (x < view.width - 1) & (y < view.height - 1))
    ray = points.xyz[rows] - item.camera.center
    facing = -(ray * points.normals[rows]).sum(axis=1) / np.linalg.norm(ray, axis=1)
    depth = z[rows]
    residual, pixel = view.signed_distance(x[rows], y[rows], depth.copy())
    move = -residual / depth * facing * np.linalg.norm(ray, axis=1)  # along the normal; beyond the point: negative
    weight = np.ones(len(rows), np.float32) if view.weight is None else view.weight[pixel]
    valid = view.depth[pixel] > 0
    visible = np.flatnonzero(valid & (np.abs(move) <= reach[rows]) & (facing > GRAZING))
    endless = np.pad(np.isinf(item.depth), 1).ravel()[pixel]
    through = np.flatnonzero(endless | (valid & (residual * np.abs(facing) > 2 * reach[rows])))
    return _Observation(
        rows[visible],
        move[visible].astype(np.float32),
        weight[visible],
        facing[visible].astype(np.float32),
        pixel[visible],
        rows[through],
        weight[through].astype(np.float32),
    )


def settle(points: OrientedPoints, spool: Spool, limits: FusionBounds, *, rounds: int = ROUNDS) -> OrientedPoints:
    """Move points along their normals to the mean of the depths within the truncation, ``rounds`` times.

    Depths are weighted by the inverse of the cosine between ray and normal, as in a TSDF, which is a mean of distances
    along the rays: highlights make smaller dents in slanted views. Points are dropped if fewer than two views observe
    them, or the weight of free space is larger. With no rounds, points stay where they are.
    """
    reach = np.full(len(points.xyz), limits.truncation)
    for number in range(max(rounds, 1)):
        count = len(points.xyz)
        views = np.zeros(count, np.int32)
        support, total, first, second, against = (np.zeros(count) for _ in range(5))
        shade = np.zeros((count, 3))
        for item in spool:
            view = make_sampler(item, limits)
            observed = _observe(item, view, points, reach)
            views[observed.rows] += 1
            support[observed.rows] += observed.weights
            slanted = observed.weights / observed.facing
            total[observed.rows] += slanted
            first[observed.rows] += slanted * observed.moves
            second[observed.rows] += slanted * observed.moves**2
            against[observed.through] += observed.against
            if number >= rounds - 1 and view.color is not None:
                shade[observed.rows] += slanted[:, None] * view.color[observed.pixels]
        weight = np.maximum(total, 1e-30)
        move = first / weight
        spread = np.sqrt(np.maximum(second / weight - move**2, 0))
        colors = np.rint(shade / weight[:, None]).astype(np.uint8) if points.colors is None else points.colors
        keep = np.flatnonzero((views >= min(VIEWS, len(spool))) & (support > against))
        points = OrientedPoints(
            points.xyz + move[:, None] * points.normals if rounds else points.xyz,
            points.normals,
            points.spacing,
            spread.astype(np.float32),
            views,
            colors,
        ).rows(keep)
        reach = reach[keep]
    return points


def sight_lines(
    points: OrientedPoints, spool: Spool, limits: FusionBounds, *, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return about ``most`` lines of sight per point at most, selected by a fixed rule.

    Returns their points [L] int32, cameras [L] int32 and weights [L] float32: the weight of the pixel, times the number
    of lines that the selected one represents.
    """
    reach = np.full(len(points.xyz), limits.truncation)
    share = np.minimum(1.0, most / np.maximum(points.views, 1))
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number, item in enumerate(spool):
        observed = _observe(item, make_sampler(item, limits), points, reach)
        # a hash of point and view in [0, 1)
        draw = (
            (observed.rows.astype(np.uint64) * np.uint64(2654435761) + np.uint64(number * 40503)) >> np.uint64(8)
        ) & np.uint64(0xFFFF)
        chosen = draw / 65536.0 < share[observed.rows]
        rows = observed.rows[chosen]
        parts.append((rows, np.full(len(rows), number), observed.weights[chosen] / share[rows]))
    rows, cameras, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
    return rows.astype(np.int32), cameras.astype(np.int32), weights.astype(np.float32)
