"""The synthetic room that the rasterizer is timed on: two spheres, a floor and a wall, seeded."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from gs2d.camera import Camera, look_at
from gs2d.splats import Splats


def room(n: int, seed: int = 0) -> Splats:
    """n splats on two spheres, a floor and a wall.

    Normals are jittered by 0.15, scales are 0.9 x the mean distance to 3 neighbours x exp(0.4 N(0, 1)), opacities are
    half U(0.1, 0.5), half U(0.5, 0.95).
    """
    rng = np.random.default_rng(seed)
    quarter = n // 4
    counts = (quarter, quarter, quarter, n - 3 * quarter)

    def sphere(count: int, center: tuple[float, float, float], radius: float) -> tuple[np.ndarray, np.ndarray]:
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(center) + radius * direction, direction

    def plane(count: int, corner: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv = rng.random((count, 2))
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        return corner + uv[:, :1] * a + uv[:, 1:] * b, np.repeat(normal[None], count, axis=0)

    parts = [
        sphere(counts[0], (-1.1, -0.5, 0.0), 1.15),
        sphere(counts[1], (1.2, -0.3, -0.1), 0.95),
        plane(counts[2], np.array([-3.0, 0.8, -3.0]), np.array([6.0, 0, 0]), np.array([0, 0, 4.6])),
        plane(counts[3], np.array([-3.0, -2.6, 1.6]), np.array([6.0, 0, 0]), np.array([0, 3.4, 0])),
    ]
    points = np.concatenate([p for p, _ in parts])
    normals = np.concatenate([m for _, m in parts]) + 0.15 * rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances, _ = cKDTree(points).query(points, k=4)
    spacing = distances[:, 1:].mean(axis=1)
    scales = 0.9 * spacing[:, None] * np.exp(0.4 * rng.normal(size=(n, 2)))
    opacity = np.where(rng.random(n) < 0.5, rng.uniform(0.1, 0.5, n), rng.uniform(0.5, 0.95, n))
    order = rng.permutation(n)  # nothing is sorted in space

    def tensor(x: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(x[order], dtype=np.float32))

    return Splats(
        means=tensor(points),
        quats=tensor(_quats_of(normals, rng)),
        log_scales=tensor(np.log(scales)),
        opacity_logits=tensor(np.log(opacity / (1 - opacity))),
        sh0=tensor(rng.normal(size=(n, 1, 3)) * 0.6),
        shN=tensor(rng.normal(size=(n, 15, 3)) * 0.1),
    )


def _quats_of(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotations (w, x, y, z) [N, 4] whose third column is the normal, turned at random about it."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, normals)
    quats = np.concatenate([1 + normals @ z[:, None], axis], axis=1)  # half-way quaternion
    quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-9)
    half = rng.uniform(0, np.pi, len(normals))
    w, x, y, q = quats.T
    c, s = np.cos(half), np.sin(half)  # quats * (c, 0, 0, s)
    return np.stack([w * c - q * s, x * c + y * s, y * c - x * s, w * s + q * c], axis=1)


def camera(size: int) -> Camera:
    """A square image with focal length 0.9 x its side, looking at the room."""
    return look_at(
        np.array([0.3, -0.5, -4.0]),
        np.array([0.0, 0.0, 0.2]),
        np.array([0.0, -1.0, 0.0]),
        width=size,
        height=size,
        fx=0.9 * size,
    )
