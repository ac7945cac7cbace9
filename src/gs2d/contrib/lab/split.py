"""A coarse model cut into blocks: cells of equal visible weight, the photographs of each, and what it trains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.contrib.lab.block_start import FROZEN, OWN, write_start
from gs2d.contrib.lab.cells import Cells, cut, spread_of
from gs2d.contrib.lab.partition import Partition
from gs2d.core.json_files import read_json, write_json
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent
from gs2d.data import Scene, View
from gs2d.errors import DataError, RunError
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training.events import Notice, OnEvent, counted
from gs2d.training.robust.seen_area import shown_weights, shrunk

SIDE = 200  # px, of the pictures in which is looked at what shows what: fractions do not need more
LEAST_WEIGHT = 1e-3  # px of a splat in a picture, from which it is shown there
SEAMS = "seams"  # what is trained once more after the merge
CELLS = "cells.json"  # in the folder of the partition, last: it is whole then
FORMAT = 1


@dataclass(frozen=True)
class BlockOfSplit:
    """One part of the scene.

    Attributes
    ----------
    name : str
        By its place in the grid: ``1-3``.
    views : tuple of str
        Training photographs, in the scene's order; none where the block is left as the coarse model has it.
    floor : int
        How many of them are there only so that there are enough.
    own, frozen, core : int
        Splats of the coarse model that train, that stay around them, and that lie in the cell.
    weight : float
        Fraction of all that is seen that lies in the cell and its margin.
    extent : float, world units
        Of its cameras.
    skipped : str
        Why it is not trained; empty where it is.
    """

    name: str
    views: tuple[str, ...]
    floor: int
    own: int
    frozen: int
    core: int
    weight: float
    extent: float
    skipped: str = ""


@dataclass(frozen=True, eq=False)
class Split:
    """Cells and their blocks, in one order."""

    cells: Cells
    blocks: tuple[BlockOfSplit, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {"format": FORMAT, "cells": self.cells.to_json(), "blocks": [asdict(block) for block in self.blocks]}

    @classmethod
    def from_json(cls, data: Any) -> Split:
        """Return the split that :meth:`to_json` described."""
        try:
            if data["format"] != FORMAT:
                raise ValueError(f"format {data['format']!r}, expected {FORMAT}")
            blocks = tuple(BlockOfSplit(**{**entry, "views": tuple(entry["views"])}) for entry in data["blocks"])
            return cls(Cells.from_json(data["cells"]), blocks)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise RunError(f"{CELLS} of a partition is damaged ({type(error).__name__}: {error})") from error


def start_file(folder: Path, block: str) -> Path:
    """Return where it is said what a block begins with."""
    return folder / f"{block}.npz"


def read_split(folder: Path) -> Split:
    """Return the split of a folder."""
    return Split.from_json(read_json(folder / CELLS))


def split_model(
    splats: Splats,
    scene: Scene,
    partition: Partition,
    raster: RasterSettings,
    backend: Backend,
    folder: Path,
    on_event: OnEvent,
) -> Split:
    """Cut a coarse model and write what each block trains: ``BLOCK.npz``, and at last ``cells.json``.

    Parameters
    ----------
    splats : Splats
    scene : Scene
    partition : Partition
        With a grid.
    raster : RasterSettings
        Of training.
    backend : Backend
    folder : Path

    Raises
    ------
    DataError
        No photograph shows anything of the model.
    DiskError
    """
    looks = Looks(splats, scene.train, raster, backend)
    places = splats.means.detach().cpu().numpy()
    total = np.zeros(len(splats))
    for weights in counted(looks.all(), "looking at what is seen", len(scene.train), on_event):
        total += weights
    if not (total > 0).any():
        raise DataError("no photograph shows anything of the coarse model; check the cameras with `gs2d info`")
    spread = spread_of(np.array([view.camera.center for view in scene.train]), _points(scene))
    cells = cut(places, total, spread.axes[: len(partition.grid)], partition.grid, partition.margin)
    near = np.stack([cells.near(cell, places) for cell in range(len(cells))])  # [B, N]
    shares, seen = _shares(looks, near, partition, on_event)
    blocks = []
    owner = cells.owners(places)
    for cell, name in enumerate(cells.names):
        chosen, floor = choose_views(shares[:, cell], partition)
        for index in floor:
            seen[cell] |= looks.at(index) > LEAST_WEIGHT
        core = int((owner == cell).sum())
        views = tuple(scene.train[i].name for i in chosen)
        own, frozen = near[cell] & seen[cell], ~near[cell] & seen[cell]
        why = "none of its splats is seen" if not own.any() else "no photograph shows it" if not views else ""
        if why:
            on_event(Notice(f"block {name} is not trained: {why}; it stays as the coarse model has it ({core} splats)"))
        rows = FROZEN * frozen.astype(np.uint8) + OWN * own.astype(np.uint8)
        known = _exposures(scene, views)
        write_start(start_file(folder, name), rows, known)
        extent = camera_extent([scene.train[i].camera for i in chosen]) if len(chosen) > 1 else scene.extent
        counts = {"floor": len(floor), "own": int(own.sum()), "frozen": int(frozen.sum()), "core": core}
        weight = float(total[near[cell]].sum() / total.sum())
        blocks.append(BlockOfSplit(name, () if why else views, weight=weight, extent=extent, skipped=why, **counts))
    found = Split(cells, tuple(blocks))
    write_json(folder / CELLS, found.to_json())
    return found


def split_seams(
    splats: Splats,
    split: Split,
    scene: Scene,
    partition: Partition,
    raster: RasterSettings,
    backend: Backend,
    folder: Path,
    on_event: OnEvent,
) -> tuple[str, ...]:
    """Write which splats of a merged scene learn once more, those at seams that are seen; arguments as of a model.

    Returns
    -------
    tuple of str
        Photographs that show them: at least half as much as a block's photographs show of it. None: nothing to do.
    """
    places, width = splats.means.detach().cpu().numpy(), partition.seam * split.cells.side
    strip = split.cells.distance_to_seam(places) < width
    looks, shares, seen = Looks(splats, scene.train, raster, backend), [], np.zeros(len(splats), dtype=bool)
    for weights in counted(looks.all(), "looking at seams", len(looks), on_event):
        shares.append(weights[strip].sum() / max(weights.sum(), LEAST_WEIGHT))
        if shares[-1] >= partition.min_share / 2:
            seen |= weights > LEAST_WEIGHT
    chosen = [view.name for view, share in zip(scene.train, shares, strict=True) if share >= partition.min_share / 2]
    own = strip & seen
    rows = np.where(own, OWN, FROZEN).astype(np.uint8)
    known = _exposures(scene, chosen)
    write_start(start_file(folder, SEAMS), rows, known)
    return tuple(chosen) if own.any() else ()


def _exposures(scene: Scene, names: Sequence[str]) -> np.ndarray | None:
    """Return the transforms [V, 3, 4] of some training views; None if none were learned."""
    known = {view.name: view.appearance["exposure"] for view in scene.train if "exposure" in view.appearance}
    return np.stack([known[name] for name in names]) if known and names else None


class Looks:
    """What each view of a scene shows of each splat: blending weights [N] px float64, view by view."""

    def __init__(self, splats: Splats, views: Sequence[View], raster: RasterSettings, backend: Backend) -> None:
        self._splats, self._views, self._raster, self._backend = splats, views, raster, backend

    def at(self, index: int) -> np.ndarray:
        """Return those of a view."""
        camera = shrunk(self._views[index].camera, SIDE)
        found = shown_weights(self._splats, camera, self._raster, self._backend)
        return np.asarray(found.cpu().numpy().astype(np.float64))

    def __len__(self) -> int:
        return len(self._views)

    def all(self) -> Iterator[np.ndarray]:
        """Yield those of each view."""
        return map(self.at, range(len(self)))


def _shares(
    looks: Looks, near: np.ndarray, partition: Partition, on_event: OnEvent
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return shares of views [V, B], and which splats [N] the photographs of each block show that show enough of it."""
    shares = np.zeros((len(looks), len(near)))
    seen = [np.zeros(near.shape[1], dtype=bool) for _ in near]
    for index, weights in enumerate(counted(looks.all(), "choosing photographs", len(looks), on_event)):
        whole = weights.sum()
        if whole <= 0:
            continue
        shares[index] = [weights[inside].sum() / whole for inside in near]
        for cell in np.flatnonzero(shares[index] >= partition.min_share):
            seen[cell] |= weights > LEAST_WEIGHT
    return shares, seen


