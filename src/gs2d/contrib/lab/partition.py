"""How a capture that is too large for one training is cut into blocks, as data. Pure Python; never imports torch.

A coarse model of everything is trained first; blocks are cut of it, trained one by one or side by side with the coarse
model frozen around them, and merged by who owns what. Why each value is as it is: docs/notebook/blocks.md.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from gs2d.config.serialize import decode
from gs2d.config.validate import integer, number, one_of, require
from gs2d.errors import RecipeError

MAX_BLOCKS = 10_000
OWNERSHIP = ("center",)
EXTENTS = ("scene", "block")
STARTS = ("dense", "coarse")
AUTO = "auto"


@dataclass(frozen=True)
class CoarseModel:
    """The model of everything that blocks begin with, and that stands around each of them.

    Attributes
    ----------
    side : int, px
        Photographs are shrunk by a whole factor until their longer side is about this: it is to tell what is where,
        not what it looks like from near.
    max_splats : int
        Its budget. Every block renders those that its photographs show.
    schedule : float
        Fraction of the recipe's iterations. Where surfaces are is found in the first third; blocks do the rest.
    """

    side: int = 400
    max_splats: int = 1_000_000
    schedule: float = 0.3


@dataclass(frozen=True)
class Partition:
    """Where blocks are cut, what each of them sees, and what they begin with.

    Attributes
    ----------
    grid : tuple of int
        Blocks along the axes of the largest spread of cameras and sparse points; two numbers (along the ground) or
        three. ``()``: as many as memory needs.
    coarse : CoarseModel
    margin : float
        A block trains beyond its cell, on each side, by this fraction of a cell's mean side: what lies at a seam is
        trained with what is behind it, on both sides. Costs (1 + 2 margin)^2 of the splats while it trains.
    min_share : float
        A photograph belongs to a block when at least this fraction of what it shows (blending weight of the coarse
        model's splats) is the block's, its margin included.
    min_views : int
        A block has at least so many photographs, those that show most of it: with few, blocks stay untrained.
    splats : int
        That one block trains at most, its margin included; an open grid has as many blocks as that needs.
    photographs : int
        Of one block, about, where the grid is open.
    flat : float
        A third axis is cut, where the grid is open, if the spread along it is more than this of that along the second:
        land and streets are cut along the ground, a hall or a tower in space.
    seam : float
        After the merge, splats within this fraction of a cell's mean side of a seam learn once more, with all others
        frozen: what is left of two blocks at a seam was never drawn together.
    seam_schedule : float
        How often a photograph of a seam is looked at for that, in the looks of a block at its own; by a block's last
        rates, without coming or going, and for no more iterations than a block has. 0: not done.
    start : "dense" or "coarse"
        What a block begins with: the recipe's dense start, where it has one, of the block's own photographs, or the
        coarse model's splats. Where photographs are large the coarse model knows a fraction of what they show.
    ownership : "center"
        The block keeps the splats whose centre lies in its cell; cells share no point and leave none out.
    extent : "scene" or "block"
        What sizes and steps are measured by in a block: the extent of all cameras, as without blocks, or of its own.
    """

    grid: tuple[int, ...] = ()
    coarse: CoarseModel = field(default_factory=CoarseModel)
    margin: float = 0.2
    min_share: float = 0.1
    min_views: int = 20
    splats: int = 3_000_000
    photographs: int = 600
    flat: float = 0.5
    seam: float = 0.05
    seam_schedule: float = 0.2
    start: str = "dense"
    ownership: str = "center"
    extent: str = "scene"

    @property
    def blocks(self) -> int:
        """How many, where the grid says it; 0: open."""
        return math.prod(self.grid) if self.grid else 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the blocks, by their place in the grid: ``1-3``."""
        places = itertools.product(*map(range, self.grid)) if self.grid else ()
        return tuple("-".join(map(str, place)) for place in places)


def check_partition(partition: Partition) -> Partition:
    """Return a partition that can be cut.

    Raises
    ------
    RecipeError
        Names the field.
    """
    where, coarse = "partition", partition.coarse
    require(len(partition.grid) in (0, 2, 3), f"{where}.grid must be 2 or 3 numbers, got {list(partition.grid)}")
    for count in partition.grid:
        integer(f"{where}.grid", count, low=1)
    require(partition.blocks <= MAX_BLOCKS, f"{where}.grid must be at most {MAX_BLOCKS:,} blocks, got more")
    for name, low in (("min_views", 1), ("splats", 1), ("photographs", 1)):
        integer(f"{where}.{name}", getattr(partition, name), low=low)
    for name in ("margin", "min_share", "flat", "seam", "seam_schedule"):
        number(f"{where}.{name}", getattr(partition, name), low=0.0)
    require(partition.margin <= 1, f"{where}.margin must be at most 1 side of a cell, got {partition.margin}")
    require(partition.min_share < 1, f"{where}.min_share must be below 1, got {partition.min_share}")
    for name in ("seam", "seam_schedule"):
        require(getattr(partition, name) <= 1, f"{where}.{name} must be at most 1, got {getattr(partition, name)}")
    one_of(f"{where}.ownership", partition.ownership, OWNERSHIP)
    one_of(f"{where}.start", partition.start, STARTS)
    one_of(f"{where}.extent", partition.extent, EXTENTS)
    integer(f"{where}.coarse.side", coarse.side, low=16)
    integer(f"{where}.coarse.max_splats", coarse.max_splats, low=2)
    schedule = number(f"{where}.coarse.schedule", coarse.schedule, low=0.0)
    require(0 < schedule <= 1, f"{where}.coarse.schedule must be in (0, 1], got {schedule}")
    return partition


def parse_grid(text: str) -> tuple[int, ...]:
    """Return the grid that ``--blocks`` says: ``3x3``, ``4x2x2``; () for ``auto``."""
    if text == AUTO:
        return ()
    parts = re.fullmatch(r"(\d{1,5})x(\d{1,5})(?:x(\d{1,5}))?", text)
    grid = () if parts is None else tuple(int(part) for part in parts.groups() if part is not None)
    if not grid or min(grid) < 1:
        raise RecipeError(
            f"--blocks must be auto, or two or three whole numbers of 1 or more such as 3x3 or 2x2x2, got {text}"
        )
    return grid


def make_partition(blocks: str, changes: Sequence[str] = ()) -> Partition:
    """Return the partition of ``--blocks`` and of ``field=value`` changes (``margin=0.3``, ``coarse.side=800``)."""
    data = to_json(replace(Partition(), grid=parse_grid(blocks)))
    for change in changes:
        name, equals, text = change.partition("=")
        *path, last = name.strip().split(".")
        node: Any = data
        for word in path:
            node = node.get(word) if isinstance(node, dict) else None
        if not equals or not isinstance(node, dict) or last not in node or isinstance(node[last], dict):
            known = [entry.name for entry in fields(Partition) if entry.name not in ("grid", "coarse")]
            known += [f"coarse.{entry.name}" for entry in fields(CoarseModel)]
            raise RecipeError(f"--set partition.FIELD=VALUE takes the fields {', '.join(known)}; got {change!r}")
        try:
            node[last] = json.loads(text)
        except json.JSONDecodeError:
            node[last] = text.strip()
    return from_json(data)


def to_json(partition: Partition) -> dict[str, Any]:
    """Return a partition as plain values."""
    return {**asdict(partition), "grid": list(partition.grid)}


def from_json(data: Any) -> Partition:
    """Return the partition that :func:`to_json` wrote, checked."""
    found: Partition = decode(data, Partition, "partition")
    return check_partition(found)


def grid_for(blocks: int, spread: Sequence[float], flat: float) -> tuple[int, ...]:
    """Return a grid of at least so many blocks whose cells are about as long as wide.

    Parameters
    ----------
    blocks : int
    spread : three floats
        Of cameras and points along the axes, largest first.
    flat : float
        As of :class:`Partition`.
    """
    sides = [max(value, 1e-12) for value in spread]
    axes = 3 if sides[2] > flat * sides[1] else 2
    grid = [1] * axes
    while math.prod(grid) < blocks:
        longest = max(range(axes), key=lambda axis: sides[axis] / grid[axis])
        grid[longest] += 1
    return tuple(grid)
