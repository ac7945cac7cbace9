"""Settings of how a large capture is cut into blocks. Pure Python; never imports torch.

A coarse model of the whole scene is trained first and cut into blocks. Blocks are trained with the coarse model frozen
around them, and merged by cells. The reasons for the defaults are in docs/notebook/blocks.md.
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
EXTENTS = ("scene", "block")
STARTS = ("dense", "coarse")
AUTO = "auto"


@dataclass(frozen=True)
class CoarseModel:
    """The coarse model of the whole scene, which is frozen around each block."""

    # px. Photographs are shrunk by an integer factor to about this longer side. Position matters here, not detail.
    side: int = 400
    max_splats: int = 1_000_000  # limit; each block renders those that its photographs show
    schedule: float = 0.3  # fraction of the recipe's iterations; surfaces are in place after a third


@dataclass(frozen=True)
class Partition:
    """Cells, views and start of blocks."""

    # Number of blocks along the axes of the largest spread of cameras and sparse points, two (on the ground) or three.
    # ``()``: as many as memory needs.
    grid: tuple[int, ...] = ()
    coarse: CoarseModel = field(default_factory=CoarseModel)
    # Fraction of the mean cell side by which a block trains beyond its cell, so that surfaces at a seam are trained
    # with their surroundings. Multiplies the trained splats by (1 + 2 margin)^2.
    margin: float = 0.2
    # A photograph belongs to a block if at least this fraction of its blending weight in the coarse model is in the
    # block with its margin.
    min_share: float = 0.1
    min_views: int = 20  # minimum number of photographs of a block; the ones that show most of it are added
    # limit on trained splats of a block with its margin; gives the number of blocks of an open grid
    splats: int = 3_000_000
    photographs: int = 600  # approximate number of photographs of a block of an open grid
    # An open grid is cut along a third axis if its spread exceeds this fraction of the second axis: land and streets
    # are cut on the ground, halls and towers in space.
    flat: float = 0.5
    # After the merge, splats within this fraction of the mean cell side from a seam are trained once more, with all
    # others frozen, because the blocks on both sides were never rendered together.
    seam: float = 0.05
    # iterations per photograph of that training, as a fraction of those of a block; 0 disables it
    seam_schedule: float = 0.2
    # Start of a block. "dense": the recipe's dense start from the photographs of the block, if the recipe has one;
    # "coarse": the splats of the coarse model, without the detail of large photographs.
    start: str = "dense"
    extent: str = "scene"  # unit of sizes and steps in a block: extent of all cameras ("scene") or of its own ("block")

    @property
    def blocks(self) -> int:
        """Return the number of blocks; 0 for an open grid."""
        return math.prod(self.grid) if self.grid else 0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the blocks, which are their grid indices: ``1-3``."""
        places = itertools.product(*map(range, self.grid)) if self.grid else ()
        return tuple("-".join(map(str, place)) for place in places)


def check_partition(partition: Partition) -> Partition:
    """Return a valid partition, or raise RecipeError with the invalid field."""
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
    one_of(f"{where}.start", partition.start, STARTS)
    one_of(f"{where}.extent", partition.extent, EXTENTS)
    integer(f"{where}.coarse.side", coarse.side, low=16)
    integer(f"{where}.coarse.max_splats", coarse.max_splats, low=2)
    schedule = number(f"{where}.coarse.schedule", coarse.schedule, low=0.0)
    require(0 < schedule <= 1, f"{where}.coarse.schedule must be in (0, 1], got {schedule}")
    return partition


def parse_grid(text: str) -> tuple[int, ...]:
    """Return the grid of a value of ``--blocks`` (``3x3``, ``4x2x2``); () for ``auto``."""
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
            names = [entry.name for entry in fields(Partition) if entry.name not in ("grid", "coarse")]
            names += [f"coarse.{entry.name}" for entry in fields(CoarseModel)]
            raise RecipeError(f"--set partition.FIELD=VALUE takes the fields {', '.join(names)}; got {change!r}")
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
    partition: Partition = decode(data, Partition, "partition")
    return check_partition(partition)


def grid_for(blocks: int, spread: Sequence[float], flat: float) -> tuple[int, ...]:
    """Return a grid of at least ``blocks`` blocks with cells of about equal sides.

    ``spread`` has three numbers, of cameras and points along the axes, largest first; ``flat`` as of
    :class:`Partition`.
    """
    sides = [max(value, 1e-12) for value in spread]
    axes = 3 if sides[2] > flat * sides[1] else 2
    grid = [1] * axes
    while math.prod(grid) < blocks:
        longest = max(range(axes), key=lambda axis: sides[axis] / grid[axis])
        grid[longest] += 1
    return tuple(grid)
