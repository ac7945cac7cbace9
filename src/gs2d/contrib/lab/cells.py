"""Cells of blocks: axes along which cameras and points spread, and cells of equal visible weight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.errors import RunError

TRIMMED = 0.01  # fraction of the weight at either end that is ignored for the sides of cells
_DIGITS = 12  # decimals of the weights; further ones depend on the machine


@dataclass(frozen=True, eq=False)
class Cells:
    """Boxes in a rotated frame that tile space."""

    axes: np.ndarray  # [A, 3] orthonormal axes of the grid; A is 2 or 3
    low: np.ndarray  # [B, A], world units along the axes: a point is in a cell if ``low <= axes @ point < high``
    high: np.ndarray  # [B, A]; infinite at the outside
    margin: float  # distance by which a block trains beyond its cell, world units
    side: float  # mean side of a cell, without the outermost 1 % of the weight, world units
    names: tuple[str, ...]  # names of the blocks: grid indices, ``1-3``

    def __len__(self) -> int:
        return len(self.names)

    def owners(self, places: np.ndarray) -> np.ndarray:
        """Return the cell [N] int64 of each point [N, 3]."""
        along = places.astype(np.float64) @ self.axes.T
        owner = np.full(len(places), -1, np.int64)
        for cell in range(len(self)):
            owner[((along >= self.low[cell]) & (along < self.high[cell])).all(axis=1)] = cell
        return owner

    def near(self, cell: int, places: np.ndarray) -> np.ndarray:
        """Return which points [N, 3] lie in a cell or its margin, [N] bool."""
        along = places.astype(np.float64) @ self.axes.T
        low, high = self.low[cell] - self.margin, self.high[cell] + self.margin
        return np.asarray(((along >= low) & (along < high)).all(axis=1))

    def region(self, cell: int) -> tuple[tuple[Any, ...], ...]:
        """Return a cell with its margin as plain values: axes, lower and upper ends."""
        low, high = self.low[cell] - self.margin, self.high[cell] + self.margin
        return tuple(map(tuple, self.axes.tolist())), tuple(low.tolist()), tuple(high.tolist())

    def distance_to_seam(self, places: np.ndarray) -> np.ndarray:
        """Return the distance [N] of each point [N, 3] from the nearest side of its cell that borders another cell."""
        along, owner = places.astype(np.float64) @ self.axes.T, self.owners(places)
        sides = np.concatenate([along - self.low[owner], self.high[owner] - along], axis=1)
        return np.asarray(sides.min(axis=1))

    def to_json(self) -> dict[str, Any]:
        """Return plain values; null stands for infinity."""

        def finite(values: np.ndarray) -> list[list[float | None]]:
            return [[float(value) if np.isfinite(value) else None for value in row] for row in values]

        return {
            "axes": self.axes.tolist(),
            "margin": self.margin,
            "side": self.side,
            "cells": [
                {"name": name, "low": low, "high": high}
                for name, low, high in zip(self.names, finite(self.low), finite(self.high), strict=True)
            ],
        }

    @classmethod
    def from_json(cls, data: Any) -> Cells:
        """Return the cells that :meth:`to_json` described."""
        try:
            cells = data["cells"]
            low, high = (
                np.array([[sign * np.inf if v is None else v for v in cell[name]] for cell in cells], np.float64)
                for name, sign in (("low", -1), ("high", 1))
            )
            names = tuple(str(cell["name"]) for cell in cells)
            numbers = float(data["margin"]), float(data["side"])
            axes = np.array(data["axes"], np.float64)
            if axes.ndim != 2 or axes.shape[1] != 3 or not low.shape == high.shape == (len(names), len(axes)):
                raise ValueError(f"axes {list(axes.shape)} of {len(names)} cells from {list(low.shape)}")
            return cls(axes, low, high, *numbers, names)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise RunError(f"the cells of a partition are damaged ({type(error).__name__}: {error})") from error


@dataclass(frozen=True, eq=False)
class Spread:
    """Spread of cameras and sparse points."""

    axes: np.ndarray  # [3, 3] orthonormal, by decreasing spread; the largest component of each is positive
    sides: np.ndarray  # [3] standard deviation along each, world units


def spread_of(centers: np.ndarray, points: np.ndarray | None) -> Spread:
    """Return the principal axes of camera centres [V, 3] and sparse points [P, 3], with equal weight.

    Only points within the middle 90 % along each coordinate count, to ignore outliers.
    """
    clouds = [centers.astype(np.float64)]  # separately: the height of cameras above the ground is no spread
    if points is not None and len(points) >= 10:
        points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        low, high = np.percentile(points, [5, 95], axis=0)
        inside = points[((points >= low) & (points <= high)).all(axis=1)]
        clouds += [inside] if len(inside) >= 10 else []
    spread = np.mean([np.cov(cloud.T, bias=True) for cloud in clouds], axis=0)
    values, vectors = np.linalg.eigh(spread)
    axes = vectors.T[::-1]
    signs = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])
    return Spread(axes * signs[:, None], np.sqrt(np.maximum(values[::-1], 0.0)))


def cut(places: np.ndarray, weights: np.ndarray, axes: np.ndarray, grid: Sequence[int], margin: float) -> Cells:
    """Return cells of equal weight: slabs along the first axis, each cut along the next.

    ``places`` [N, 3] of weight 0 [N] are ignored. ``axes`` [A, 3] has one axis for each of the A numbers of ``grid``;
    ``margin`` is a fraction of the mean side of a cell.
    """
    visible = weights > 0
    along, weights = places[visible].astype(np.float64) @ axes.T, np.round(weights[visible] / weights.max(), _DIGITS)
    cells: list[tuple[list[float], list[float], str, np.ndarray]] = [([], [], "", np.arange(len(along)))]
    lengths: list[list[float]] = [[] for _ in grid]
    for axis, count in enumerate(grid):
        finer = []
        for low, high, name, rows in cells:
            values, share = along[rows, axis], weights[rows]
            inner = [weighted_quantile(values, share, k / count) for k in range(1, count)]
            edges = [-np.inf, *inner, np.inf]
            lengths[axis].append(_length(values, share) / count)
            for k in range(count):
                inside = rows[(values >= edges[k]) & (values < edges[k + 1])]
                label = f"{name}-{k}" if name else f"{k}"
                finer.append(([*low, edges[k]], [*high, edges[k + 1]], label, inside))
        cells = finer
    lows, highs = (np.array([cell[i] for cell in cells], np.float64).reshape(-1, len(axes)) for i in (0, 1))
    side = float(np.mean([np.mean(of) for of in lengths]))
    return Cells(axes, lows, highs, margin * side, side, tuple(cell[2] for cell in cells))


def weighted_quantile(values: np.ndarray, weights: np.ndarray, fraction: float) -> float:
    """Return the value below which about this fraction of the weight lies; 0 without values."""
    if not len(values):
        return 0.0
    order = np.argsort(values, kind="stable")
    up_to = np.cumsum(weights[order])
    return float(values[order[min(np.searchsorted(up_to, fraction * up_to[-1]), len(order) - 1)]])


def _length(values: np.ndarray, weights: np.ndarray) -> float:
    ends = [weighted_quantile(values, weights, fraction) for fraction in (TRIMMED, 1 - TRIMMED)]
    return ends[1] - ends[0]
