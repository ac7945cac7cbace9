"""Where photographs were taken, by their files or by a list, in metres of a frame of the world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from gs2d.core.projection import WGS84, Projection, to_enu, utm_epsg
from gs2d.data.csv_tables import read_table
from gs2d.errors import DataError


@dataclass(frozen=True, eq=False)
class Positions:
    """Places by the name of the photograph.

    Attributes
    ----------
    places : mapping of str to ndarray [3]
        Latitude, longitude (degrees, WGS 84), height (m), or east, north, height in metres; a height that nobody
        knows is NaN.
    epsg : int or None
        None: see ``in_degrees``.
    source : str
        In words.
    in_degrees : bool
        False: in metres, of ``epsg``, or of a system that the file does not name.
    """

    places: Mapping[str, np.ndarray]
    epsg: int | None
    source: str
    in_degrees: bool


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The frame that places are told in.

    Attributes
    ----------
    epsg : int or None
        None: east, north, up of ``geodetic``, or the frame that the places were given in.
    origin : ndarray [3]
        Where local coordinates begin, in this frame: whole metres.
    geodetic : ndarray [3] or None
        The same as latitude, longitude, height.
    grid_scale : float
    """

    epsg: int | None
    origin: np.ndarray
    geodetic: np.ndarray | None
    grid_scale: float


def read_positions(path: Path) -> Positions:
    """Read a file of positions: CSV (``name,lat,lon,height`` or ``name,x,y,z``), or OpenDroneMap's ``geo.txt``."""
    table = read_table(path, ("name", "x", "y", "z"), ("name",))
    in_degrees = {"lat", "lon"} <= set(table.columns) or table.epsg == WGS84
    names = ("lat", "lon", "height") if "lat" in table.columns else ("y", "x", "z") if in_degrees else ("x", "y", "z")
    if not set(names[:2]) <= set(table.columns):
        raise DataError(f"{path} must have the columns name, lat, lon, height, or name, x, y, z; got {table.columns}")
    places: dict[str, np.ndarray] = {}
    for line, row in table.rows:
        name = row["name"].strip()
        if not name:
            raise DataError(f"{path}, line {line}: the name of a photograph was expected, got nothing")
        if name in places:
            raise DataError(f"{path}, line {line}: {name} has a position already; keep one of them")
        height = table.number(line, row, names[2]) if table.has(row, names[2]) else math.nan
        places[name] = np.array([table.number(line, row, names[0]), table.number(line, row, names[1]), height])
        if in_degrees and not (abs(places[name][0]) <= 90 and abs(places[name][1]) <= 180):
            raise DataError(
                f"{path}, line {line}: latitude and longitude in degrees were expected, got {places[name][0]:g} and "
                f"{places[name][1]:g}; are they in the other order, or in metres (then name their --epsg)?"
            )
    return Positions(places, None if in_degrees else table.epsg, f"positions in {path.name}", in_degrees)


def matched(positions: Positions, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the places of photographs: by the whole name, else by the file's name, else by its stem.

    Raises
    ------
    DataError
        A name that fits several photographs.
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
            those = by_key.get(key(name), [])
            if len(those) > 1 and not any(one in found for one in those):
                raise DataError(
                    f"{name} must name one photograph, got {len(those)} of that name ({', '.join(sorted(those)[:2])}); "
                    "write their folders too"
                )
            if len(those) == 1:
                found.setdefault(those[0], place)
        if found:
            break
    return found


def in_frame(places: np.ndarray, epsg: int | None, *, wanted: int | None, enu: bool) -> tuple[np.ndarray, WorldFrame]:
    """Return places [P, 3] less the frame's origin, metres, and the frame.

    Parameters
    ----------
    epsg : int or None
        What the places are in; None: latitude, longitude, height.
    wanted : int or None
        The projected system that is asked for; None: the UTM zone of the places, or the system that they are in.
    enu : bool
        East, north and up of their middle instead; only of latitude and longitude.
    """
    height = np.nanmedian(places[:, 2]) if np.isfinite(places[:, 2]).any() else 0.0
    middle = np.array([*np.median(places[:, :2], axis=0), height])
    if epsg is None and enu:
        known = np.where(np.isnan(places), middle, places)
        local = to_enu(known, middle)
        local[np.isnan(places[:, 2]), 2] = math.nan
        return local, WorldFrame(None, np.zeros(3), middle, 1.0)
    if enu:
        raise DataError(f"--enu needs latitudes and longitudes, got places in EPSG:{epsg}; leave --enu out")
    if epsg is not None and wanted not in (None, epsg):
        raise DataError(f"the places are in EPSG:{epsg}, --epsg asks for {wanted}; leave --epsg out")
    projection = Projection(epsg or wanted or utm_epsg(middle[0], middle[1]))
    world = projection.from_geodetic(places) if epsg is None else places
    middle = projection.from_geodetic(middle[None])[0] if epsg is None else middle
    origin = np.round(middle)
    geodetic = projection.to_geodetic(origin)
    return world - origin, WorldFrame(projection.epsg, origin, geodetic, projection.grid_scale(geodetic))
