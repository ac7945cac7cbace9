"""A capture packed as one ZIP file: unpacked where it is wanted, if it cannot write elsewhere or explode."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import struct
import tempfile
import unicodedata
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from gs2d.core.files import disk_error
from gs2d.core.growth import check_entries
from gs2d.core.missing import holds_photographs, instead
from gs2d.data.file_names import IMAGES
from gs2d.data.load import detect_format
from gs2d.errors import DataError

_JUNK = "__MACOSX"  # what macOS adds: a shadow of every file
_RATIO, _SMALL = 100, 1 << 30  # images are packed already: what grows a hundredfold to gigabytes is a trap
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, LookupError, struct.error, RuntimeError)  # a password
_ZIP = "cp437"  # of names, where an entry does not state UTF-8
_STATES_UTF8 = 0x800  # flag of an entry
#: encodings of names that are not UTF-8 and do not say what they are, in the order in which they are tried: Chinese,
#: Japanese, Korean, traditional Chinese, Cyrillic (Windows, DOS), Central and Western European (Windows, DOS)
_ENCODINGS = ("gb18030", "cp932", "cp949", "big5", "cp1251", "cp866", "cp1250", "cp1252", "cp852", "cp850", _ZIP)
_LOOKED_AT = 64 << 20  # bytes of a camera file
_SAMPLE = 32  # photographs whose names are looked for in it
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
    try:
        with named_by(path, target):
            return _capture_in(target)
    except DataError as error:
        if not holds_photographs(path):
            raise
        remedy = instead(path, "capture")
        raise DataError(f"{path} must hold cameras, got photographs without any{remedy}") from error


@contextlib.contextmanager
def unpacked_for_a_moment(path: Path) -> Iterator[Path]:
    """Unpack a ZIP file into a temporary folder; errors about what is in it name the archive.

    Raises
    ------
    DataError, DiskError
        As :func:`unpack`.
    """
    with tempfile.TemporaryDirectory(prefix="gs2d-") as home:
        folder = unpack(path, Path(home))
        with named_by(path, folder):
            yield folder


@contextlib.contextmanager
def named_by(path: Path, folder: Path) -> Iterator[None]:
    """Let errors about the folder that an archive was unpacked into name the archive: the folder may be gone."""
    try:
        yield
    except DataError as error:
        raise type(error)(str(error).replace(str(folder), str(path))) from error


def _move(made: Path, target: Path) -> None:
    """Put a folder in its place; another process that put the same there in the meantime was as good."""
    try:
        os.replace(made, target)
    except OSError:
        if not target.is_dir():
            raise


def _opened(path: Path) -> zipfile.ZipFile:
    """Open an archive with its names in UTF-8, else in the encoding that ``_encoding`` finds."""
    try:
        return zipfile.ZipFile(path, metadata_encoding="utf-8")  # which macOS writes without saying so
    except UnicodeDecodeError:
        with zipfile.ZipFile(path) as file:
            encoding = _encoding(path, file)
        return zipfile.ZipFile(path, metadata_encoding=encoding)


def _encoding(path: Path, file: zipfile.ZipFile) -> str:
    """Return the encoding in which most photographs have a name that the camera files mention.

    The ZIP format knows UTF-8 and code page 437 only, but Windows writes names in the code page of its language.

    Raises
    ------
    DataError
        The camera files mention none of the photographs in any encoding.
    """
    infos = check_entries(path, file.infolist())
    unstated = [info.filename.encode(_ZIP) for info in infos if not info.flag_bits & _STATES_UTF8]
    photographs = [info for info in infos if os.path.splitext(info.filename)[1].lower() in IMAGES]
    raw = [info.filename.encode(_ZIP) for info in photographs if not info.flag_bits & _STATES_UTF8]
    foreign = [name for name in raw if not name.isascii()]
    texts = [_text(file, info) for info in infos if _lists_photographs(info.filename)]
    sample = foreign[:: max(1, len(foreign) // _SAMPLE)]
    counts = {encoding: _mentioned(sample, encoding, texts) for encoding in _ENCODINGS if _decodes(unstated, encoding)}
    best = max(counts, key=lambda encoding: counts[encoding])  # the first of several
    if counts[best]:
        return best
    if texts and photographs and all(not os.path.basename(info.filename).isascii() for info in photographs):
        raise DataError(
            f"{path} must have names in UTF-8, got names such as {foreign[0]!r} in an encoding that it does not state: "
            f"in none of {', '.join(_ENCODINGS)} are they the photographs of its camera file; pack it again with names "
            "in UTF-8 (7-Zip: -mcu=on)"
        )
    return _ZIP


def _lists_photographs(name: str) -> bool:
    """Whether a file may be the camera file of a capture, by its name."""
    name = name.replace("\\", "/").rsplit("/", 1)[-1].lower()
    return name in ("images.txt", "images.bin") or name.endswith((".json", ".xml", ".sfm"))


def _text(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Return the first bytes of a file, with characters in place of the escapes of JSON."""
    with file.open(info) as stream:
        data = stream.read(_LOOKED_AT)
    if b"\\u" not in data:
        return data
    return re.sub(rb"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)).encode("utf-8", "replace"), data)


def _decodes(names: Sequence[bytes], encoding: str) -> bool:
    try:
        return all(name.decode(encoding) for name in names)
    except UnicodeDecodeError:
        return False


def _mentioned(names: Sequence[bytes], encoding: str, texts: Sequence[bytes]) -> int:
    """Count the names of which a part that is not ASCII, a folder or the file without its extension, is in a text."""
    count = 0
    for name in names:
        parts = os.path.splitext(name.decode(encoding).replace("\\", "/"))[0].split("/")
        foreign = [part for part in parts if not part.isascii()]
        words = [unicodedata.normalize(form, part).encode() for part in foreign for form in ("NFC", "NFD")]
        count += any(word in text for word in words for text in texts)
    return count


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
