"""Cuts a coarse model into blocks: cells of equal visible weight, their photographs and their trained splats."""

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
from gs2d.data import Scene
from gs2d.errors import DataError, RunError
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.training.events import Notice, OnEvent, counted
from gs2d.training.robust.large_splats import shown_weights, shrunk

SIDE = 200  # px, of the renderings in which visibility is measured
LEAST_WEIGHT = 1e-3  # px, smallest blending weight of a visible splat
SEAMS = "seams"  # name of the start file of the seams
CELLS = "cells.json"  # written last
FORMAT = 1


@dataclass(frozen=True)
class BlockOfSplit:
    """A block of the scene."""

    name: str  # grid indices, ``1-3``
    views: tuple[str, ...]  # training photographs, in the order of the scene; () if the block is not trained
    floor: int  # number of photographs that were added to reach ``Partition.min_views``
    own: int  # coarse splats that are trained
    frozen: int  # coarse splats that are frozen
    core: int  # coarse splats that lie in the cell
    weight: float  # fraction of the visible weight of the scene in the cell and its margin
    extent: float  # extent of the cameras of the block, world units
    skipped: str = ""  # reason if the block is not trained, else empty


@dataclass(frozen=True, eq=False)
class Split:
    """Cells and their blocks, in the same order."""

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
    """Return the path of the start file of a block."""
    return folder / f"{block}.npz"


def read_split(folder: Path) -> Split:
    """Return the split of a folder."""
    return Split.from_json(read_json(folder / CELLS))


def split_model(
    trained: Trained,
    partition: Partition,
    folder: Path,
    on_event: OnEvent,
) -> Split:
    """Cut a coarse model into the blocks of a partition with a grid; write ``BLOCK.npz``, then ``cells.json``.

    Raises DataError if no photograph shows the model.
    """
    splats, scene, looks = trained.splats, trained.scene, Looks(trained)
    places = splats.means.detach().cpu().numpy()
    total = np.zeros(len(splats))
    for weights in counted(looks.all(), "measuring visibility", len(scene.train), on_event):
        total += weights
    if not (total > 0).any():
        raise DataError("no photograph shows the coarse model; check the cameras with `gs2d info`")
    spread = spread_of(np.array([view.camera.center for view in scene.train]), _points(scene))
    cells = cut(places, total, spread.axes[: len(partition.grid)], partition.grid, partition.margin)
    near = np.stack([cells.near(cell, places) for cell in range(len(cells))])  # [B, N]
    shares, visible = _shares(looks, near, partition, on_event)
    blocks = []
    owner = cells.owners(places)
    for cell, name in enumerate(cells.names):
        chosen, floor = choose_views(shares[:, cell], partition)
        for index in floor:
            visible[cell] |= looks.at(index) > LEAST_WEIGHT
        core = int((owner == cell).sum())
        views = tuple(scene.train[i].name for i in chosen)
        own, frozen = near[cell] & visible[cell], ~near[cell] & visible[cell]
        why = "none of its splats is visible" if not own.any() else "no photograph shows it" if not views else ""
        if why:
            on_event(Notice(f"block {name} is not trained: {why}; its {core} splats are those of the coarse model"))
        rows = FROZEN * frozen.astype(np.uint8) + OWN * own.astype(np.uint8)
        exposures = _exposures(scene, views)
        write_start(start_file(folder, name), rows, exposures)
        extent = camera_extent([scene.train[i].camera for i in chosen]) if len(chosen) > 1 else scene.extent
        counts = {"floor": len(floor), "own": int(own.sum()), "frozen": int(frozen.sum()), "core": core}
        weight = float(total[near[cell]].sum() / total.sum())
        blocks.append(BlockOfSplit(name, () if why else views, weight=weight, extent=extent, skipped=why, **counts))
    split = Split(cells, tuple(blocks))
    write_json(folder / CELLS, split.to_json())
    return split


