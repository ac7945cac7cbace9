"""Cascades filled from analytic fields, and an outdoor scene with wrong sky depths."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gs2d.contrib.surfaces.unbounded import CascadeSurface, TsdfCascade, find_cascade_blocks, fused_cascade_surface
from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import DepthMap, RenderedView
from gs2d.meshing.fusion_bounds import FusionBounds
from gs2d.meshing.tsdf_volume import BLOCK, VOXELS, Volume
from surface_shapes import rays, sphere_depth

GROUND, BALL = -0.6, 0.6  # height of the plane, radius of the ball on it


def cascade_of(
    count: int, *, voxels: int = 32, half: float = 1.0, truncation: float | None = None, depth_limit: float = 1e9
) -> TsdfCascade:
    """Return a cascade of ``count`` levels around the origin."""
    size = 2 * half / voxels
    levels = []
    for k in range(count):
        first, last = (-half + 0.5 * size) * 2**k, half * 2**k
        band = (truncation or 5 * size) * 2**k
        low, high = (first, first, first), (last, last, last)
        levels.append(FusionBounds(low, high, 2 * last, size * 2**k, band, depth_limit, 1.0, 1.0, size, 0.0))
    return TsdfCascade(tuple(levels), voxels, (0.0, 0.0, 0.0), half)


def volumes_of(cascade: TsdfCascade, field: Callable[[np.ndarray], np.ndarray]) -> list[Volume]:
    """Fill every level with a field of points [P, 3] -> signed distance [P]; all voxels are observed."""
    volumes = []
    local = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1)
    for k, limits in enumerate(cascade.levels):
        blocks = np.stack(np.unravel_index(np.arange(cascade.dims[0] ** 3), cascade.dims), axis=1)
        first, last = cascade.hole
        blocks = blocks[~((blocks >= first) & (blocks < last)).all(axis=1)] if k else blocks
        keys = (blocks[:, 0] * cascade.dims[1] + blocks[:, 1]) * cascade.dims[2] + blocks[:, 2]
        at = np.asarray(limits.lower) + (blocks[:, None] * BLOCK + local) * limits.voxel
        tsdf = np.clip(field(at.reshape(-1, 3)).reshape(-1, VOXELS) / limits.truncation, -1, 1).astype(np.float32)
        volumes.append(Volume(limits, cascade.dims, keys, tsdf, np.ones_like(tsdf), None, None))
    return volumes


def mesh_of(volumes: Sequence[Volume], cascade: TsdfCascade) -> Mesh:
    """Extract the surface of complete levels."""
    surface = CascadeSurface(cascade, [len(volume.keys) for volume in volumes], 1.0, 1.0)
    for level, volume in enumerate(volumes):
        surface.add(volume, level, 0, len(volume.keys))
    return surface.mesh()


def fused_levels(
    maps: Sequence[DepthMap],
    cascade: TsdfCascade,
    *,
    backend: str = "auto",
    slab_bytes: int = 1 << 40,
) -> Mesh:
    """Fuse depth maps into all levels and extract their surface."""
    blocks = find_cascade_blocks(maps, cascade)
    return fused_cascade_surface(maps, cascade, blocks, far_weight=1.0, slab_bytes=slab_bytes, backend=backend)


def outdoor_frames(sky: str, *, views: int = 24, size: int = 96, seed: int = 0) -> list[RenderedView]:
    """Render a ball on a plane that reaches the horizon, from a ring of cameras. ``sky`` sets the depth of sky pixels:

    "unseen": none; "thin": a depth of 30 with alpha 0.3; "scattered": a random depth from 15 to 80 at every pixel;
    "cards": one random depth per view.
    """
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(views):
        eye = 3.0 * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.25 + 0.1 * (k % 3)])
        camera = look_at(eye, np.array([0, 0, 0.2]), np.array([0, 0, 1.0]), width=size, height=size, fx=0.73 * size)
        origin, step = rays(camera)
        ball = sphere_depth(camera, BALL)
        down = np.minimum(step[..., 2], -1e-9)
        depth = np.where(ball > 0, ball, np.where(step[..., 2] < -1e-9, (GROUND - origin[2]) / down, 0))
        above, alpha = depth <= 0, np.ones(depth.shape)
        if sky == "scattered":
            depth = np.where(above, rng.uniform(15, 80, depth.shape), depth)
        elif sky == "cards":
            depth = np.where(above, rng.uniform(15, 80), depth)
        elif sky == "thin":
            depth, alpha = np.where(above, 30.0, depth), np.where(above, 0.3, 1.0)
        frames.append(RenderedView(camera, depth, np.full((*depth.shape, 3), 0.5), alpha >= 0.5))
    return frames
