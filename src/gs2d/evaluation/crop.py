"""Crop volumes: a polygon in two axes, drawn out along the third (the JSON files of Tanks and Temples and Open3D)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gs2d.core.checks import check_shapes
from gs2d.core.json_files import read_json
from gs2d.errors import DataError

_PLANES = {0: (1, 2), 1: (0, 2), 2: (0, 1)}  # the two axes of the polygon, by the axis it is drawn out along
_CHUNK = 1 << 21


@dataclass(frozen=True, eq=False)
class CropVolume:
    """What counts, in the frame of the ground truth.

    Attributes
    ----------
    axis : int
        0, 1 or 2: the axis that the polygon is drawn out along.
    low, high : float
        Range along it, both ends included.
    polygon : ndarray [n, 2]
        Corners in the two other axes, in ascending order of axis; even-odd rule.
    """

    axis: int
    low: float
    high: float
    polygon: np.ndarray

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points [P, 3] lie inside, bool [P]."""
        check_shapes({"points": (points, "P 3")})
        u, v = _PLANES[self.axis]
        inside = (points[:, self.axis] >= self.low) & (points[:, self.axis] <= self.high)
        rows = np.flatnonzero(inside)
        for start in range(0, len(rows), _CHUNK):
            part = rows[start : start + _CHUNK]
            inside[part] = self._in_polygon(points[part, u].astype(np.float64), points[part, v].astype(np.float64))
        return np.asarray(inside)

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return the points inside."""
        return np.asarray(points[self.contains(points)])

    def _in_polygon(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Whether an odd number of edges is crossed on the way from (u, v) to u = -infinity."""
        odd = np.zeros(len(u), bool)
        for (u0, v0), (u1, v1) in zip(self.polygon, np.roll(self.polygon, -1, axis=0), strict=True):
            crosses = (v0 < v) != (v1 < v)
            if not crosses.any():
                continue
            odd[crosses] ^= u0 + (v[crosses] - v0) / (v1 - v0) * (u1 - u0) < u[crosses]
        return odd


def box(low: np.ndarray, high: np.ndarray) -> CropVolume:
    """Return the axis-aligned box between two corners [3]."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return CropVolume(2, float(z0), float(z1), np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float64))


def read_crop(path: Path) -> CropVolume:
    """Read ``SCENE.json`` of Tanks and Temples (Open3D's SelectionPolygonVolume).

    Raises
    ------
    DataError
    """
    data = read_json(path)
    try:
        axis = "XYZ".index(str(data["orthogonal_axis"]).upper())
        low, high = float(data["axis_min"]), float(data["axis_max"])
        corners = np.asarray(data["bounding_polygon"], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} must hold orthogonal_axis (X, Y or Z), axis_min, axis_max and bounding_polygon, "
            f"got another entry ({error}); copy it again from the ground truth"
        ) from error
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 3 or not np.isfinite(corners).all():
        raise DataError(f"{path}: bounding_polygon must hold three corners [x, y, z] or more, got {corners.shape}")
    if not low < high:
        raise DataError(f"{path}: axis_min must be below axis_max, got {low:g} and {high:g}")
    return CropVolume(axis, low, high, corners[:, list(_PLANES[axis])])
