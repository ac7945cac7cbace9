"""Nearest neighbours on a GPU: a k-d tree built by torch's sorts, searched by ``nearest.cu``; float64, exact.

The tree is balanced whatever the points are: far outliers, clusters and duplicates cost no more than a plane does. A
search takes time that grows with the logarithm of the number of points, and memory for its result only; the tree takes
45 to 90 bytes a point, its making some three times that for a moment.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.cuda.arguments import fill

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher

__all__ = ["NEIGHBOURS", "PointTree", "build_tree", "choose_spread", "find_nearest"]

LEAF = 8  # nearest.cu has the same
THREADS = 128
MOST_POINTS = 1 << 30
NEIGHBOURS = (1, 8)  # how many may be asked for
_OPEN, _TAKEN = 0, 1  # nearest.cu: State


class _Tree(ctypes.Structure):
    _fields_ = (("leaves", ctypes.c_int64), ("boxes", ctypes.c_void_p), ("points", ctypes.c_void_p))


class NearestArguments(ctypes.Structure):
    """Of nearest.cu."""

    _fields_ = (
        ("tree", _Tree),
        ("count", ctypes.c_int64),
        ("limit", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("queries", "distances", "places")),
    )


class SpreadArguments(ctypes.Structure):
    """Of nearest.cu."""

    _fields_ = (
        ("tree", _Tree),
        ("count", ctypes.c_int64),
        ("limit", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("open", "turns", "states")),
    )


@dataclass(frozen=True, eq=False)
class PointTree:
    """A k-d tree of points.

    Attributes
    ----------
    points : Tensor [L * LEAF, 3] float64
        Leaf by leaf; infinite at the end, where there are none.
    index : Tensor [L * LEAF] int64
        Which point each is; ``count`` where there is none.
    boxes : Tensor [2 L, 6] float64
        Lower and upper corner of what lies in each node, the children of node n being 2 n and 2 n + 1.
    count : int
        Points.
    """

    points: Tensor
    index: Tensor
    boxes: Tensor
    count: int


def build_tree(points: Tensor) -> PointTree:
    """The tree of points [P, 3] float64, where they lie; every node is cut at the median of its longest side.

    Raises
    ------
    ShapeError
        Another shape or dtype.
    BackendError
        2^30 points or more.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype != torch.float64:
        raise ShapeError(f"points must be [P, 3] float64, got {list(points.shape)} {points.dtype}")
    count = len(points)
    if count >= MOST_POINTS:
        raise BackendError(f"fewer than 2^30 points were expected for a search on a GPU, got {count}; thin them")
    leaves = 1
    while leaves * LEAF < count:
        leaves *= 2
    placed = points.new_full((leaves * LEAF, 3), math.inf)
    placed[:count] = points
    index = torch.arange(len(placed), device=points.device).clamp(max=count)
    nodes = 1
    while nodes < leaves:  # all nodes of a level at once
        groups = placed.view(nodes, -1, 3)
        low, high = _corners(groups)
        axis = (high - low).argmax(dim=1)  # of an empty node -inf: any
        values = groups.gather(2, axis.view(-1, 1, 1).expand(-1, groups.shape[1], 1)).squeeze(2)
        order = values.sort(dim=1, stable=True).indices  # what is infinite goes behind
        order += torch.arange(nodes, device=order.device).view(-1, 1) * groups.shape[1]
        placed, index = placed[order.view(-1)], index[order.view(-1)]
        nodes *= 2
    return PointTree(placed, index, _boxes(placed.view(leaves, LEAF, 3)), count)


def _corners(groups: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates [n, 3] in groups of points [n, m, 3]; (inf, -inf) where there are none."""
    return groups.amin(dim=1), groups.where(groups < math.inf, -math.inf).amax(dim=1)


def _boxes(leaves: Tensor) -> Tensor:
    """Boxes of all nodes, from the points in the leaves [L, LEAF, 3]."""
    low, high = _corners(leaves)
    levels = [torch.cat([low, high], dim=1)]
    while len(levels[-1]) > 1:
        pairs = levels[-1].view(-1, 2, 6)
        levels.append(torch.cat([pairs[..., :3].amin(dim=1), pairs[..., 3:].amax(dim=1)], dim=1))
    unused = leaves.new_zeros(1, 6)  # row 0
    return torch.cat([unused, *reversed(levels)])


def _of(tree: PointTree) -> _Tree:
    found = _Tree(leaves=len(tree.points) // LEAF)
    fill(found, boxes=tree.boxes, points=tree.points)
    return found


def find_nearest(
    tree: PointTree, queries: Tensor, *, launcher: Launcher, neighbours: int = 1, limit: float = math.inf
) -> tuple[Tensor, Tensor]:
    """The nearest points of a tree.

    Parameters
    ----------
    queries : Tensor [Q, 3] float64
        Finite, on the tree's device.
    neighbours : int
        K, one of ``NEIGHBOURS``.
    limit : float
        Only points nearer than this count.

    Returns
    -------
    distances : Tensor [Q, K] float64
        Ascending; infinite where there are fewer.
    index : Tensor [Q, K] int64
        Rows of the points that the tree was built from; their number where there are fewer.
    """
    if neighbours not in NEIGHBOURS:
        raise ShapeError(f"neighbours must be one of {NEIGHBOURS}, got {neighbours}")
    given = (tuple(queries.shape[1:]), queries.dtype, queries.device)
    if given != ((3,), torch.float64, tree.points.device):
        raise ShapeError(f"queries must be [Q, 3] float64 on {tree.points.device}, got {given}")
    queries = queries.contiguous()
    distances = queries.new_empty(len(queries), neighbours)
    places = torch.empty_like(distances, dtype=torch.int64)
    arguments = NearestArguments(tree=_of(tree), count=len(queries), limit=limit * limit)
    fill(arguments, queries=queries, distances=distances, places=places)
    launcher.launch(f"nearest_{neighbours}", -(-len(queries) // THREADS), THREADS, arguments)
    found = places >= 0
    distances = distances.sqrt_().masked_fill_(~found, math.inf)
    return distances, tree.index[places.clamp_(min=0)].masked_fill_(~found, tree.count)


def choose_spread(points: Tensor, radius: float, *, launcher: Launcher) -> Tensor:
    """Which points [P, 3] float64 a greedy choice in their order takes, if no two may be within ``radius``; bool [P].

    Each round decides every point whose predecessors within the radius are decided; a shuffled order needs a number of
    rounds that grows with the logarithm of the number of points. The host waits for each.
    """
    tree = build_tree(points)
    states = torch.zeros(len(tree.points), dtype=torch.uint8, device=points.device)
    # d <= radius, as numbers that can be compared by d^2 < limit
    arguments = SpreadArguments(tree=_of(tree), limit=math.nextafter(radius * radius, math.inf))
    real = tree.index < tree.count
    waiting = real.nonzero().squeeze(1)
    while len(waiting) > 0:
        arguments.count = len(waiting)
        fill(arguments, open=waiting, turns=tree.index, states=states)
        launcher.launch("spread_points", -(-len(waiting) // THREADS), THREADS, arguments)
        waiting = waiting[states[waiting] == _OPEN]
    taken = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    taken[tree.index[real]] = states[real] == _TAKEN
    return taken
