"""Map projections by pyproj (extra ``geo``), and the frame of positions in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.core.extras import required
from gs2d.data.positions import WGS84, to_enu
from gs2d.errors import BackendError, DataError


@dataclass(frozen=True, eq=False)
class MapFrame:
    """The coordinate system of positions."""

    epsg: int | None  # None: east, north, up of ``geodetic``, or an unnamed system
    origin: np.ndarray  # [3] of local coordinates in this system, in whole metres
    geodetic: np.ndarray | None  # [3] the origin as latitude, longitude, height
    grid_scale: float  # map metres per metre on the ground


def utm_epsg(latitude: float, longitude: float) -> int:
    """Return the EPSG code of the UTM zone, including the exceptions for Norway and Svalbard.

    Raises DataError beyond 84 degrees north or 80 degrees south, where UTM is undefined.
    """
    if not -80 <= latitude <= 84:
        raise DataError(
            f"UTM is defined from 80 degrees south to 84 north, got latitude {latitude:.4f}; use --set enu=true"
        )
    longitude = (longitude + 180) % 360 - 180
    zone = int((longitude + 180) // 6) + 1
    if 56 <= latitude < 64 and 3 <= longitude < 12:
        zone = 32
    if latitude >= 72:
        for begin, end, number in ((0, 9, 31), (9, 21, 33), (21, 33, 35), (33, 42, 37)):
            if begin <= longitude < end:
                zone = number
    return (32600 if latitude >= 0 else 32700) + zone


def required_pyproj() -> Any:
    """Return the package pyproj, or raise BackendError if it is not installed."""
    return required("geo", "pyproj", "a map projection", "use --set enu=true, a local frame")


@dataclass(frozen=True)
class Projection:
    """A projected coordinate system in metres. Heights are passed through unchanged."""

    epsg: int

    def __post_init__(self) -> None:
        pyproj = required_pyproj()
        try:
            crs = pyproj.CRS.from_epsg(self.epsg)
        except pyproj.exceptions.CRSError as error:
            raise DataError(f"EPSG:{self.epsg} is not in the EPSG registry; use another code") from error
        if not crs.is_projected:
            raise DataError(f"EPSG:{self.epsg} must be a projected system in metres, got {crs.name}; use the UTM zone")
        units = {axis.unit_conversion_factor for axis in crs.axis_info[:2]}
        if units != {1.0}:
            raise DataError(f"EPSG:{self.epsg} must be in metres, {crs.name} is in {crs.axis_info[0].unit_name}")

    def from_geodetic(self, geodetic: np.ndarray) -> np.ndarray:
        """Convert latitude, longitude, height [P, 3] to east, north, height [P, 3]; DataError outside the domain."""
        pyproj = required_pyproj()
        transform = pyproj.Transformer.from_crs(WGS84, self.epsg, always_xy=True)
        east, north = transform.transform(geodetic[:, 1], geodetic[:, 0])
        if not (np.isfinite(east).all() and np.isfinite(north).all()):
            raise DataError(f"EPSG:{self.epsg} does not cover all positions; choose another --epsg")
        return np.stack([east, north, geodetic[:, 2]], axis=1)

    def to_geodetic(self, point: np.ndarray) -> np.ndarray:
        """Convert east, north, height [3] to latitude, longitude, height [3]."""
        pyproj = required_pyproj()
        transform = pyproj.Transformer.from_crs(self.epsg, WGS84, always_xy=True)
        longitude, latitude = transform.transform(point[0], point[1])
        return np.array([latitude, longitude, point[2]])

    def grid_scale(self, geodetic: np.ndarray) -> float:
        """Return map metres per metre on the ground at a position: the geometric mean of both directions."""
        pyproj = required_pyproj()
        factors = pyproj.Proj(self.epsg).get_factors(geodetic[1], geodetic[0])
        scale = math.sqrt(factors.meridional_scale * factors.parallel_scale)
        return scale if math.isfinite(scale) and scale > 0 else 1.0


def in_frame(
    positions: np.ndarray, epsg: int | None, *, requested: int | None, enu: bool
) -> tuple[np.ndarray, MapFrame]:
    """Return positions [P, 3] relative to the origin of a frame, in metres, and the frame.

    ``epsg`` is the coordinate system of the positions; None: latitude, longitude, height. ``requested`` is the
    projected system to use; None: that of the positions, or their UTM zone. ``enu`` uses east, north and up of the
    median instead, for latitudes and longitudes only.
    """
    height = np.nanmedian(positions[:, 2]) if np.isfinite(positions[:, 2]).any() else 0.0
    middle = np.array([*np.median(positions[:, :2], axis=0), height])
    if epsg is None and enu:
        return to_enu(positions, middle), MapFrame(None, np.zeros(3), middle, 1.0)
    if enu:
        raise DataError(f"--set enu needs latitudes and longitudes, got positions in EPSG:{epsg}; leave it out")
    if epsg is not None and requested not in (None, epsg):
        raise DataError(f"the positions are in EPSG:{epsg}, --epsg requests {requested}; leave --epsg out")
    projection = Projection(epsg or requested or utm_epsg(middle[0], middle[1]))
    world = projection.from_geodetic(positions) if epsg is None else positions
    middle = projection.from_geodetic(middle[None])[0] if epsg is None else middle
    origin = np.round(middle)
    geodetic = projection.to_geodetic(origin)
    return world - origin, MapFrame(projection.epsg, origin, geodetic, projection.grid_scale(geodetic))


def wkt_of(epsg: int | None) -> str | None:
    """Return a coordinate system as text for a .prj file; None without a code or without pyproj."""
    if epsg is None:
        return None
    try:
        pyproj = required_pyproj()
    except BackendError:
        return None  # the sidecar .georeference.json has the code
    text: str = pyproj.CRS.from_epsg(epsg).to_wkt("WKT1_ESRI")
    return text
