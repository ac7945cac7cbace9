"""Write the streamed form of SOG: levels of detail in spatial chunks, which a viewer loads on demand.

``lod-meta.json`` contains a tree of boxes. Each leaf refers, for every level, to its splats in an SOG data set (file,
offset, count); level 0 is the finest. Its ``errors`` are the deviations of the levels from the finest. The folders of
the data sets are beside it. Follows the format description (developer.playcanvas.com, version 1, with ``lodErrors``).
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gs2d.contrib.formats.levels import halved
from gs2d.contrib.formats.quantised import morton_order
from gs2d.contrib.formats.sog import packed_sog
from gs2d.core.atomic_files import atomic_write, disk_error
from gs2d.core.camera import look_at
from gs2d.errors import BackendError
from gs2d.io.formats.splat_formats import register_format
from gs2d.io.gaussians import Gaussians, unit_quats
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings

INDEX = "lod-meta.json"
LEVELS = 4  # minimum: 1, 1/2, 1/4 and 1/8 of the splats
_MOST_LEVELS, _COARSEST = 8, 250_000  # further levels are added until the coarsest has at most this many splats
_LEAF = 16_384  # largest number of splats of the finest level in a leaf
_FILE = 131_072  # approximate number of splats in a data set
_VIEW = 256  # px, side of the images that compare levels: about two per splat of a full leaf on a surface
_DISTANCE = 8.0  # distance of their cameras from the centre of a leaf, in radii of its box
_REACH = 3.0  # standard deviations of splats that a box contains
_PARTS = ("means_l", "means_u", "scales", "quats", "sh0", "shN_centroids", "shN_labels")


@dataclass(frozen=True, eq=False)
class _Level:
    """One level of detail: its splats by leaf, in Morton order within a leaf, and the start of each leaf."""

    gaussians: Gaussians
    ends: np.ndarray  # [L + 1]

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounding boxes (low, high) [L, 3] of the splats of each leaf; infinite for empty leaves."""
        g, leaves = self.gaussians, len(self.ends) - 1
        turn = Rotation.from_quat(unit_quats(g.quats)[:, [1, 2, 3, 0]]).as_matrix()
        reach = _REACH * np.sqrt(np.square(turn * np.exp(g.log_scales[:, None].astype(np.float64))).sum(axis=2))
        low, high = np.full((leaves, 3), np.inf), np.full((leaves, 3), -np.inf)
        leaf = np.repeat(np.arange(leaves), np.diff(self.ends))
        np.minimum.at(low, leaf, g.means - reach)
        np.maximum.at(high, leaf, g.means + reach)
        return low, high


