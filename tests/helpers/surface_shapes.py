"""Volumes defined by formulas, and mesh properties."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.kernels.library import load
from gs2d.meshing.depth_maps import DepthMap, RenderedView
from gs2d.meshing.fusion_bounds import FusionBounds
from gs2d.meshing.marching_cubes import cell_surface, edge_vertices
from gs2d.meshing.tsdf_volume import BLOCK, VOXELS, Volume, find_blocks, fuse_blocks


def fuse(
    maps: Sequence[DepthMap], lim: FusionBounds, *, threads: int = 1, backend: str = "auto", max_bytes: int = 4 << 30
) -> Volume:
    """Fuse depth maps into one volume."""
    blocks = find_blocks(maps, lim, max_bytes=max_bytes)
    if threads > 1:
        load().use_threads(threads)
    return fuse_blocks(maps, lim, blocks, backend=backend)


def marching_cubes(volume: Volume, min_weight: float = 1.0) -> Mesh:
    """Extract the surface of a whole volume."""
    edges, faces, ends = cell_surface(volume, min_weight)
    vertices, colors = edge_vertices(volume, edges, ends)
    return Mesh(vertices, faces.astype(np.int32), colors)


def limits(half: float, voxel: float, truncation: float | None = None, depth_limit: float = 100.0) -> FusionBounds:
    """Return a cube of half side ``half`` around the origin."""
    trunc = truncation if truncation is not None else 5 * voxel
    low, high = (-half, -half, -half), (half, half, half)
    return FusionBounds(low, high, 2 * half, voxel, trunc, depth_limit, 1.0, 1.0, voxel, 0.0)


def volume_of(field: Callable[[np.ndarray], np.ndarray], lim: FusionBounds, blocks: int) -> Volume:
    """Return a volume of blocks^3 observed blocks filled from a field of points [P, 3] -> [P]."""
    dims = (blocks, blocks, blocks)
    corner = np.stack(np.unravel_index(np.arange(blocks**3), dims), axis=1) * BLOCK
    local = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1)
    at = np.asarray(lim.lower) + (corner[:, None] + local) * lim.voxel  # [M, 512, 3]
    tsdf = field(at.reshape(-1, 3)).reshape(len(corner), VOXELS).astype(np.float32)
    return Volume(lim, dims, np.arange(blocks**3), tsdf, np.ones_like(tsdf), None, None)


def dense(volume: Volume) -> np.ndarray:
    """Return the field of ``volume_of`` as one array [n, n, n]."""
    b = volume.dims[0]
    cubes = volume.tsdf.reshape(b, b, b, BLOCK, BLOCK, BLOCK)
    return cubes.transpose(0, 3, 1, 4, 2, 5).reshape(b * BLOCK, b * BLOCK, b * BLOCK)


def edge_uses(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return undirected edges [E, 2], their face counts [E], and how many of those traverse them upwards [E]."""
    f = mesh.faces.astype(np.int64)
    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    edges, inverse, uses = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    upward = np.bincount(inverse.reshape(-1), weights=directed[:, 0] < directed[:, 1], minlength=len(edges))
    return edges, uses, upward.astype(np.int64)


def is_closed_manifold(mesh: Mesh) -> bool:
    """Check that every edge has exactly two faces, which traverse it in opposite directions."""
    _, uses, upward = edge_uses(mesh)
    return bool((uses == 2).all() and (upward == 1).all())


def area(mesh: Mesh) -> float:
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    return float(np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2)


def signed_volume(mesh: Mesh) -> float:
    """Return the enclosed volume, positive if faces point outward."""
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    return float(np.einsum("fi,fi->f", t[:, 0], np.cross(t[:, 1], t[:, 2])).sum() / 6)


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera centre [3] and, per pixel centre, the world-space step of unit depth [H, W, 3]."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    local = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    return camera.center, local @ camera.rotation


def sphere_depth(camera: Camera, radius: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the z-depth of a sphere at pixel centres: the nearer root of |o + s d - c| = r, or 0 if missed."""
    o, d = rays(camera)
    oc = o - np.asarray(center)
    a, b, c = (d * d).sum(-1), d @ oc, oc @ oc - radius**2
    disc = b * b - a * c
    return np.where(disc > 0, (-b - np.sqrt(np.maximum(disc, 0))) / a, 0.0)


def box_depth(camera: Camera, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the z-depth of an axis-aligned box at pixel centres (slab method); 0 if missed."""
    o, d = rays(camera)
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)
    s = np.stack([(lower - o) / d, (upper - o) / d])
    enter, leave = s.min(0).max(-1), s.max(0).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, 0.0)


def orbit(count: int, distance: float, size: int = 96, focal: float = 120.0) -> list[Camera]:
    """Return cameras all around the origin, at golden-angle steps."""
    k = np.arange(count)
    z = 1 - 2 * (k + 0.5) / count
    angle = k * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    eyes = distance * np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    ups = [np.eye(3)[2 if abs(eye[2]) < 0.95 * distance else 0] for eye in eyes]
    origin = np.zeros(3)
    return [look_at(e, origin, up, width=size, height=size, fx=focal) for e, up in zip(eyes, ups, strict=True)]


def sphere_frames(cameras: list[Camera], radius: float = 1.0) -> list[RenderedView]:
    return [RenderedView(camera, sphere_depth(camera, radius)) for camera in cameras]


def tetrahedron(colors: bool = True, dtype: type = np.float32) -> Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=dtype)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    rgb = np.array([[0, 1, 2], [255, 4, 5], [6, 7, 8], [9, 10, 255]], np.uint8)
    return Mesh(vertices, faces, rgb if colors else None)
