"""Tables of names and numbers: CSV with a header, and OpenDroneMap's text files."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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
    try:
        if path.stat().st_size > _LARGEST:
            raise DataError(f"{path} must be a table of names and numbers, got a file of {path.stat().st_size:,} bytes")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} must be UTF-8 text, got an invalid byte at offset {error.start}") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    return [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]


def _read_csv(path: Path, lines: Sequence[tuple[int, str]], epsg: int | None, required: Sequence[str]) -> Table:
    kept = [(number, text) for number, text in lines if text and not text.startswith("#")]
    number, head = kept[0]
    delimiter = max(",;\t", key=head.count)
    columns = [name.strip().lower() for name in _split(path, number, head, delimiter)]
    if missing := [name for name in required if name not in columns]:
        raise DataError(
            f"{path}, line {number}: a header with the columns {', '.join(required)} was expected (or OpenDroneMap's "
            f"layout, which begins with EPSG:CODE), {', '.join(missing)} is missing in {head[:60]!r}"
        )
    rows = []
    for number, text in kept[1:]:  # line by line, so that an unclosed quote ends with its line
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