def choose_views(shares: np.ndarray, partition: Partition) -> tuple[np.ndarray, list[int]]:
    """Return the views of a block by what fraction of each is the block's [V]: all, sorted, and those of the floor."""
    chosen = np.flatnonzero((shares >= partition.min_share) & (shares > 0))
    lacking = partition.min_views - len(chosen)
    floor: list[int] = []
    if lacking > 0:
        order = np.argsort(-shares, kind="stable")
        floor = [int(i) for i in order if shares[i] > 0 and shares[i] < partition.min_share][:lacking]
    return np.sort(np.concatenate([chosen, np.array(floor, np.int64)])), floor


def _points(scene: Scene) -> np.ndarray | None:
    return None if scene.points is None else scene.points.points


def merge(coarse: Splats, split: Split, trained: dict[str, Splats], rows: dict[str, np.ndarray]) -> Splats:
    """Return one scene: of each block, in order, the splats whose centre lies in its cell.

    Those that the block trained, and then those of the coarse model in its cell that it did not train: the block has
    seen nothing of them, or has not been trained at all.

    Parameters
    ----------
    coarse : Splats
    split : Split
    trained : dict of name to Splats
        Of the blocks that were trained.
    rows : dict of name to ndarray [N]
        What those began with, of the coarse model.
    """
    owner = split.cells.owners(coarse.means.detach().cpu().numpy())
    parts = []
    for cell, block in enumerate(split.blocks):
        left = owner == cell
        if block.name in trained:
            splats = trained[block.name]
            inside = split.cells.owners(splats.means.detach().cpu().numpy()) == cell
            parts.append(splats.rows(torch.from_numpy(inside)))
            left = left & (rows[block.name] != OWN)
        parts.append(coarse.rows(torch.from_numpy(left)))
    names = [name for name, _ in coarse.items()]
    return Splats(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
