"""Camera positions from a file, matched to image names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from gs2d.data.csv_tables import WGS84, read_table
from gs2d.errors import DataError

_RADIUS, _FLATTENING = 6378137.0, 1 / 298.257223563  # of WGS 84: equatorial, m
_E2 = _FLATTENING * (2 - _FLATTENING)


@dataclass(frozen=True, eq=False)
class Positions:
    """Camera positions by image name."""

    # [3] by name: latitude, longitude (degrees, WGS 84), height (m); or east, north, height in metres. Unknown heights
    # are NaN.
    places: Mapping[str, np.ndarray]
    epsg: int | None  # coordinate system, if it is projected and named in the file
    source: str  # description for messages
    in_degrees: bool  # whether positions are latitudes and longitudes


def read_positions(path: Path) -> Positions:
    """Read positions from CSV (``name,lat,lon,height`` or ``name,x,y,z``) or OpenDroneMap's ``geo.txt``."""
    table = read_table(path, ("name", "x", "y", "z"), ("name",))
    in_degrees = {"lat", "lon"} <= set(table.columns) or table.epsg == WGS84
    names = ("lat", "lon", "height") if "lat" in table.columns else ("y", "x", "z") if in_degrees else ("x", "y", "z")
    if not set(names[:2]) <= set(table.columns):
        raise DataError(f"{path} must have the columns name, lat, lon, height, or name, x, y, z; got {table.columns}")
    places: dict[str, np.ndarray] = {}
    for line, row in table.rows:
        name = row["name"].strip()
        if not name:
            raise DataError(f"{path}, line {line}: the name of an image was expected, got nothing")
        if name in places:
            raise DataError(f"{path}, line {line}: {name} already has a position; keep one of them")
        height = table.number(line, row, names[2]) if table.has(row, names[2]) else math.nan
        places[name] = np.array([table.number(line, row, names[0]), table.number(line, row, names[1]), height])
        if in_degrees and not (abs(places[name][0]) <= 90 and abs(places[name][1]) <= 180):
            raise DataError(
                f"{path}, line {line}: latitude and longitude in degrees were expected, got {places[name][0]:g} and "
                f"{places[name][1]:g}; are they swapped, or in metres (then set --epsg)?"
            )
    return Positions(places, None if in_degrees else table.epsg, f"positions in {path.name}", in_degrees)


def matched(positions: Positions, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the position of each image that has one.

    Names are compared whole, then without suffix, then without folders, then as bare stems. Raises DataError if a
    listed name fits several images.
    """
    found: dict[str, np.ndarray] = {}
    for key in (
        str,
        lambda name: str(PurePosixPath(name).with_suffix("")),
        lambda name: PurePosixPath(name).name,
        lambda name: PurePosixPath(name).stem,
    ):
        by_key: dict[str, list[str]] = {}
        for name in names:
            by_key.setdefault(key(name), []).append(name)
        for name, place in positions.places.items():
            candidates = by_key.get(key(name), [])
            if len(candidates) > 1 and not any(one in found for one in candidates):
                raise DataError(
                    f"{name} must name one image, got {len(candidates)} of that name "
                    f"({', '.join(sorted(candidates)[:2])}); include their folders"
                )
            if len(candidates) == 1:
                found.setdefault(candidates[0], place)
        if found:
            break
    return found


def to_enu(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Convert latitude, longitude, height [P, 3] to metres east, north and up of an origin [3].

    An unknown height (NaN) stays NaN.
    """
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    axes = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    local = (_to_ecef(np.where(np.isnan(geodetic), origin, geodetic)) - _to_ecef(origin[None])) @ axes.T
    local[np.isnan(geodetic[:, 2]), 2] = math.nan
    return np.asarray(local)


def _to_ecef(geodetic: np.ndarray) -> np.ndarray:
    """Convert latitude, longitude, height [P, 3] to earth-centred metres [P, 3]."""
    latitude, longitude, height = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1]), geodetic[:, 2]
    across = _RADIUS / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    level = (across + height) * np.cos(latitude)
    return np.stack(
        [level * np.cos(longitude), level * np.sin(longitude), (across * (1 - _E2) + height) * np.sin(latitude)], axis=1
    )
