"""EXIF metadata, including damaged blocks."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import ExifTags, Image

from gs2d.data.exif import Metadata, read_metadata


def write(path: Path, *, gps: dict[int, object] | None = None, time: str = "", part: str = "") -> Path:
    exif = Image.Exif()
    if gps is not None:
        exif[ExifTags.IFD.GPSInfo] = gps
    if time:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = time
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.SubsecTimeOriginal] = part
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    return path


def gps(latitude: float, longitude: float, *, height: float | None = None) -> dict[int, object]:
    tags = ExifTags.GPS
    entries: dict[int, object] = {
        **{tags.GPSLatitudeRef: "S" if latitude < 0 else "N", tags.GPSLatitude: (abs(latitude), 0.0, 0.0)},
        **{tags.GPSLongitudeRef: "W" if longitude < 0 else "E", tags.GPSLongitude: (abs(longitude), 0.0, 0.0)},
    }
    if height is not None:
        entries |= {tags.GPSAltitudeRef: b"\1" if height < 0 else b"\0", tags.GPSAltitude: abs(height)}
    return entries


def test_the_position_has_signs_and_an_optional_height(tmp_path: Path) -> None:
    assert read_metadata(write(tmp_path / "a.jpg", gps=gps(-46.5, 91.25, height=-1.5))).place == (-46.5, 91.25, -1.5)
    latitude, longitude, height = read_metadata(write(tmp_path / "b.jpg", gps=gps(46.5, -91.25))).place or (0, 0, 0)
    assert (latitude, longitude) == (46.5, -91.25)
    assert math.isnan(height)


@pytest.mark.parametrize("place", [None, gps(141.0, 8.0), gps(0.0, 0.0)], ids=["none", "no latitude", "no fix"])
def test_an_invalid_position_is_ignored(tmp_path: Path, place: dict[int, object] | None) -> None:
    assert read_metadata(write(tmp_path / "a.jpg", gps=place)).place is None


@pytest.mark.parametrize("time", ["0000:00:00 00:00:00", "yesterday", "2026:13:01 10:00:59"])
def test_the_time_of_an_unset_clock_is_ignored(tmp_path: Path, time: str) -> None:
    assert read_metadata(write(tmp_path / "a.jpg", time=time)) == Metadata()
