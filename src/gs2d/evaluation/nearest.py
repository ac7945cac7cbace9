"""Nearest neighbours in point clouds: by scipy's trees on the CPU, by ``kernels/cuda/nearest.cu`` on a GPU.

The same distances to the last digits, float64. Which of several points at the same distance is found may differ.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.errors import DataError

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher

CHUNK = 1 << 20  # points asked for at a time on the CPU: bounds memory beside the clouds themselves
GPU_CHUNK = 1 << 22


def _gpu(device: str) -> tuple[torch.device, Launcher]:
    from gs2d.kernels.cuda.launch import launcher_for

    where = torch.device(device)
    return where, launcher_for(where)


def on_gpu(device: str) -> bool:
    """Whether a device is not the CPU."""
    return torch.device(device).type != "cpu"


def tensor_on(device: torch.device | str, array: np.ndarray, dtype: type = np.float64) -> Tensor:
    """An array as a tensor on a device; on the CPU the same memory where it has that type and may be written to."""
    return torch.from_numpy(np.require(array, dtype, ["C", "W"])).to(device)  # torch warns of what may not


def _checked(points: np.ndarray, name: str) -> np.ndarray:
    check_shapes({name: (points, "P 3")})
    points = np.ascontiguousarray(points, np.float64)
    if not np.isfinite(points).all():
        raise DataError(f"finite {name} were expected, got NaN or infinity; check the files of mesh and ground truth")
    return points


class Cloud:
    """Points among which the nearest are looked for.

    Parameters
    ----------
    points : ndarray [P, 3]
        Kept as float64 in ``points``; may be none.
    device : str
        "cpu", or a GPU as torch names it.
    workers : int, optional
        Threads on the CPU; default: all.

    Raises
    ------
    DataError
        Coordinates that are not finite.
    BackendError, ShapeError
        The device cannot be used.
    """

    def __init__(self, points: np.ndarray, *, device: str = "cpu", workers: int | None = None) -> None:
        self.points = _checked(points, "points")
        self._workers = workers or os.cpu_count() or 1
        self._tree = None
        if on_gpu(device):
            from gs2d.kernels.cuda.nearest import build_tree

            self._device, self._launcher = _gpu(device)
            self._tree = build_tree(tensor_on(self._device, self.points))
        else:
            self._scipy = cKDTree(self.points)

    def nearest(
        self, queries: np.ndarray, *, neighbours: int = 1, limit: float = math.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """The nearest points of the cloud.

        Parameters
        ----------
        queries : ndarray [Q, 3]
        neighbours : int
            K, 1 or 8.
        limit : float
            Only what is nearer counts.

        Returns
        -------
        distances : ndarray [Q, K] float64
            Ascending; infinite where there are fewer.
        index : ndarray [Q, K] int64
            Rows of ``points``; their number where there are fewer.

        Raises
        ------
        DataError
            Coordinates that are not finite.
        """
        queries = _checked(queries, "queries")
        distances = np.empty((len(queries), neighbours))
        index = np.empty((len(queries), neighbours), np.int64)
        step = CHUNK if self._tree is None else GPU_CHUNK
        for start in range(0, len(queries), step):
            part = slice(start, start + step)
            distances[part], index[part] = self._some(queries[part], neighbours, limit)
        return distances, index

    def _some(self, queries: np.ndarray, neighbours: int, limit: float) -> tuple[np.ndarray, np.ndarray]:
        if self._tree is None:
            k = range(1, neighbours + 1)  # a list of them: one column for each, even for one
            found = self._scipy.query(queries, k=k, distance_upper_bound=limit, workers=self._workers)
            return np.asarray(found[0]), np.asarray(found[1])
        from gs2d.kernels.cuda.nearest import find_nearest

        given = tensor_on(self._device, queries)
        distances, index = find_nearest(self._tree, given, launcher=self._launcher, neighbours=neighbours, limit=limit)
        return distances.cpu().numpy(), index.cpu().numpy()


def first_of_neighbours(points: np.ndarray, radius: float, device: str) -> np.ndarray:
    """Which points [P, 3] a greedy choice in their order takes, if no two may be within ``radius``; on a GPU. Bool [P].

    Raises
    ------
    DataError, BackendError, ShapeError
        As :class:`Cloud`.
    """
    from gs2d.kernels.cuda.nearest import choose_spread

    where, launcher = _gpu(device)
    given = tensor_on(where, _checked(points, "points"))
    return np.asarray(choose_spread(given, radius, launcher=launcher).cpu().numpy())
