"""Points to start from: swept ones, ones in the gaps between them, and sparse ones elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from gs2d.config.recipe import MAX_ANGLE, DenseStart
from gs2d.core.transforms import nearest_distances
from gs2d.data.scene import PointCloud, Scene
from gs2d.errors import DataError
from gs2d.kernels.library import library_for
from gs2d.training.start.closing import gap_points
from gs2d.training.start.plane_sweep import Sweep, unproject

WAITING = 500_000  # points that are collected before they are thinned
LEAST_SWEPT = 8  # points, below which gaps are not closed
GAP_CELL = 2.0  # cells of swept points: those in gaps are sparser, since they have no detail
NEIGHBOURS, REACH, TURNS = 48, 3.3, 3  # of a point, and the distance in cells of the farthest, that its plane fits
LEAST_ON_PLANE = 8  # neighbours
FLAT, WIDE = 0.2, 0.1  # ratios of variances: across a plane at most, along it at least; a wire is not wide
ROWS_AT_ONCE = 1 << 14
REPEATED = 3.0  # cells: nearer to a swept point, a sparse point starts no splat of its own


def start_points(
    scene: Scene, sweep: Sweep, settings: DenseStart, around: tuple[np.ndarray, ...] | None = None
) -> PointCloud:
    """Return points to start from: swept ones, ones in gaps, and sparse ones that are far from the swept ones.

    For a fitted start, sparse points keep the size that they have among all sparse points (:attr:`PointCloud.sizes`).
    ``around`` are further points with sizes: positions, colours in [0, 1], normals [P, 3], sizes [P]. Raises DataError
    if no view has a neighbour, or no depths agree.
    """
    if not any(sweep.neighbours) and not _has_points(scene):
        raise DataError(
            f"a plane sweep of {scene.name} needs images whose viewing directions are {settings.min_angle:g} to "
            f"{MAX_ANGLE:g} degrees apart, got none; set dense_start.min_angle, or train with "
            "--set dense_start=null"
        )
    swept = _thinned((_swept(sweep, index) for index in range(len(sweep.views))), settings.cell)
    swept = levelled(swept, settings.cell)
    between = _between(sweep, swept, settings.cell)
    parts: list[tuple[np.ndarray, ...]] = [
        (points.places, points.colors, points.normals, np.zeros(len(points.places))) for points in (swept, between)
    ]
    if scene.points is not None and _has_points(scene):
        parts.append(_apart(scene.points, swept, settings.cell))
    elif len(swept.places) < 2:
        raise DataError(
            f"a plane sweep of {scene.name} must find at least 2 points on which images agree, got "
            f"{len(swept.places)}; check that images and cameras match, or train with --set dense_start=null"
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
class StartPoints:
    """Points that start splats."""

    places: np.ndarray  # [M, 3] world units
    colors: np.ndarray  # [M, 3] in [0, 1]
    normals: np.ndarray  # [M, 3]
    pixel: np.ndarray  # [M] world units: the size of a pixel there
    score: np.ndarray  # [M]

    def rows(self, which: np.ndarray) -> StartPoints:
        """Return some of the points."""
        return StartPoints(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def _joined(points: Sequence[StartPoints]) -> StartPoints:
    return StartPoints(
        *(np.concatenate([getattr(f, name) for f in points]) for name in StartPoints.__dataclass_fields__)
    )


def _thinned(points: Iterable[StartPoints], cell: float) -> StartPoints:
    """Thin the points of all views together, without having all of them in memory."""
    waiting: list[StartPoints] = []
    for some in points:
        waiting.append(some)
        if sum(len(one.score) for one in waiting) > max(WAITING, 2 * len(waiting[0].score)):
            waiting = [_thin(_joined(waiting), cell)]
    return _thin(_joined(waiting), cell)


def _thin(points: StartPoints, cell: float) -> StartPoints:
    """Keep the point with the best score in each cell of ``cell`` pixels; cell sizes are powers of two."""
    level = np.rint(np.log2(points.pixel * cell))
    keys = np.concatenate([np.floor(points.places / np.exp2(level)[:, None]), level[:, None]], axis=1)
    order = np.argsort(-points.score, kind="stable")
    _, first = _unique_rows(keys[order])
    return points.rows(order[first])


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


def _swept(sweep: Sweep, index: int) -> StartPoints:
    """Return the points of a view on which enough neighbours agree."""
    view, depth, valid = sweep.views[index], sweep.depths[index], sweep.consistent(index)
    places = unproject(view, depth)
    normals = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    colors, score = view.color.permute(1, 2, 0).numpy(), sweep.scores[index]
    return StartPoints(places[valid], colors[valid], normals[valid], (depth / view.K[0, 0])[valid], score[valid])


def _between(sweep: Sweep, swept: StartPoints, cell: float) -> StartPoints:
    """Return points in the gaps between swept ones; none without the native library, which cuts tetrahedra."""
    library = library_for(sweep.views[0].grey)
    if library is None or len(swept.places) < LEAST_SWEPT:
        return swept.rows(np.zeros(0, np.int64))
    places, colors, normals, pixel = gap_points(sweep, swept.places, swept.pixel, cell, library)
    points = StartPoints(places, colors, normals, pixel, np.zeros(len(places)))
    return _thin(points.rows(cKDTree(swept.places).query(places)[0] > cell * pixel), GAP_CELL * cell)


def levelled(points: StartPoints, cell: float) -> StartPoints:
    """Move points onto the planes that their neighbours lie on, and give them the normals of these planes.

    Weights fall with the distance from the point and, in three turns, with that from the plane. Points whose neighbours
    do not lie on a plane stay.
    """
    places, normals = points.places.copy(), points.normals.copy()
    if len(places) < NEIGHBOURS:
        return points
    tree = cKDTree(points.places)
    for rows in np.array_split(np.arange(len(places)), len(places) // ROWS_AT_ONCE + 1):
        distance, near = tree.query(points.places[rows], k=NEIGHBOURS)
        reach = REACH * cell * points.pixel[rows, None]
        weight = np.maximum(1 - (distance / reach) ** 2, 0) ** 2
        for _ in range(TURNS):
            total = np.maximum(weight.sum(axis=1), 1e-12)
            middle = np.einsum("nk,nka->na", weight, points.places[near]) / total[:, None]
            arms = points.places[near] - middle[:, None]
            spread, axes = np.linalg.eigh(np.einsum("nk,nka,nkb->nab", weight, arms, arms) / total[:, None, None])
            normal = axes[:, :, 0]
            off = np.einsum("nka,na->nk", arms, normal) / (3 * np.sqrt(np.maximum(spread[:, :1], 1e-30)))
            weight = weight * np.maximum(1 - off**2, 0) ** 2
        flat = (spread[:, 0] < FLAT * spread[:, 1]) & (spread[:, 1] > WIDE * spread[:, 2])
        flat &= (weight > 0).sum(axis=1) >= LEAST_ON_PLANE
        rows, normal = rows[flat], normal[flat]
        height = np.einsum("na,na->n", points.places[rows] - middle[flat], normal)
        places[rows] -= height[:, None] * normal
        normals[rows] = normal
    return replace(points, places=places, normals=normals)


def _apart(points: PointCloud, swept: StartPoints, cell: float) -> tuple[np.ndarray, ...]:
    """Return sparse points far from the swept ones: positions, colours in [0, 1], zero normals, sizes."""
    finite = np.logical_and.reduce(np.isfinite(points.points), axis=1)
    places = np.asarray(points.points, dtype=np.float64)[finite]
    colors = np.full((len(places), 3), 0.5) if points.colors is None else points.colors[finite] / 255.0
    sizes = nearest_distances(places) if len(places) > 1 else np.zeros(len(places))
    apart: np.ndarray = np.ones(len(places), dtype=bool)
    if len(swept.places):
        apart &= cKDTree(swept.places).query(places)[0] > REPEATED * cell * float(np.median(swept.pixel))
    return places[apart], colors[apart], np.zeros((int(apart.sum()), 3)), sizes[apart]