def split_seams(
    trained: Trained,
    split: Split,
    partition: Partition,
    folder: Path,
    on_event: OnEvent,
) -> tuple[str, ...]:
    """Write the start file of the visible splats at seams of a merged scene; parameters as of ``split_model``.

    Returns photographs that show these splats with at least half of ``Partition.min_share``; () if there are none.
    """
    splats, scene = trained.splats, trained.scene
    places, width = splats.means.detach().cpu().numpy(), partition.seam * split.cells.side
    strip = split.cells.distance_to_seam(places) < width
    looks, shares, visible = Looks(trained), [], np.zeros(len(splats), dtype=bool)
    for weights in counted(looks.all(), "measuring seams", len(looks), on_event):
        shares.append(weights[strip].sum() / max(weights.sum(), LEAST_WEIGHT))
        if shares[-1] >= partition.min_share / 2:
            visible |= weights > LEAST_WEIGHT
    chosen = [view.name for view, share in zip(scene.train, shares, strict=True) if share >= partition.min_share / 2]
    own = strip & visible
    rows = np.where(own, OWN, FROZEN).astype(np.uint8)
    exposures = _exposures(scene, chosen)
    write_start(start_file(folder, SEAMS), rows, exposures)
    return tuple(chosen) if own.any() else ()


def _exposures(scene: Scene, names: Sequence[str]) -> np.ndarray | None:
    """Return the exposure transforms [V, 3, 4] of training views; None if none were learned."""
    exposures = {view.name: view.appearance["exposure"] for view in scene.train if "exposure" in view.appearance}
    return np.stack([exposures[name] for name in names]) if exposures and names else None


class Looks:
    """Blending weights [N] (px, float64) of all splats in each view of a scene."""

    def __init__(self, trained: Trained) -> None:
        self._trained, self._views = trained, trained.scene.train

    def at(self, index: int) -> np.ndarray:
        """Return the weights in a view."""
        trained, camera = self._trained, shrunk(self._views[index].camera, SIDE)
        weights = shown_weights(trained.splats, camera, trained.settings, trained.backend)
        return np.asarray(weights.cpu().numpy().astype(np.float64))

    def __len__(self) -> int:
        return len(self._views)

    def all(self) -> Iterator[np.ndarray]:
        """Yield the weights in each view."""
        return map(self.at, range(len(self)))


def _shares(
    looks: Looks, near: np.ndarray, partition: Partition, on_event: OnEvent
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return shares of views [V, B], and for each block which splats [N] its photographs show."""
    shares = np.zeros((len(looks), len(near)))
    visible = [np.zeros(near.shape[1], dtype=bool) for _ in near]
    for index, weights in enumerate(counted(looks.all(), "choosing photographs", len(looks), on_event)):
        whole = weights.sum()
        if whole <= 0:
            continue
        shares[index] = [weights[inside].sum() / whole for inside in near]
        for cell in np.flatnonzero(shares[index] >= partition.min_share):
            visible[cell] |= weights > LEAST_WEIGHT
    return shares, visible


def choose_views(shares: np.ndarray, partition: Partition) -> tuple[np.ndarray, list[int]]:
    """Return the views of a block, sorted, and those that were added to reach the minimum, from shares [V]."""
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
    """Return the merged scene: for each block, the splats whose centre lies in its cell.

    These are the trained splats of the block (``trained``, by name), then coarse splats that it did not train. ``rows``
    has the kinds [N] of the coarse splats, from the start files of these blocks.
    """
    owner = split.cells.owners(coarse.means.detach().cpu().numpy())
    parts = []
    for cell, block in enumerate(split.blocks):
        remaining = owner == cell
        if block.name in trained:
            splats = trained[block.name]
            inside = split.cells.owners(splats.means.detach().cpu().numpy()) == cell
            parts.append(splats.rows(torch.from_numpy(inside)))
            remaining = remaining & (rows[block.name] != OWN)
        parts.append(coarse.rows(torch.from_numpy(remaining)))
    names = [name for name, _ in coarse.items()]
    return Splats(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
