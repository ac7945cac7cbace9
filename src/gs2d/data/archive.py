"""Captures in a ZIP file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from gs2d.core.atomic_files import disk_error
from gs2d.core.growth import check_entries, check_growth
from gs2d.core.missing import holds_photographs, suggestion
from gs2d.data.file_names import IMAGES
from gs2d.data.load import detect_format
from gs2d.errors import DataError

_JUNK = "__MACOSX"  # added by macOS
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, LookupError, struct.error, RuntimeError)
_ZIP = "cp437"  # encoding of names without the UTF-8 flag
_STATES_UTF8 = 0x800  # flag of an entry
#: Candidate encodings of other names, in order: Chinese, Japanese, Korean, traditional Chinese, Cyrillic (Windows,
#: DOS), Central and Western European (Windows, DOS)
_ENCODINGS = ("gb18030", "cp932", "cp949", "big5", "cp1251", "cp866", "cp1250", "cp1252", "cp852", "cp850", _ZIP)
_CAMERA_FILES = ("images.txt", "images.bin", ".json", ".xml", ".sfm")
_LOOKED_AT = 64 << 20  # bytes read from a camera file
_DEPTH = 3  # largest number of nested single folders above the capture


def is_archive(path: Path) -> bool:
    """Whether a path is a ZIP file, by its suffix."""
    return path.suffix.lower() == ".zip" and path.is_file()


def unpack(path: Path, home: Path) -> Path:
    """Unpack a ZIP file into the folder ``home`` and return the folder of the capture.

    The target is named by a hash of the archive, so that the same archive is unpacked only once. It appears only when
    it is complete.

    Raises
    ------
    DataError
        If the file is not a valid ZIP file, is encrypted or implausibly large, or contains no capture.
    DiskError
        If it cannot be unpacked.
    """
    try:
        with _opened(path) as file:
            infos = [info for info in check_entries(path, file.infolist()) if info.filename.partition("/")[0] != _JUNK]
            check_growth(path, path.stat().st_size, sum(info.file_size for info in infos), "a capture")
            for info in infos:
                info.filename = info.filename.replace("\\", "/")  # of Windows
            rows = sorted(f"{info.filename} {info.file_size} {info.CRC}" for info in infos)
            digest = hashlib.sha256("\n".join(rows).encode("utf-8", "backslashreplace")).hexdigest()[:16]
            target = home / digest
            if not target.exists():
                with tempfile.TemporaryDirectory(dir=home, prefix=".unpacking-") as hidden:
                    inside = Path(hidden, digest, path.stem.strip(". ") or "capture")
                    inside.mkdir(parents=True)
                    file.extractall(inside, infos)  # sanitises names; links become files
                    _move(Path(hidden, digest), target)
    except _BROKEN as error:
        raise DataError(f"{path} must be a complete ZIP file without password: {error}; pack it again") from error
    except OSError as error:
        raise disk_error(home, error) from error
    try:
        with named_by(path, target):
            return _capture_in(target)
    except DataError as error:
        if not holds_photographs(path):
            raise
        remedy = suggestion(path, "capture")
        raise DataError(f"{path} must contain cameras, got images without cameras{remedy}") from error


@contextlib.contextmanager
def unpacked_temporarily(path: Path) -> Iterator[Path]:
    """Unpack a ZIP file into a temporary folder; errors about its content name the archive.

    Raises
    ------
    DataError, DiskError
        As for :func:`unpack`.
    """
    with tempfile.TemporaryDirectory(prefix="gs2d-") as home:
        folder = unpack(path, Path(home))
        with named_by(path, folder):
            yield folder


@contextlib.contextmanager
def named_by(path: Path, folder: Path) -> Iterator[None]:
    """Replace the unpacked folder by the archive in error messages."""
    try:
        yield
    except DataError as error:
        raise type(error)(str(error).replace(str(folder), str(path))) from error


def _move(made: Path, target: Path) -> None:
    """Rename a folder; ignore that another process has created the same target."""
    try:
        os.replace(made, target)
    except OSError:
        if not target.is_dir():
            raise


def _opened(path: Path) -> zipfile.ZipFile:
    """Open an archive with names in UTF-8, else in the encoding from ``_encoding``."""
    try:
        return zipfile.ZipFile(path, metadata_encoding="utf-8")  # macOS does not set the flag
    except UnicodeDecodeError:
        with zipfile.ZipFile(path) as file:
            encoding = _encoding(path, file)
        return zipfile.ZipFile(path, metadata_encoding=encoding)


def _encoding(path: Path, file: zipfile.ZipFile) -> str:
    """Return the first encoding in which an image name occurs in a camera file, else ``_ZIP``.

    The ZIP format knows only UTF-8 and code page 437, but Windows uses the code page of its language.
    """
    infos = check_entries(path, file.infolist())
    names = [info.filename.encode(_ZIP) for info in infos if not info.flag_bits & _STATES_UTF8]
    photographs = [name for name in names if name.lower().endswith(tuple(map(str.encode, IMAGES)))]
    texts = []
    for info in infos:
        if info.filename.lower().endswith(_CAMERA_FILES):
            with file.open(info) as stream:
                texts.append(stream.read(_LOOKED_AT))
    for encoding in _ENCODINGS:
        with contextlib.suppress(UnicodeDecodeError):
            decoded = [name.decode(encoding) for name in photographs]
            parts = {part for name in decoded for part in os.path.splitext(name)[0].replace("\\", "/").split("/")}
            words = [part for part in parts if not part.isascii()]
            spellings = [word.encode() for word in words] + [json.dumps(word)[1:-1].encode() for word in words]
            if any(word in text for word in spellings for text in texts):
                return encoding
    return _ZIP


def _capture_in(folder: Path) -> Path:
    """Return the folder of the capture in an unpacked archive, below single folders."""
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
