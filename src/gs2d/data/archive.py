"""A capture packed as one ZIP file: unpacked where it is wanted, if it cannot write elsewhere or explode."""

from __future__ import annotations

import hashlib
import os
import stat
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path

from gs2d.core.files import disk_error
from gs2d.core.growth import check_entries
from gs2d.data.load import detect_format
from gs2d.errors import DataError

_JUNK = "__MACOSX"  # what macOS adds: a shadow of every file
_RATIO, _SMALL = 100, 1 << 30  # images are packed already: what grows a hundredfold to gigabytes is a trap
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, LookupError, struct.error, RuntimeError)  # a password
_DEPTH = 3  # folders with nothing but a folder in them, above the capture


def is_archive(path: Path) -> bool:
    """Whether a path is a ZIP file, by its ending."""
    return path.suffix.lower() == ".zip" and path.is_file()


def unpack(path: Path, home: Path) -> Path:
    """Unpack a ZIP file into the folder ``home`` and return the capture's folder in it.

    What is unpacked has the name of its contents: an archive that is there already, under whatever name it came, is
    not unpacked again. It appears when all is there, or not at all.

    Raises
    ------
    DataError
        No ZIP file, damaged, encrypted, without a capture, or with entries that lead out of it, are links or grow
        beyond reason.
    DiskError
    """
    try:
        with _opened(path) as file:
            infos = [info for info in check_entries(path, file.infolist()) if info.filename.partition("/")[0] != _JUNK]
            _check(path, infos)
            rows = sorted(f"{info.filename} {info.file_size} {info.CRC}" for info in infos)
            digest = hashlib.sha256("\n".join(rows).encode("utf-8", "backslashreplace")).hexdigest()[:16]
            target = home / digest
            if not target.exists():
                with tempfile.TemporaryDirectory(dir=home, prefix=".unpacking-") as hidden:
                    inside = Path(hidden, digest, path.stem.strip(". ") or "capture")
                    inside.mkdir(parents=True)
                    file.extractall(inside, infos)
                    _move(Path(hidden, digest), target)
    except _BROKEN as error:
        raise DataError(f"{path} must be a whole ZIP file without a password, got: {error}; pack it again") from error
    except OSError as error:
        raise disk_error(home, error) from error
    return _capture_in(target)


def _move(made: Path, target: Path) -> None:
    """Put a folder in its place; another process that put the same there in the meantime was as good."""
    try:
        os.replace(made, target)
    except OSError:
        if not target.is_dir():
            raise


def _opened(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path, metadata_encoding="utf-8")  # which macOS writes without saying so
    except UnicodeDecodeError:
        return zipfile.ZipFile(path)


def _check(path: Path, infos: list[zipfile.ZipInfo]) -> None:
    """Raise for entries that lead elsewhere, are links, or grow beyond reason; Windows's backslashes become slashes."""
    for info in infos:
        info.filename = info.filename.replace("\\", "/")
        if info.filename.startswith("/") or ":" in info.filename or ".." in info.filename.split("/"):
            raise DataError(
                f"{path} must hold names below it, got {info.filename!r}, which leads elsewhere; do not trust it"
            )
        if stat.S_ISLNK(info.external_attr >> 16):
            raise DataError(f"{path} must hold files, got the link {info.filename}; pack it without links")
    size, packed = sum(info.file_size for info in infos), path.stat().st_size
    if size > _SMALL and size > _RATIO * packed:
        raise DataError(
            f"{path} must hold a capture, got {packed / 1e6:.1f} MB that unpack to {size / 1e9:.0f} GB; "
            "unpack it yourself if it is to be so"
        )


def _capture_in(folder: Path) -> Path:
    """Find the capture's folder in an unpacked archive: the only folder in it, or the only one in that."""
    for _ in range(_DEPTH):
        try:
            detect_format(folder)
            return folder
        except DataError:
            inner = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
            if len(inner) != 1 or not inner[0].is_dir():
                raise
            folder = inner[0]
    detect_format(folder)
    return folder
