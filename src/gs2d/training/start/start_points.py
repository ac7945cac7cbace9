"""Points to start from: swept ones, interpolated ones where photographs have no texture, and sparse ones elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from gs2d.config.robust import MAX_ANGLE, DenseStart
from gs2d.core.memory_limit import cache_bytes
from gs2d.core.spill import Spilled
from gs2d.core.transforms import nearest_distances
from gs2d.data.scene import PointCloud, Scene
from gs2d.errors import DataError
from gs2d.losses.formulas import flatness
from gs2d.training.start.closing import closed_depth, enclosed
from gs2d.training.start.plane_sweep import BARE, SWEEP_BYTES, SmallView, Sweep, project, unproject

WAITING = 500_000  # points that are collected before they are thinned
MARGIN = 5.0  # px between them and known ones: small gaps close by themselves, and dark recesses are often narrow
CLOSED_AGREE = 0.015  # interpolated depths of two views agree when they differ by at most this fraction
CLOSED_CELL = 2.0  # cells of swept points: interpolated ones are sparser, since they have no detail
REPEATED = 3.0  # cells: nearer to a swept point, a sparse point starts no splat of its own


def start_points(
    scene: Scene, sweep: Sweep, settings: DenseStart, around: tuple[np.ndarray, ...] | None = None
) -> PointCloud:
    """Return points to start from: swept ones, interpolated ones, and sparse ones that are far from the swept ones.

    For a fitted start, sparse points keep the size that they have among all sparse points (:attr:`PointCloud.sizes`).

    Parameters
    ----------
    scene : Scene
    sweep : Sweep
    settings : DenseStart
    around : tuple of ndarray, optional
        Further points with a size of their own: positions, colours in [0, 1], normals [P, 3], sizes [P].

    Raises
    ------
    DataError
        If no view has a neighbour, or no depths agree.
    """
    if not any(sweep.neighbours) and not _has_points(scene):
        raise DataError(
            f"a plane sweep of {scene.name} needs photographs whose viewing directions are {settings.min_angle:g} to "
            f"{MAX_ANGLE:g} degrees apart, got none; set dense_start.min_angle, or train with "
            "--set dense_start=null"
        )
    swept = _thinned((_swept(sweep, index) for index in range(len(sweep.views))), settings.cell)
    between = _between(sweep, swept, settings.cell, 0 if scene.ahead else cache_bytes(SWEEP_BYTES))
    parts: list[tuple[np.ndarray, ...]] = [
        (found.places, found.colors, found.normals, np.zeros(len(found.places))) for found in (swept, between)
    ]
    if scene.points is not None and _has_points(scene):
        parts.append(_apart(scene.points, swept, settings.cell))
    elif len(swept.places) < 2:
        raise DataError(
            f"a plane sweep of {scene.name} must find at least 2 points on which photographs agree, got "
            f"{len(swept.places)}; check that photographs and cameras match, or train with --set dense_start=null"
        )
    if not settings.fit:  # sparse points get their size from all neighbours, swept ones included
        parts = [(*part[:3], np.zeros(len(part[3]))) for part in parts]
    if around is not None:
        parts.append(around)
    places, colors, normals, sizes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    colors = np.clip(np.rint(colors * 255), 0, 255).astype(np.uint8)
    return PointCloud(places, colors, normals, sizes if (sizes > 0).any() else None)


def _has_points(scene: Scene) -> bool:
    return scene.points is not None and len(scene.points) > 0


@dataclass(frozen=True, eq=False)
class _Found:
    places: np.ndarray  # [M, 3] world units
    colors: np.ndarray  # [M, 3] in [0, 1]
    normals: np.ndarray  # [M, 3]
    pixel: np.ndarray  # [M] world units: the size of a pixel there
    score: np.ndarray  # [M]

    def rows(self, which: np.ndarray) -> _Found:
        """Return some of the points."""
        return _Found(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def _joined(found: Sequence[_Found]) -> _Found:
    return _Found(*(np.concatenate([getattr(f, name) for f in found]) for name in _Found.__dataclass_fields__))


def _thinned(found: Iterable[_Found], cell: float) -> _Found:
    """Thin the points of all views together, without having all of them in memory."""
    waiting: list[_Found] = []
    for some in found:
        waiting.append(some)
        if sum(len(one.score) for one in waiting) > max(WAITING, 2 * len(waiting[0].score)):
            waiting = [_thin(_joined(waiting), cell)]
    return _thin(_joined(waiting), cell)


def _thin(found: _Found, cell: float) -> _Found:
    """Keep the point with the best score in each cell of ``cell`` pixels; cell sizes are powers of two."""
    level = np.rint(np.log2(found.pixel * cell))
    keys = np.concatenate([np.floor(found.places / np.exp2(level)[:, None]), level[:, None]], axis=1)
    order = np.argsort(-found.score, kind="stable")
    _, first = _unique_rows(keys[order])
    return found.rows(order[first])


def _unique_rows(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``np.unique(keys, axis=0, return_index=True)`` of integers [M, C], faster."""
    if not len(keys):
        return keys, np.zeros(0, dtype=np.int64)
    low = keys.min(axis=0)
    sizes = (keys.max(axis=0) - low + 1).astype(np.float64)
    if sizes.prod() >= 2.0**62:
        return np.unique(keys, axis=0, return_index=True)
    flat = np.ravel_multi_index(tuple((keys - low).astype(np.int64).T), tuple(sizes.astype(np.int64)))
    first = np.unique(flat, return_index=True)[1]
    return keys[first], first


