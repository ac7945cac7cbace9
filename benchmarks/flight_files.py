"""Write files of a synthetic flight: EXIF metadata and a COLMAP model with tracks."""

from __future__ import annotations

import datetime
import math
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from scipy.spatial.transform import Rotation

from gs2d.core.atomic_files import atomic_write
from gs2d.core.camera import Camera

_AXIS, _FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS 84: semi-major axis in m, and flattening
_PINHOLE = 1  # COLMAP's camera model id
_BEGIN = datetime.datetime(2026, 5, 4, 10, 0, 0)
_SECONDS = 2  # between photographs


def flight_exif(place: np.ndarray, origin: tuple[float, float, float], number: int, angle: float) -> Image.Exif:
    """Return EXIF data with GPS position, time and focal length.

    Parameters
    ----------
    place : ndarray [3], m
        East, north and up from the origin.
    origin : latitude, longitude (degrees, WGS 84), height (m)
    number : int
        Index of the photograph; sets its time.
    angle : float, radians
        Horizontal field of view.
    """
    latitude, longitude, height = geodetic(place, origin)
    time = (_BEGIN + datetime.timedelta(seconds=_SECONDS * number)).strftime("%Y:%m:%d %H:%M:%S")
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "gs2d", "flown"
    exif[ExifTags.Base.DateTime] = time
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    photo[ExifTags.Base.DateTimeOriginal] = time
    photo[ExifTags.Base.FocalLengthIn35mmFilm] = round(18 / math.tan(angle / 2))
    gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
    gps[ExifTags.GPS.GPSLatitudeRef] = "N" if latitude >= 0 else "S"
    gps[ExifTags.GPS.GPSLatitude] = _sexagesimal(abs(latitude))
    gps[ExifTags.GPS.GPSLongitudeRef] = "E" if longitude >= 0 else "W"
    gps[ExifTags.GPS.GPSLongitude] = _sexagesimal(abs(longitude))
    gps[ExifTags.GPS.GPSAltitudeRef] = b"\0"
    gps[ExifTags.GPS.GPSAltitude] = IFDRational(round(height * 1000), 1000)
    return exif


def geodetic(place: np.ndarray, origin: tuple[float, float, float]) -> tuple[float, float, float]:
    """Convert east, north and up [3] in metres from an origin to latitude, longitude (degrees) and height (m).

    Uses the ellipsoid radii at the origin and a flat ground: accurate to centimetres within a kilometre.
    """
    phi = math.radians(origin[0])
    e2 = _FLATTENING * (2 - _FLATTENING)
    across = _AXIS / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    along = across * (1 - e2) / (1 - e2 * math.sin(phi) ** 2)
    east, north, up = map(float, place)
    longitude = origin[1] + math.degrees(east / ((across + origin[2]) * math.cos(phi)))
    return origin[0] + math.degrees(north / (along + origin[2])), longitude, origin[2] + up


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Return degrees, minutes and seconds; seconds in steps of 10^-5, about a third of a millimetre."""
    ticks = round(degrees * 3600e5)
    whole, rest = divmod(ticks, 3600 * 10**5)
    minutes, seconds = divmod(rest, 60 * 10**5)
    return IFDRational(whole, 1), IFDRational(minutes, 1), IFDRational(seconds, 10**5)


def write_model(
    folder: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    points: np.ndarray,
    colors: np.ndarray,
    tracks: Sequence[tuple[np.ndarray, np.ndarray]],
    *,
    least: int,
) -> None:
    """Write a binary COLMAP model with one shared pinhole camera; ``cameras.bin`` is written last.

    Parameters
    ----------
    folder : path
    cameras, names
        One per photograph.
    points : ndarray [P, 3], colors : ndarray uint8 [P, 3]
    tracks : one per photograph: (indices [n] of visible points, pixel positions [n, 2])
    least : int
        Minimum number of photographs per point; other points are removed from the model and the photographs.
    """
    counts = np.bincount(np.concatenate([numbers for numbers, _ in tracks]), minlength=len(points))
    identity = np.where(counts >= least, np.cumsum(counts >= least), 0)  # COLMAP ids start at 1; 0 = removed
    track_of, place_of = [], []
    with atomic_write(folder / "images.bin") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for k, (camera, name, (numbers, pixels)) in enumerate(zip(cameras, names, tracks, strict=True), start=1):
            kept = identity[numbers] > 0
            rows = np.zeros(int(kept.sum()), dtype=[("xy", "<f8", 2), ("id", "<i8")])
            rows["xy"], rows["id"] = pixels[kept], identity[numbers[kept]]
            x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
            file.write(
                struct.pack("<I7dI", k, w, x, y, z, *camera.T_cam_world[:3, 3], 1)
                + name.encode()
                + b"\0"
                + struct.pack("<Q", len(rows))
            )
            file.write(rows.tobytes())
            track_of.append(rows["id"])
            place_of.append(np.stack([np.full(len(rows), k), np.arange(len(rows))], axis=1))
    owner, elements = np.concatenate(track_of), np.concatenate(place_of).astype("<u4")
    elements = elements[np.argsort(owner, kind="stable")]
    starts = np.concatenate([[0], np.cumsum(counts[counts >= least])])
    with atomic_write(folder / "points3D.bin") as file:
        file.write(struct.pack("<Q", len(starts) - 1))
        for k, number in enumerate(np.flatnonzero(counts >= least)):
            track = elements[starts[k] : starts[k + 1]]
            file.write(struct.pack("<Q3d3Bd", k + 1, *points[number], *colors[number].tolist(), 0.3))
            file.write(struct.pack("<Q", len(track)) + track.tobytes())
    first = cameras[0]
    with atomic_write(folder / "cameras.bin") as file:
        file.write(struct.pack("<Q", 1) + struct.pack("<IiQQ", 1, _PINHOLE, first.width, first.height))
        file.write(struct.pack("<4d", first.fx, first.fy, first.cx, first.cy))
