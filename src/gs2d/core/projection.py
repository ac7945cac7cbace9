"""Latitude, longitude and height to metres: a local frame by formula, map projections by pyproj (extra ``geo``)."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.core.extras import required
from gs2d.errors import BackendError, DataError

# WGS 84: the equatorial radius, m, and the flattening.
_A, _F = 6378137.0, 1 / 298.257223563
_E2 = _F * (2 - _F)
WGS84 = 4326  # EPSG code of latitude and longitude


def to_ecef(geodetic: np.ndarray) -> np.ndarray:
    """Return latitudes and longitudes (degrees) and heights (m) [P, 3] as earth-centred metres [P, 3]."""
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    height = geodetic[:, 2]
    across = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    level = (across + height) * np.cos(latitude)
    return np.stack(
        [level * np.cos(longitude), level * np.sin(longitude), (across * (1 - _E2) + height) * np.sin(latitude)], axis=1
    )


def to_enu(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return places [P, 3] as metres east, north and up of an origin [3], all latitude, longitude, height."""
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    sin_lat, cos_lat, sin_lon, cos_lon = (
        *(math.sin(latitude), math.cos(latitude)),
        *(math.sin(longitude), math.cos(longitude)),
    )
    axes = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return np.asarray((to_ecef(geodetic) - to_ecef(origin[None])) @ axes.T)


def utm_epsg(latitude: float, longitude: float) -> int:
    """Return the EPSG code of the UTM zone of a place, with the exceptions of Norway and Svalbard.

    Raises
    ------
    DataError
        Beyond 84 degrees north or 80 south, where there is no UTM.
    """
    if not -80 <= latitude <= 84:
        raise DataError(f"UTM is defined from 80 degrees south to 84 north, got latitude {latitude:.4f}; use --enu")
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
    """Return the package pyproj.

    Raises
    ------
    BackendError
        It is not installed.
    """
    return required("geo", "pyproj", "a map projection", "use --enu, a local frame")


@dataclass(frozen=True)
class Projection:
    """A projected coordinate system in metres; heights pass through it as they are."""

    epsg: int

    def __post_init__(self) -> None:
        pyproj = required_pyproj()
        try:
            crs = pyproj.CRS.from_epsg(self.epsg)
        except pyproj.exceptions.CRSError as error:
            raise DataError(
                f"EPSG:{self.epsg} must be a coordinate system, the EPSG registry has none of that code"
            ) from error
        if not crs.is_projected:
            raise DataError(f"EPSG:{self.epsg} must be a projected system in metres, got {crs.name}; take the UTM zone")
        units = {axis.unit_conversion_factor for axis in crs.axis_info[:2]}
        if units != {1.0}:
            raise DataError(f"EPSG:{self.epsg} must be in metres, {crs.name} is in {crs.axis_info[0].unit_name}")

    def from_geodetic(self, geodetic: np.ndarray) -> np.ndarray:
        """Return latitude, longitude, height [P, 3] as east, north, height [P, 3].

        Raises
        ------
        DataError
            A place that this projection does not reach.
        """
        pyproj = required_pyproj()
        transform = pyproj.Transformer.from_crs(WGS84, self.epsg, always_xy=True)
        east, north = transform.transform(geodetic[:, 1], geodetic[:, 0])
        if not (np.isfinite(east).all() and np.isfinite(north).all()):
            raise DataError(f"EPSG:{self.epsg} must reach the places given, some lie beyond it; choose another --epsg")
        return np.stack([east, north, geodetic[:, 2]], axis=1)

    def to_geodetic(self, point: np.ndarray) -> np.ndarray:
        """Return a place east, north, height [3] as latitude, longitude, height [3]."""
        pyproj = required_pyproj()
        transform = pyproj.Transformer.from_crs(self.epsg, WGS84, always_xy=True)
        longitude, latitude = transform.transform(point[0], point[1])
        return np.array([latitude, longitude, point[2]])

    def grid_scale(self, geodetic: np.ndarray) -> float:
        """Return metres of the map for a metre on the ground, at a place: the mean of both directions."""
        pyproj = required_pyproj()
        factors = pyproj.Proj(self.epsg).get_factors(geodetic[1], geodetic[0])
        scale = math.sqrt(factors.meridional_scale * factors.parallel_scale)
        return scale if math.isfinite(scale) and scale > 0 else 1.0


def wkt_of(epsg: int | None) -> str | None:
    """Return a coordinate system as .prj files hold it; None without one, or without pyproj."""
    if epsg is None:
        return None
    try:
        pyproj = required_pyproj()
    except BackendError:
        return None  # what is left out is only one of several places where the code is said
    text: str = pyproj.CRS.from_epsg(epsg).to_wkt("WKT1_ESRI")
    return text


def named_crs(text: str) -> int | None:
    """Return the EPSG code that a line names as OpenDroneMap's files do; None: it names no coordinate system.

    Known are ``EPSG:32632``, ``WGS84 UTM 32N`` and PROJ strings (``+proj=utm +zone=32 ...``).

    Raises
    ------
    DataError
        A PROJ string without an EPSG code.
    """
    text = text.strip()
    if match := re.fullmatch(r"EPSG:\s*(\d{4,6})", text, re.IGNORECASE):
        return int(match[1])
    if match := re.fullmatch(r"WGS ?84 UTM (\d{1,2}) ?([NS])", text, re.IGNORECASE):
        return (32600 if match[2].upper() == "N" else 32700) + int(match[1])
    if text.startswith("+proj="):
        if re.search(r"\+proj=(latlong|longlat)\b", text):
            return WGS84
        pyproj = required_pyproj()
        try:
            code = pyproj.CRS.from_proj4(text).to_epsg(min_confidence=20)
        except pyproj.exceptions.CRSError:
            code = None
        if code is None:
            raise DataError(f"a coordinate system with an EPSG code was expected, got {text[:60]}; write EPSG:CODE")
        return int(code)
    return None
