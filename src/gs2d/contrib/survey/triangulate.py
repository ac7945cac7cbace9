"""Triangulation of points from pixels in several photographs, with distortion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.data import View
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

_STEPS = 10  # Gauss-Newton iterations
_NEWTON = 20  # Newton iterations


@dataclass(frozen=True, eq=False)
class Triangulated:
    """A point of the run, and its reprojection errors ``pixels`` [M] px."""

    point: np.ndarray
    pixels: np.ndarray


def triangulate(views: Sequence[View], marks: np.ndarray, name: str) -> Triangulated:
    """Return the point with the least reprojection error of its marks.

    ``marks`` [M, 2] are px in the image files, from the upper left corner. Raises DataError with the ``name`` of the
    point if there are fewer than two views, the rays are nearly parallel, or the point is behind a camera.
    """
    if len(views) < 2:
        raise DataError(f"{name} must be marked in at least two photographs, got {len(views)}")
    ideal = np.stack([_ideal(view.file_intrinsics(), mark) for view, mark in zip(views, marks, strict=True)])
    rotations = np.stack([view.camera.rotation for view in views])
    centers = np.stack([view.camera.center for view in views])
    rays = np.einsum("vji,vj->vi", rotations, np.column_stack([ideal, np.ones(len(views))]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # projection onto the plane perpendicular to each ray
    if np.linalg.eigvalsh(across.sum(axis=0))[0] < math.sin(math.radians(0.5)) ** 2 / 2:
        raise DataError(f"{name} must be visible from different directions, got rays less than a degree apart")
    point = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, centers))
    point = _nearest_images(point, ideal, rotations, centers)
    local = np.einsum("vij,vj->vi", rotations, point - centers)
    if not (local[:, 2] > 0).all():
        behind = views[int(local[:, 2].argmin())].name
        raise DataError(f"{name} must be in front of its cameras, but is behind that of {behind}")
    projected = np.stack(
        [view.file_intrinsics().project(p[None, :2] / p[2])[0] for view, p in zip(views, local, strict=True)]
    )
    return Triangulated(point, np.linalg.norm(projected - marks, axis=1))


def _ideal(k: Intrinsics, pixel: np.ndarray) -> np.ndarray:
    """Return the point [2] of the plane z = 1 at a pixel [2], by Newton's method; DataError if no ray maps to it."""
    bent = (np.asarray(pixel, np.float64) - (k.cx, k.cy)) / (k.fx, k.fy)
    if k.lens is None:
        return np.asarray(bent)
    lens, x, h = k.lens, bent.copy(), 1e-6
    du, dv = np.array([h, 0.0]), np.array([0.0, h])
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON):
            across = (lens.distort(x + du) - lens.distort(x - du)) / (2 * h)
            along = (lens.distort(x + dv) - lens.distort(x - dv)) / (2 * h)
            x = x - np.linalg.solve(np.stack([across, along], axis=-1), lens.distort(x) - bent)
        off = np.linalg.norm(lens.distort(x) - bent) * max(k.fx, k.fy)
        if not (off < 1e-3 and lens.project(np.append(x, 1.0))[1]):
            raise DataError(f"expected a pixel that the lens maps a ray to, got {pixel[0]:g}, {pixel[1]:g}")
    return x


def _nearest_images(point: np.ndarray, ideal: np.ndarray, rotations: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Minimise the sum of squared errors on the planes z = 1; returns the start value if it fails."""
    start = point
    for _ in range(_STEPS):
        local = np.einsum("vij,vj->vi", rotations, point - centers)
        if not (local[:, 2] > 1e-12).all():
            return start
        x = local[:, :2] / local[:, 2:]
        J = (rotations[:, :2] - x[:, :, None] * rotations[:, 2:]) / local[:, 2, None, None]  # [V, 2, 3]
        step = np.linalg.lstsq(J.reshape(-1, 3), (ideal - x).reshape(-1), rcond=None)[0]
        point = point + step
    return point
