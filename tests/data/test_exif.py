"""EXIF and XMP metadata, including damaged blocks."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import ExifTags, Image

from gs2d.data.exif import Taken, read_place, read_taken

DJI = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:AbsoluteAltitude="+198.31" '
    'drone-dji:RelativeAltitude="+39.80" drone-dji:{latitude}="+46.84260708" drone-dji:{longitude}="-91.99455989"/>'
    "</x:xmpmeta>"
)
SENSEFLY = (
    "<x:xmpmeta><rdf:Description><sensefly:AltitudeAMSL>313.9</sensefly:AltitudeAMSL>"
    "<sensefly:AltitudeWGS84>281.6</sensefly:AltitudeWGS84><sensefly:Latitude>41.034671</sensefly:Latitude>"
    "<sensefly:Longitude>-83.305725</sensefly:Longitude></rdf:Description></x:xmpmeta>"
)
STANDARD = (
    '<x:xmpmeta><rdf:Description exif:GPSLatitude="46,50.5564S" exif:GPSLongitude="91,59,40E" '
    'exif:GPSAltitude="3/2" exif:GPSAltitudeRef="1"/></x:xmpmeta>'
)


def write(path: Path, *, xmp: str = "", gps: dict[int, object] | None = None, time: str = "", part: str = "") -> Path:
    exif = Image.Exif()
    if gps is not None:
        exif[ExifTags.IFD.GPSInfo] = gps
    if time:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = time
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.SubsecTimeOriginal] = part
    Image.new("RGB", (8, 8)).save(path, exif=exif, **({"xmp": xmp.encode()} if xmp else {}))
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


@pytest.mark.parametrize(
    ("xmp", "expected"),
    [
        (DJI.format(latitude="GpsLatitude", longitude="GpsLongitude"), (46.84260708, -91.99455989, 198.31)),
        (DJI.format(latitude="GpsLatitude", longitude="GpsLongtitude"), (46.84260708, -91.99455989, 198.31)),
        (DJI.format(latitude="Latitude", longitude="Longitude"), (46.84260708, -91.99455989, 198.31)),
        (SENSEFLY, (41.034671, -83.305725, 281.6)),
        (STANDARD, (-(46 + 50.5564 / 60), 91 + 59 / 60 + 40 / 3600, -1.5)),
    ],
    ids=["dji", "dji's own spelling", "dji, older", "sensefly", "standard"],
)
def test_the_position_is_read_from_xmp_if_exif_has_none(
    tmp_path: Path, xmp: str, expected: tuple[float, float, float]
) -> None:
    place = read_taken(write(tmp_path / "a.jpg", xmp=xmp)).place
    assert place == pytest.approx(expected)


@pytest.mark.parametrize(
    "xmp",
    [
        "",
        "not XML at all <<<",
        DJI.format(latitude="GpsLatitude", longitude="Nothing"),
        SENSEFLY.replace("41.034671", "north"),
        SENSEFLY.replace("41.034671", "141.0"),
        SENSEFLY.replace("41.034671", "0").replace("-83.305725", "0.0"),
    ],
    ids=["none", "no XML", "one alone", "a word", "no latitude", "no fix"],
)
def test_an_invalid_position_is_ignored(tmp_path: Path, xmp: str) -> None:
    assert read_taken(write(tmp_path / "a.jpg", xmp=xmp)).place is None
    assert read_place(tmp_path / "a.jpg") is None


@pytest.mark.parametrize("time", ["0000:00:00 00:00:00", "yesterday", "2026:13:01 10:00:59"])
def test_the_time_of_an_unset_clock_is_ignored(tmp_path: Path, time: str) -> None:
    assert read_taken(write(tmp_path / "a.jpg", time=time)) == Taken()
