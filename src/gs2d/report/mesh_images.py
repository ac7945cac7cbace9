"""Pictures of the mesh for the report, with the demo's ray caster and one lamp beside the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.meshing.raycast import Hits, cast_camera

_CLAY = np.array([0.86, 0.86, 0.88])
_LAMP = np.array([-0.45, -0.65, -1.0]) / np.linalg.norm([-0.45, -0.65, -1.0])  # camera axes: left, up, towards the eye
_SAMPLES = 2  # rays per pixel along each axis


@dataclass(frozen=True, eq=False)
class MeshImage:
    """A mesh from one camera, over white.

    Attributes
    ----------
    shape : ndarray [H, W, 3] float32
        Clay, shaded by the normals of the faces.
    color : ndarray [H, W, 3] float32 or None
        Vertex colours, unshaded; None where the mesh has none.
    """

    shape: np.ndarray
    color: np.ndarray | None


def orbit_cameras(mesh: Mesh, *, count: int = 2, size: int = 420) -> tuple[Camera, ...]:
    """Cameras around a mesh whose third axis is up, from 25 degrees above."""
    low, high = np.percentile(mesh.vertices, [1, 99], axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    cameras = []
    for k in range(count):
        azimuth, elevation = np.radians(-65.0 + 130.0 * k), np.radians(25.0)
        towards = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        eye = center + 3.0 * radius * towards
        cameras.append(look_at(eye, center, np.array([0, 0, 1.0]), width=size, height=size, fx=1.6 * size))
    return tuple(cameras)


def mesh_images(mesh: Mesh, cameras: Sequence[Camera], *, width: int = 420) -> list[MeshImage]:
    """Render a mesh from each camera, resized to ``width`` px."""
    images = []
    for camera in cameras:
        resized = camera.resized(width, max(round(width * camera.height / camera.width), 1))
        hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, resized, samples=_SAMPLES)
        shape = _average(_clay(mesh, hits, resized), hits)
        color = None if mesh.colors is None else _average(_vertex_colors(mesh, hits), hits)
        images.append(MeshImage(shape, color))
    return images


def _clay(mesh: Mesh, hits: Hits, camera: Camera) -> np.ndarray:
    """Clay [hits, 3]: a lamp that travels with the camera, faces seen from both sides."""
    hit = hits.face >= 0
    a, b, c = (mesh.vertices[mesh.faces[hits.face[hit], k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a) @ camera.rotation.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    y, x = np.nonzero(hit)
    ray = np.stack(
        [
            ((x + 0.5) / _SAMPLES - camera.cx) / camera.fx,
            ((y + 0.5) / _SAMPLES - camera.cy) / camera.fy,
            np.ones(len(x)),
        ],
        axis=1,
    )
    normal *= -np.sign((normal * ray).sum(axis=1, keepdims=True))
    return np.asarray((0.22 + 0.78 * np.maximum(normal @ _LAMP, 0.0))[:, None] * _CLAY)


def _vertex_colors(mesh: Mesh, hits: Hits) -> np.ndarray:
    """Interpolated vertex colours [hits, 3] in [0, 1]."""
    assert mesh.colors is not None
    hit = hits.face >= 0
    corners = mesh.colors[mesh.faces[hits.face[hit]]].astype(np.float64) / 255  # [hits, 3, 3]
    return np.einsum("hk,hkc->hc", hits.weights[hit].astype(np.float64), corners)


def _average(colors: np.ndarray, hits: Hits) -> np.ndarray:
    """Pixels [H, W, 3]: the mean over the rays of each, white where they hit nothing."""
    rays = np.ones((*hits.face.shape, 3))
    rays[hits.face >= 0] = colors
    height, width = hits.face.shape
    blocks = rays.reshape(height // _SAMPLES, _SAMPLES, width // _SAMPLES, _SAMPLES, 3)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)
