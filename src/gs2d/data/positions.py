"""Camera positions and other tables of names and numbers: CSV with a header, and OpenDroneMap's text files."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from gs2d.core.json_files import read_bytes
from gs2d.errors import DataError

WGS84 = 4326  # EPSG code of latitude and longitude
_LARGEST = 64 << 20  # bytes


@dataclass(frozen=True)
class Table:
    """Rows of a file."""

    path: Path
    epsg: int | None  # coordinate system that the file names
    rows: tuple[tuple[int, Mapping[str, str]], ...]
    columns: tuple[str, ...]

    def number(self, line: int, row: Mapping[str, str], column: str) -> float:
        """Return the number in a column of a row."""
        text = row.get(column, "").strip()
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and abs(value) < 1e12):
            raise DataError(f"{self.path}, line {line}: a number was expected for {column}, got {text[:40]!r}")
        return value

    def has(self, row: Mapping[str, str], *columns: str) -> bool:
        """Whether none of these columns is empty in a row."""
        return all(row.get(column, "").strip() for column in columns)


def read_table(path: Path, plain: Sequence[str], required: Sequence[str]) -> Table:
    """Read a CSV file with a header, or OpenDroneMap's rows below the name of a coordinate system.

    ``plain``: columns of OpenDroneMap's layout, in order; further columns are ignored. ``required``: columns that a CSV
    file must have.
    """
    lines = _lines(path)
    first = next((line for line in lines if line[1] and not line[1].startswith("#")), None)
    if first is None:
        raise DataError(f"{path} must hold a table, got an empty file")
    if (epsg := _named_crs(first[1])) is not None:
        words = [(number, text.split()) for number, text in lines if number > first[0] and text and text[0] != "#"]
        rows = tuple((number, dict(zip(plain, row, strict=False))) for number, row in words)
        if not rows:
            raise DataError(f"{path} must hold one row per item below its coordinate system, got none")
        return Table(path, epsg, rows, tuple(plain))
    codes = (_named_crs(text.lstrip("# ")) for _, text in lines if text.startswith("#"))
    return _read_csv(path, lines, next((code for code in codes if code is not None), None), required)


def _named_crs(text: str) -> int | None:
    """Return the EPSG code in a line such as ``EPSG:32632``, ``WGS84 UTM 32N`` or ``+proj=utm +zone=32``, or None.

    Raises DataError for any other PROJ string.
    """
    text = text.strip()
    if match := re.fullmatch(r"EPSG:\s*(\d{4,6})", text, re.IGNORECASE):
        return int(match[1])
    if match := re.fullmatch(r"WGS ?84 UTM (\d{1,2}) ?([NS])", text, re.IGNORECASE):
        return (32600 if match[2].upper() == "N" else 32700) + int(match[1])
    if not text.startswith("+proj="):
        return None
    if re.search(r"\+proj=(latlong|longlat)\b", text):
        return WGS84
    if (match := re.search(r"\+proj=utm\b.*\+zone=(\d{1,2})\b", text)) and "+ellps=GRS80" not in text:
        return (32700 if "+south" in text else 32600) + int(match[1])
    raise DataError(f"a coordinate system with an EPSG code was expected, got {text[:60]}; write EPSG:CODE")


def _lines(path: Path) -> list[tuple[int, str]]:
    if path.is_file() and path.stat().st_size > _LARGEST:
        raise DataError(f"{path} must be a table of names and numbers, got a file of {path.stat().st_size:,} bytes")
    data = read_bytes(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} must be UTF-8 text, got an invalid byte at offset {error.start}") from error
    return [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]


def _read_csv(path: Path, lines: Sequence[tuple[int, str]], epsg: int | None, required: Sequence[str]) -> Table:
    content = [(number, text) for number, text in lines if text and not text.startswith("#")]
    number, head = content[0]
    delimiter = max(",;\t", key=head.count)
    columns = [name.strip().lower() for name in _split(path, number, head, delimiter)]
    if missing := [name for name in required if name not in columns]:
        raise DataError(
            f"{path}, line {number}: a header with the columns {', '.join(required)} was expected (or OpenDroneMap's "
            f"layout, which begins with EPSG:CODE), {', '.join(missing)} is missing in {head[:60]!r}"
        )
    rows = []
    for number, text in content[1:]:  # line by line, so that an unclosed quote ends with its line
        words = _split(path, number, text, delimiter)
        if len(words) > len(columns):
            raise DataError(f"{path}, line {number}: {len(columns)} values were expected, got {len(words)}")
        rows.append((number, dict(zip(columns, words, strict=False))))
    if not rows:
        raise DataError(f"{path} must hold rows below its header, got none")
    return Table(path, epsg, tuple(rows), tuple(columns))


def _split(path: Path, number: int, text: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([text], delimiter=delimiter))
    except csv.Error as error:  # a field larger than 128 KiB
        raise DataError(f"{path}, line {number}: values separated by {delimiter!r} were expected: {error}") from error


# -- positions of cameras ----------------------------------------------------------------------------------------------
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
    places: dict[str, np.ndarray] = {}
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
            if len(candidates) > 1 and not any(one in places for one in candidates):
                raise DataError(
                    f"{name} must name one image, got {len(candidates)} of that name "
                    f"({', '.join(sorted(candidates)[:2])}); include their folders"
                )
            if len(candidates) == 1:
                places.setdefault(candidates[0], place)
        if places:
            break
    return places


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