def write_streamed_sog(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a ``lod-meta.json`` in a folder that is created if missing, and the folders of its data sets beside it.

    Each level has half of the splats of the previous one. There are 4, or up to 8 so that the coarsest has at most
    250,000 splats.

    The index is written last, atomically, so it always refers to complete data sets. Then the data sets of an older
    index of the same name are removed. Other files in the folder are not changed.
    """
    path = Path(path)
    older = _listed(path)
    tree, cells = _divided(gaussians.means)
    levels = list(_coarsened(gaussians, cells, int(cells.max(initial=0)) + 1, _levels_for(len(gaussians))))
    with _new_folders(path) as folder:
        index = _written(path.parent, folder, levels)
        bounds = [level.bounds() for level in levels]
        low, high = (f([ends[k] for ends in bounds], axis=0) for k, f in ((0, np.min), (1, np.max)))
        leaves = [{"lods": lods} for lods in index.pop("leaves")]
        with contextlib.suppress(BackendError):  # without the native library readers estimate errors from the counts
            backend = get_backend("cpu")
            for number, leaf in enumerate(leaves):
                parts = [level.gaussians.rows(np.arange(*level.ends[number : number + 2])) for level in levels]
                leaf["errors"] = _errors(parts, low[number], high[number], backend)
            index["lodErrors"] = True
        index["tree"] = _node(tree, low, high, leaves)
        with atomic_write(path, "w") as file:
            file.write(json.dumps(index, separators=(",", ":")))
    for name in older:
        _remove(path.parent / name)


def streamed_bytes(path: Path) -> int:
    """Return the size of a stream in bytes: its index and all data sets."""
    folders = [path.parent / name for name in _listed(path)]
    return path.stat().st_size + sum(file.stat().st_size for folder in folders for file in folder.iterdir())


def _levels_for(count: int) -> int:
    return next(n for n in range(LEVELS, _MOST_LEVELS + 1) if count >> (n - 1) <= _COARSEST or n == _MOST_LEVELS)


def _divided(means: np.ndarray) -> tuple[Any, np.ndarray]:
    """Split space at medians; returns a tree of pairs with leaf indices, and the leaf of each splat [N]."""
    cells, numbers = np.zeros(len(means), int), itertools.count()

    def divide(rows: np.ndarray) -> Any:
        if len(rows) <= _LEAF:
            cells[rows] = leaf = next(numbers)
            return leaf
        some = means[rows]
        axis = int(np.argmax(np.quantile(some, 0.95, axis=0) - np.quantile(some, 0.05, axis=0)))  # ignores outliers
        order = np.argsort(some[:, axis], kind="stable")
        return divide(rows[order[: len(rows) // 2]]), divide(rows[order[len(rows) // 2 :]])

    return divide(np.arange(len(means))), cells


def _coarsened(g: Gaussians, cells: np.ndarray, leaves: int, levels: int) -> Iterator[_Level]:
    for level in range(levels):
        if level:
            g, cells = halved(g, cells)
        order = morton_order(g.means)
        order = order[np.argsort(cells[order], kind="stable")]
        yield _Level(g.rows(order), np.searchsorted(cells[order], np.arange(leaves + 1)))


def _written(home: Path, folder: str, levels: list[_Level]) -> dict[str, Any]:
    """Write the data sets; returns the index, with the splats of each leaf by level as ``leaves``."""
    names: list[str] = []
    leaves: list[dict[str, dict[str, int]]] = [{} for _ in levels[0].ends[1:]]
    for number, level in enumerate(levels):
        first = 0
        while first < len(leaves):
            begin = level.ends[first]
            last = max(first + 1, int(np.searchsorted(level.ends, begin + _FILE)))  # the first leaf beyond the size
            last = min(last, len(leaves))
            name = folder.format(level=number, file=len(names))
            _write_set(home / name, level.gaussians.rows(np.arange(begin, level.ends[last])))
            for leaf in range(first, last):
                offset, count = int(level.ends[leaf] - begin), int(level.ends[leaf + 1] - level.ends[leaf])
                leaves[leaf][str(number)] = {"file": len(names), "offset": offset, "count": count}
            names.append(f"{name}/meta.json")
            first = last
    counts = [len(level.gaussians) for level in levels]
    return {
        "version": 1,
        "asset": {"generator": "gs2d"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "lodErrors": False,
        "filenames": names,
        "leaves": leaves,
    }


def _write_set(folder: Path, g: Gaussians) -> None:
    try:
        folder.mkdir()
    except OSError as error:
        raise disk_error(folder, error) from error
    for name, data in packed_sog(g).items():
        with atomic_write(folder / name) as file:
            file.write(data)


def _errors(levels: list[Gaussians], low: np.ndarray, high: np.ndarray, backend: Backend) -> list[float]:
    """Return the deviation of each level of a leaf from the finest, finite and not decreasing.

    The measure is that of SplatTransform: squared differences of images, with alpha, relative to the squared images of
    the finest level, summed over views along the six directions of the axes. Only ratios of the errors matter.
    """
    if not len(levels[0]):  # and no box
        return [0.0] * len(levels)
    total, errors = 0.0, np.zeros(len(levels))
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    settings = RasterSettings(near=radius, with_distortion=False)
    for side, axis in itertools.product((-1.0, 1.0), range(3)):
        eye, up = middle + side * _DISTANCE * radius * np.eye(3)[axis], np.eye(3)[axis - 1]
        camera = look_at(eye, middle, up, width=_VIEW, height=_VIEW, fx=_DISTANCE * _VIEW / 2)
        drawn = [rasterize(level.disks(), camera, settings, backend=backend) for level in levels]
        images = [np.dstack([image.color.numpy(), image.alpha.numpy()]).astype(np.float64) for image in drawn]
        total += np.square(images[0]).sum()
        errors += [np.square(image - images[0]).sum() for image in images]
    relative = np.maximum.accumulate(errors / total if total else errors)
    return [float(f"{error:.7g}") for error in relative]


def _node(tree: Any, low: np.ndarray, high: np.ndarray, leaves: list[dict[str, Any]]) -> dict[str, Any]:
    if isinstance(tree, int):
        ends = (low[tree], high[tree]) if np.isfinite(low[tree]).all() else (np.zeros(3), np.zeros(3))
        bound = {key: [float(f"{value:.7g}") for value in end] for key, end in zip(("min", "max"), ends, strict=True)}
        return {"bound": bound, **leaves[tree]}
    children = [_node(child, low, high, leaves) for child in tree]
    bound = {
        key: [float(value) for value in merge([child["bound"][key] for child in children], axis=0)]
        for key, merge in (("min", np.min), ("max", np.max))
    }
    return {"bound": bound, "children": children}


@contextlib.contextmanager
def _new_folders(path: Path) -> Iterator[str]:
    """Yield a pattern for names of new folders beside ``path``; they are removed if the body fails."""
    created = False
    try:
        if not path.parent.is_dir():
            path.parent.mkdir()
            created = True
        there = os.listdir(path.parent)
    except OSError as error:
        raise disk_error(path.parent, error) from error
    ours = (tail for tail in itertools.chain([""], (f"-{n}" for n in itertools.count(2))))
    tail = next(t for t in ours if not any(_numbered(name, t) for name in there))
    try:
        yield "{level}_{file}" + tail
    except BaseException:
        for name in os.listdir(path.parent):
            if name not in there and _numbered(name, tail):
                _remove(path.parent / name)
        if created:
            with contextlib.suppress(OSError):
                path.parent.rmdir()
        raise


def _numbered(name: str, tail: str) -> bool:
    """Return whether a name is that of a data set with this suffix."""
    if not name.endswith(tail):
        return False
    parts = name[: len(name) - len(tail)].split("_")
    return len(parts) == 2 and all(part.isdecimal() for part in parts)


def _listed(path: Path) -> list[str]:
    """Return the folders of data sets that an index refers to; empty if it is missing or invalid."""
    try:
        names = json.loads(path.read_bytes())["filenames"]
        folders = [name.removesuffix("/meta.json") for name in names if name.endswith("/meta.json")]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []
    return [name for name in folders if name and name == os.path.basename(name) and name not in (".", "..")]


def _remove(folder: Path) -> None:
    """Remove the files of a data set, and its folder if it is empty then."""
    for name in (*(f"{part}.webp" for part in _PARTS), "meta.json"):
        with contextlib.suppress(OSError):
            (folder / name).unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


_register = register_format("streamed", ending=f"/{INDEX}", size=streamed_bytes)
_register(lambda path, splats: write_streamed_sog(path, Gaussians.of(splats)))
