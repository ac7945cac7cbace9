"""Points from pixels in several photographs, through their lenses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.data import View
from gs2d.errors import DataError

_STEPS = 10  # of Gauss and Newton's method


@dataclass(frozen=True, eq=False)
class Triangulated:
    """A point of the run and how well its pixels agree: ``pixels`` [M] px, the distances of its images from them."""

    point: np.ndarray
    pixels: np.ndarray


def triangulate(views: Sequence[View], marks: np.ndarray, name: str) -> Triangulated:
    """Return the point whose images are nearest to its marks.

    Parameters
    ----------
    views : sequence of View
        The photographs, two or more.
    marks : ndarray [M, 2] px
        Of the photographs' files, from the outer corner at the upper left.
    name : str
        What the point is called in an error.

    Raises
    ------
    DataError
        Fewer than two photographs, lines of sight that are all but parallel, or a point behind a camera.
    """
    if len(views) < 2:
        raise DataError(f"{name} must be marked in two photographs at least, got {len(views)}")
    ideal = np.stack([view.file_intrinsics().ideal(mark[None])[0] for view, mark in zip(views, marks, strict=True)])
    rotations = np.stack([view.camera.rotation for view in views])
    centers = np.stack([view.camera.center for view in views])
    rays = np.einsum("vji,vj->vi", rotations, np.column_stack([ideal, np.ones(len(views))]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # onto the plane across each ray
    if np.linalg.eigvalsh(across.sum(axis=0))[0] < math.sin(math.radians(0.5)) ** 2 / 2:
        raise DataError(f"{name} must be seen from two sides, got lines of sight less than a degree apart")
    point = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, centers))
    point = _nearest_images(point, ideal, rotations, centers)
    local = np.einsum("vij,vj->vi", rotations, point - centers)
    if not (local[:, 2] > 0).all():
        behind = views[int(local[:, 2].argmin())].name
        raise DataError(f"{name} must lie before the cameras that see it, it would be behind that of {behind}")
    seen = np.stack(
        [view.file_intrinsics().project(p[None, :2] / p[2])[0] for view, p in zip(views, local, strict=True)]
    )
    return Triangulated(point, np.linalg.norm(seen - marks, axis=1))


def _nearest_images(point: np.ndarray, ideal: np.ndarray, rotations: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Return the point with the least sum of squares on the planes z = 1, from a first guess; the guess if none is."""
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
