"""EXIF metadata of an image: position, time, orientation and camera; XMP marks panoramas.

Damaged metadata is ignored.
"""

from __future__ import annotations

import datetime
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from gs2d.data.image_files import open_image

#: Exceptions of Pillow for a damaged EXIF block.
DAMAGED_EXIF = (
    *(OSError, SyntaxError, ValueError, KeyError, TypeError, ZeroDivisionError, AttributeError, OverflowError),
    struct.error,
)
_UPRIGHT = 1
_ORIENTATIONS = range(1, 9)


@dataclass(frozen=True)
class Metadata:
    """Metadata of a photograph."""

    orientation: int = _UPRIGHT  # EXIF, 1 (upright) to 8
    camera_tags: tuple[str, ...] = ("",) * 5  # make, model, lens and focal lengths as in EXIF; empty strings if missing
    # Latitude and longitude (degrees, WGS 84) and height (m); a missing height is NaN.
    place: tuple[float, float, float] | None = None
    seconds: float | None = None  # time of the camera clock, without time zone
    panorama: str = ""  # "whole" or "part" of an equirectangular 360-degree panorama (XMP GPano), or empty


def read_metadata(path: Path) -> Metadata:
    """Read the metadata of an image; defaults if it is damaged."""
    base = ExifTags.Base
    try:
        with open_image(path) as file:
            exif, xmp = file.getexif(), _xmp(file)
            details: dict[int, Any] = exif.get_ifd(ExifTags.IFD.Exif)
            orientation = exif.get(base.Orientation, _UPRIGHT)
            tags = [exif.get(base.Make), exif.get(base.Model)]
            tags += [details.get(tag) for tag in (base.LensModel, base.FocalLength, base.FocalLengthIn35mmFilm)]
            camera_tags = tuple("" if tag is None else str(tag).strip("\0 ") for tag in tags)
            place, seconds, panorama = _place(exif), _seconds(exif, details), _panorama(xmp)
    except DAMAGED_EXIF:
        return Metadata()
    return Metadata(orientation if orientation in _ORIENTATIONS else _UPRIGHT, camera_tags, place, seconds, panorama)


def _xmp(file: Image.Image) -> str:
    """Return the XMP block as text; values are searched by name, without an XML parser."""
    block = file.info.get("xmp") or file.info.get("XML:com.adobe.xmp") or b""
    return block.decode("utf-8", "replace") if isinstance(block, bytes) else str(block)


def _panorama(xmp: str) -> str:
    """Return "whole", "part" or "" by Google's Photo Sphere XMP, as 360-degree cameras and stitchers write it."""
    if _xmp_value(xmp, "ProjectionType").lower() != "equirectangular":
        return ""
    sides = [
        (_xmp_value(xmp, f"CroppedAreaImage{side}Pixels"), _xmp_value(xmp, f"FullPano{side}Pixels"))
        for side in ("Width", "Height")
    ]
    return "part" if any(shown != whole for shown, whole in sides if shown and whole) else "whole"


# -- position ----------------------------------------------------------------------------------------------------------
def _place(exif: Image.Exif) -> tuple[float, float, float] | None:
    gps = ExifTags.GPS
    try:
        tags: Mapping[int, Any] = exif.get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(tags[gps.GPSLatitude], tags.get(gps.GPSLatitudeRef, "N"), "S")
        longitude = _degrees(tags[gps.GPSLongitude], tags.get(gps.GPSLongitudeRef, "E"), "W")
        height = float(tags[gps.GPSAltitude]) if gps.GPSAltitude in tags else math.nan
        if tags.get(gps.GPSAltitudeRef, b"\0") in (b"\1", 1):
            height = -height
    except DAMAGED_EXIF:
        return None
    return _valid_position(latitude, longitude, height)


def _degrees(parts: Sequence[Any], side: Any, negative: str) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    value = degrees + minutes / 60 + seconds / 3600
    letter = side.decode("ascii", "replace") if isinstance(side, bytes) else str(side)
    return -value if letter.strip("\0 ").upper() == negative else value


def _xmp_value(xmp: str, name: str) -> str:
    """Return the value of a name with any prefix in XMP, as attribute or element; "" without it."""
    match = re.search(rf"[\w-]+:{name}\s*(?:=\s*[\"']([^\"'<>]*)[\"']|>([^<]*)<)", xmp)
    return (match[1] or match[2] or "").strip() if match else ""


def _valid_position(latitude: float, longitude: float, height: float) -> tuple[float, float, float] | None:
    """Return the position, or None if it is invalid: receivers without a fix write zeros."""
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or (latitude == 0 and longitude == 0):
        return None
    return latitude, longitude, height if math.isfinite(height) else math.nan


# -- time --------------------------------------------------------------------------------------------------------------
def _seconds(exif: Image.Exif, details: Mapping[int, Any]) -> float | None:
    base = ExifTags.Base
    text = details.get(base.DateTimeOriginal) or details.get(base.DateTimeDigitized) or exif.get(base.DateTime)
    part = details.get(base.SubsecTimeOriginal) or details.get(base.SubsecTime) or ""
    try:
        time = datetime.datetime.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S")
        whole = time.replace(tzinfo=datetime.UTC).timestamp()
    except DAMAGED_EXIF:
        return None
    digits = str(part).strip("\0 ")
    return whole + (float(f"0.{digits}") if re.fullmatch("[0-9]{1,9}", digits) else 0.0)