def _swept(sweep: Sweep, index: int) -> _Found:
    """Return the points of a view on which enough neighbours agree."""
    return _found(sweep.views[index], sweep.depths[index], sweep.known(index), sweep.scores[index])


def _found(view: SmallView, depth: np.ndarray, kept: np.ndarray, score: np.ndarray) -> _Found:
    """Return the points of the pixels of a view that are ``kept`` [H, W]."""
    places = unproject(view, depth)
    normals = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    colors = view.color.permute(1, 2, 0).numpy()
    return _Found(places[kept], colors[kept], normals[kept], (depth / view.K[0, 0])[kept], score[kept])


def _between(sweep: Sweep, swept: _Found, cell: float, limit_bytes: int) -> _Found:
    """Return interpolated points where no swept ones are: neighbours agree on them, and none sees through them.

    Closed depth maps beyond ``limit_bytes`` are on the disk.
    """

    def closed(index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the closed depth map, negative where it is interpolated, and the pixels that may start a splat."""
        view, depth, known = sweep.views[index], sweep.depths[index], sweep.known(index)
        color = view.color.permute(1, 2, 0)
        wanted = enclosed(known) & view.usable & (flatness(color).numpy() > BARE)
        wanted &= distance_transform_edt(~known) >= MARGIN
        filled = closed_depth(depth, known, color.numpy(), view.usable) if wanted.any() else np.zeros_like(depth)
        return np.where(known, depth, -filled).astype(np.float32), wanted

    count, tree = len(sweep.views), cKDTree(swept.places)
    depths = Spilled(map(closed, range(count)), limit_bytes)

    def agreed(index: int) -> _Found:
        view, (signed, wanted) = sweep.views[index], depths[index]
        depth, kept = np.abs(signed).astype(np.float64), wanted & (signed < 0)
        places = unproject(view, depth)[kept]
        votes, seen_through = np.zeros(len(places), np.int64), np.zeros(len(places), bool)
        for other in sweep.neighbours[index]:
            z, column, row, inside = project(sweep.views[other], places)
            there = depths[other][0][row, column]
            votes += inside & (np.abs(np.abs(there) - z) <= CLOSED_AGREE * z)
            seen_through |= inside & (there > (1 + 2 * CLOSED_AGREE) * z)
        kept[kept] = (votes >= sweep.quorum(index)) & ~seen_through
        found = _found(view, depth, kept, np.zeros_like(depth))
        return found.rows(tree.query(found.places)[0] > cell * found.pixel)

    return _thinned(map(agreed, range(count)), CLOSED_CELL * cell)


def _apart(points: PointCloud, swept: _Found, cell: float) -> tuple[np.ndarray, ...]:
    """Return sparse points far from the swept ones: positions, colours in [0, 1], zero normals, sizes."""
    finite = np.logical_and.reduce(np.isfinite(points.points), axis=1)
    places = np.asarray(points.points, dtype=np.float64)[finite]
    colors = np.full((len(places), 3), 0.5) if points.colors is None else points.colors[finite] / 255.0
    sizes = nearest_distances(places) if len(places) > 1 else np.zeros(len(places))
    apart: np.ndarray = np.ones(len(places), dtype=bool)
    if len(swept.places):
        apart &= cKDTree(swept.places).query(places)[0] > REPEATED * cell * float(np.median(swept.pixel))
    return places[apart], colors[apart], np.zeros((int(apart.sum()), 3)), sizes[apart]
