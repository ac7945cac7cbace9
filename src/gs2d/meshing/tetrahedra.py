"""Delaunay tetrahedra of points, with a cube around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.kernels.c_structures import arguments_of
from gs2d.kernels.library import Library

SIDE = 1 << 20  # steps of the grid along the longest side of the points
CUBE = 4 * SIDE - 2  # side of the cube around them, in steps; predicates are exact below 2^22
MARGIN = 3 * SIDE // 2  # from the cube to the points, in steps
# Corners of the facet opposite to each corner, in an order whose normal (q - p) x (r - p) points to that corner.
FACES = np.array([[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]])
ROWS_A_POINT = 9  # tetrahedra; samples of a surface have six to seven
ROUNDS = 20  # of insertion, each with twice as many points as the one before


@dataclass(frozen=True, eq=False)
class Tetrahedra:
    """A division of a cube into tetrahedra."""

    # [P + 8, 3] float64, world units: the points, rounded to 1e-6 of their extent, and the corners of the cube
    xyz: np.ndarray
    corners: np.ndarray  # [T, 4] int32, positively oriented: det(b - a, c - a, d - a) > 0
    neighbours: np.ndarray  # [T, 4] int32: tetrahedron opposite to each corner; -1 outside the cube
    mirror: np.ndarray  # [T, 4] uint8: facet of the neighbour that leads back

    def first(self) -> np.ndarray:
        """Return one tetrahedron at each point, [P + 8] int32; -1 for duplicates, which have none."""
        tetrahedra = np.full(len(self.xyz), -1, np.int32)
        tetrahedra[self.corners] = np.arange(len(self.corners), dtype=np.int32)[:, None]
        return tetrahedra


def morton(cells: np.ndarray) -> np.ndarray:
    """Return the position of cells [P, 3] with coordinates in [0, 2^21) on a Morton curve, uint64."""

    def spread(x: np.ndarray) -> np.ndarray:
        x = x.astype(np.uint64)
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            x = (x | x << np.uint64(shift)) & np.uint64(mask)
        return x

    return np.asarray(spread(cells[:, 0]) | spread(cells[:, 1]) << np.uint64(1) | spread(cells[:, 2]) << np.uint64(2))


def divide(points: np.ndarray, around: np.ndarray, library: Library) -> Tetrahedra:
    """Return the Delaunay tetrahedra of points [P, 3].

    The cube also contains the places ``around`` [C, 3].
    """
    every = np.concatenate([points, around])
    lower = every.min(axis=0)
    step = max(float(np.ptp(every, axis=0).max()), 1e-30) / (SIDE - 1)
    cells = np.rint((points - lower) / step).astype(np.int32)
    cube = np.array([[CUBE * (i >> axis & 1) for axis in range(3)] for i in range(8)])
    grid = np.concatenate([cells + MARGIN, cube]).astype(np.int32)
    xyz = lower + (grid - MARGIN) * step
    corners, neighbours = tetrahedra_on_cpu(library, grid, _order(cells))
    order = np.argsort(corners.min(axis=1), kind="stable")  # neighbours in space are neighbours in memory
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    corners, neighbours = corners[order], neighbours[order]
    neighbours = np.where(neighbours >= 0, rank[neighbours], -1).astype(np.int32)
    return Tetrahedra(xyz, corners, neighbours, _mirror(neighbours))


def tetrahedra_on_cpu(library: Library, grid: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners and neighbours, [T, 4] int32, of the tetrahedra of grid points [P + 8, 3] int32.

    The last eight points are the corners of a cube around the others, x fastest; ``order`` [P] int32 is that of
    insertion.
    """
    count = ROWS_A_POINT
    while True:
        capacity = count * len(grid) + 1000
        corners, neighbours = np.empty((capacity, 4), np.int32), np.empty((capacity, 4), np.int32)
        inserted = np.zeros(len(grid), np.uint8)
        arrays = {"xyz": grid, "order": order, "corners": corners, "neighbours": neighbours, "inserted": inserted}
        arguments = arguments_of("gs2d_tetrahedra", **arrays, points=len(grid), capacity=capacity)
        library.call("gs2d_tetrahedra", arguments)
        if arguments.count >= 0:
            break
        count *= 2
    corners, neighbours = corners[: arguments.count], neighbours[: arguments.count]
    used = corners[:, 0] >= 0
    number = np.cumsum(used, dtype=np.int32) - 1
    neighbours = neighbours[used]
    return corners[used], np.where(neighbours >= 0, number[neighbours], -1).astype(np.int32)


def _order(cells: np.ndarray) -> np.ndarray:
    """Order points for insertion: random rounds that double, along a curve in each (Amenta et al. 2003)."""
    rounds = np.minimum(np.random.default_rng(0).geometric(0.5, len(cells)), ROUNDS)
    return np.lexsort((morton(cells), -rounds)).astype(np.int32)


def _mirror(neighbours: np.ndarray) -> np.ndarray:
    facets = np.zeros(neighbours.shape, np.uint8)
    for k in range(4):
        rows = np.flatnonzero(neighbours[:, k] >= 0)
        facets[rows, k] = (neighbours[neighbours[rows, k]] == rows[:, None]).argmax(axis=1)
    return facets
