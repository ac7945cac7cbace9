"""Control points: measured world positions, and their marks in photographs or positions in the run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from gs2d.contrib.survey.triangulate import triangulate
from gs2d.data import View
from gs2d.data.positions import WGS84, Table, read_table
from gs2d.errors import DataError

_ODM = ("x", "y", "z", "u", "v", "photo", "name")  # columns of gcp_list.txt
_TRUE = ("1", "yes", "true", "check", "y", "x")
DOUBTFUL_PIXELS = 5.0  # reprojection error from which a mark is reported


@dataclass
class ControlPoint:
    """A named point: world position, and marks in photographs or position in the run."""

    name: str
    world: np.ndarray
    check: bool = False
    marks: dict[str, tuple[float, float]] = field(default_factory=dict)
    run: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Control points of a file; ``in_degrees``: latitude, longitude and height."""

    points: tuple[ControlPoint, ...]
    epsg: int | None
    in_degrees: bool


@dataclass(frozen=True, eq=False)
class Located:
    """Control points located in the run: ``source`` [P, 3]; ``pixels`` [P], rms reprojection error or NaN."""

    names: tuple[str, ...]
    source: np.ndarray
    world: np.ndarray
    check: np.ndarray
    pixels: np.ndarray
    doubts: tuple[str, ...]


def read_control(path: Path) -> ControlPoints:
    """Read control points from CSV or OpenDroneMap's ``gcp_list.txt`` (columns: docs/guides/georeference.md)."""
    table = read_table(path, _ODM, ("name",))
    in_degrees = {"lat", "lon"} <= set(table.columns) or table.epsg == WGS84
    world = ("lat", "lon", "height") if "lat" in table.columns else ("y", "x", "z") if in_degrees else ("x", "y", "z")
    if not set(world) <= set(table.columns):
        raise DataError(f"{path} must have the columns {', '.join(world)}, got {', '.join(table.columns)}")
    points: dict[str, ControlPoint] = {}
    for line, row in table.rows:
        _add(table, line, row, world, points)
    return ControlPoints(tuple(points.values()), None if in_degrees else table.epsg, in_degrees)


def _add(
    table: Table, line: int, row: Mapping[str, str], world: tuple[str, ...], points: dict[str, ControlPoint]
) -> None:
    """Add a row: a control point in an image, or its position in the run."""
    where = f"{table.path}, line {line}"
    place = np.array([table.number(line, row, column) for column in world])
    name = row.get("name", "").strip() or "point at " + " ".join(f"{value:.10g}" for value in place)
    point = points.setdefault(name, ControlPoint(name, place))
    if not np.allclose(point.world, place, rtol=0, atol=1e-9 * max(1.0, float(np.abs(place).max()))):
        raise DataError(f"{where}: {name} has another world position above; use one name per point")
    point.check = point.check or row.get("check", "").strip().lower() in _TRUE
    if table.has(row, "photo", "u", "v"):
        photo = row["photo"].strip()
        if photo in point.marks:
            raise DataError(f"{where}: {name} is already marked in {photo}; keep one of the marks")
        point.marks[photo] = (table.number(line, row, "u"), table.number(line, row, "v"))
    elif table.has(row, "run_x", "run_y", "run_z"):
        point.run = np.array([table.number(line, row, f"run_{axis}") for axis in "xyz"])
    else:
        raise DataError(f"{where}: photo, u, v (pixels) or run_x, run_y, run_z were expected for {name}, got neither")


def locate(points: Sequence[ControlPoint], views: Sequence[View], held_out: Sequence[str] = ()) -> Located:
    """Locate control points in the run by triangulating their marks.

    ``held_out`` names additional check points. Raises DataError if a photograph is missing, a point has too few marks,
    or a check point is unknown.
    """
    if unknown := [name for name in held_out if name not in {point.name for point in points}]:
        raise DataError(
            f"check_points must name control points, got {unknown[0]}; use one of "
            f"{', '.join(point.name for point in points[:8])}"
        )
    by_name = {view.name: view for view in views}
    files = Counter(PurePosixPath(name).name for name in by_name)
    by_file = {PurePosixPath(name).name: view for name, view in by_name.items()}
    source, pixels, doubts = [], [], []
    for point in points:
        if point.run is not None:
            source.append(point.run)
            pixels.append(math.nan)
            continue
        marked = []
        for photo in point.marks:
            view = by_name.get(photo) or (by_file.get(photo) if files[photo] == 1 else None)
            if view is None:
                many = f"{files[photo]} photographs of" if files[photo] else "no photograph of"
                raise DataError(f"{point.name} is marked in {photo}: the run has {many} that name")
            marked.append(view)
        result = triangulate(marked, np.array(list(point.marks.values())), point.name)
        source.append(result.point)
        pixels.append(float(np.sqrt(np.mean(result.pixels**2))))
        if result.pixels.max() > DOUBTFUL_PIXELS:
            photo = list(point.marks)[int(result.pixels.argmax())]
            doubts.append(f"{point.name} is {result.pixels.max():.1f} px from its mark in {photo}: check that mark")
    return Located(
        tuple(point.name for point in points),
        np.array(source),
        np.array([point.world for point in points]),
        np.array([point.check or point.name in held_out for point in points]),
        np.array(pixels),
        tuple(doubts),
    )
