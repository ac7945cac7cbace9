"""Nearest neighbours in point clouds, by scipy's k-d tree."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from gs2d.core.checks import check_shapes
from gs2d.errors import DataError


class Cloud:
    """Points [P, 3] for nearest-neighbour queries, as float64; may be empty. A DataError if they are not finite."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = _checked(points, "points")
        self._tree = cKDTree(self.points)

    def nearest(
        self, queries: np.ndarray, *, neighbours: int = 1, limit: float = math.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the K = ``neighbours`` nearest points of finite ``queries`` [Q, 3] that are nearer than ``limit``.

        Returns ascending distances [Q, K] float64, infinite for missing neighbours, and rows of ``points`` [Q, K]
        int64, P for missing neighbours.
        """
        k = range(1, neighbours + 1)  # a list gives one column per neighbour, even for one
        queries = _checked(queries, "queries")
        distances, index = self._tree.query(queries, k=k, distance_upper_bound=limit, workers=-1)
        return np.asarray(distances), np.asarray(index)


def _checked(points: np.ndarray, name: str) -> np.ndarray:
    check_shapes({name: (points, "P 3")})
    points = np.ascontiguousarray(points, np.float64)
    if not np.isfinite(points).all():
        raise DataError(f"expected finite {name}, got NaN or infinity; check the files of mesh and ground truth")
    return points
