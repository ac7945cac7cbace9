"""Render images of a mesh by ray casting, lit from beside the camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.meshing.raycast import Hits, cast_camera
from gs2d.meshing.texture import bilinear

_CLAY = np.array([0.86, 0.86, 0.88])
_LAMP = np.array([-0.45, -0.65, -1.0]) / np.linalg.norm([-0.45, -0.65, -1.0])  # camera axes: left, up, towards the eye
_SAMPLES = 2  # rays per pixel along each axis
_ROWS_AT_ONCE = 64 * _SAMPLES


@dataclass(frozen=True, eq=False)
class MeshImage:
    """Images of a mesh from one camera, over white.

    Attributes
    ----------
    shape : ndarray [H, W, 3] float32
        Clay, shaded by face normals.
    color : ndarray [H, W, 3] float32 or None
        Texture or vertex colours, unshaded; None where the mesh has neither.
    """

    shape: np.ndarray
    color: np.ndarray | None


def orbit_cameras(mesh: Mesh, *, count: int = 2, size: int = 420) -> tuple[Camera, ...]:
    """Return cameras around a mesh whose third axis is up, 25 degrees above it."""
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


def mesh_images(
    mesh: Mesh, cameras: Sequence[Camera], textured: TexturedMesh | None = None, *, width: int = 420
) -> list[MeshImage]:
    """Render a mesh from each camera at a width of ``width`` px, optionally with the texture of ``textured``."""
    images = []
    for camera in cameras:
        resized = camera.resized(width, max(round(width * camera.height / camera.width), 1))
        hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, resized, samples=_SAMPLES)
        shape = _average(hits, partial(_clay, mesh, resized))
        color = None
        if textured is not None:
            seen = cast_camera(textured.vertices.astype(np.float64), textured.faces, resized, samples=_SAMPLES)
            color = _average(seen, partial(_texture_colors, textured))
        elif mesh.colors is not None:
            color = _average(hits, partial(_vertex_colors, mesh))
        images.append(MeshImage(shape, color))
    return images


def _clay(mesh: Mesh, camera: Camera, hits: Hits, top: int) -> np.ndarray:
    """Return clay colours [hits, 3] of the rows of rays from ``top``; faces are two-sided."""
    hit = hits.face >= 0
    a, b, c = (mesh.vertices[mesh.faces[hits.face[hit], k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a) @ camera.rotation.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    y, x = np.nonzero(hit)
    ray = np.stack(
        [
            ((x + 0.5) / _SAMPLES - camera.cx) / camera.fx,
            ((y + top + 0.5) / _SAMPLES - camera.cy) / camera.fy,
            np.ones(len(x)),
        ],
        axis=1,
    )
    normal *= -np.sign((normal * ray).sum(axis=1, keepdims=True))
    return np.asarray((0.22 + 0.78 * np.maximum(normal @ _LAMP, 0.0))[:, None] * _CLAY)


def _vertex_colors(mesh: Mesh, hits: Hits, _top: int) -> np.ndarray:
    """Return interpolated vertex colours [hits, 3] in [0, 1]."""
    assert mesh.colors is not None
    hit = hits.face >= 0
    corners = mesh.colors[mesh.faces[hits.face[hit]]].astype(np.float64) / 255  # [hits, 3, 3]
    return np.einsum("hk,hkc->hc", hits.weights[hit].astype(np.float64), corners)


def _texture_colors(mesh: TexturedMesh, hits: Hits, _top: int) -> np.ndarray:
    """Return texture colours [hits, 3] in [0, 1]."""
    hit = hits.face >= 0
    uv = np.einsum("hk,hkc->hc", hits.weights[hit], mesh.uv[mesh.faces[hits.face[hit]]]) * len(mesh.texture)
    return bilinear(mesh.texture, uv[:, 0], uv[:, 1]) / 255


def _average(hits: Hits, paint: Callable[[Hits, int], np.ndarray]) -> np.ndarray:
    """Return pixels [H, W, 3]: the mean over the rays of each, white where they hit nothing.

    ``paint`` returns the colours of hits from a start row. Rows are painted in batches to save memory.
    """
    height, width = hits.face.shape
    pixels = np.empty((height // _SAMPLES, width // _SAMPLES, 3), np.float32)
    for top in range(0, height, _ROWS_AT_ONCE):
        part = Hits(*(values[top : top + _ROWS_AT_ONCE] for values in (hits.face, hits.depth, hits.weights)))
        rays = np.ones((*part.face.shape, 3))
        rays[part.face >= 0] = paint(part, top)
        blocks = rays.reshape(-1, _SAMPLES, width // _SAMPLES, _SAMPLES, 3)
        pixels[top // _SAMPLES : (top + len(rays)) // _SAMPLES] = blocks.mean(axis=(1, 3))
    return pixels
