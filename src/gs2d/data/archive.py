"""A capture packed as one ZIP file: what is in it, and unpacking that cannot write elsewhere, halve or explode."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from gs2d.core.files import disk_error
from gs2d.data.load import detect_format
from gs2d.errors import DataError, DiskError

_JUNK = {"__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"}  # what file managers add
_UTF8, _ENCRYPTED = 0x800, 0x1  # flags of an entry
_RATIO, _SMALL = 100, 1 << 30  # photographs are packed already: what grows a hundredfold to gigabytes is a trap
_SPARE = 256 << 20  # bytes of the disk that unpacking leaves free
_DEPTH = 3  # folders with nothing but a folder in them, above the capture
_LONGEST = 1 << 16  # entries of more bytes are copied in such pieces


@dataclass(frozen=True)
class Entry:
    """One file of an archive: its place below the folder that it is unpacked into."""

    path: PurePosixPath
    info: zipfile.ZipInfo


@dataclass(frozen=True)
class Archive:
    """A ZIP file whose table of contents is sound.

    Attributes
    ----------
    path : Path
    entries : tuple of Entry
    """

    path: Path
    entries: tuple[Entry, ...]

    @property
    def folder(self) -> str:
        """The folder that all of it is unpacked into, which is what the scene is called: its own, else its name."""
        tops = {entry.path.parts[0] for entry in self.entries}
        if len(tops) == 1 and all(len(entry.path.parts) > 1 for entry in self.entries):
            return ""
        return self.path.stem.strip(". ") or "capture"

    @property
    def digest(self) -> str:
        """16 hexadecimal digits of the names, sizes and checksums in it: the same for the same contents."""
        rows = sorted(f"{e.path} {e.info.file_size} {e.info.CRC}" for e in self.entries)
        return hashlib.sha256("\n".join(rows).encode("utf-8", "backslashreplace")).hexdigest()[:16]


def is_archive(path: Path) -> bool:
    """Whether a path is a ZIP file, by its ending."""
    return path.suffix.lower() == ".zip" and path.is_file()


def read_archive(path: Path) -> Archive:
    """The contents of a ZIP file; nothing is unpacked.

    Names may be Windows's (backslashes) and macOS's (UTF-8 without saying so); what file managers add is left out.

    Raises
    ------
    DataError
        No ZIP file, empty, encrypted, or with entries that lead out of it, are links, are there twice or grow beyond
        reason.
    """
    try:
        with zipfile.ZipFile(path) as file:
            infos = file.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise DataError(f"{path} must be a ZIP file, got: {error}; was it copied whole?") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    entries = [Entry(_place(path, info), info) for info in infos if not _is_folder(info)]
    entries = [entry for entry in entries if not _JUNK & set(entry.path.parts)]
    if not entries:
        raise DataError(f"{path} must hold a capture, got an empty archive")
    files = [entry.path for entry in entries]
    folders = {folder for file in files for folder in file.parents}
    twice = next((file for file in files if file in folders), None) or _first_twice(files)
    if twice is not None:
        raise DataError(f"{path} must hold each file once, got {twice} more than once; pack it again")
    size, packed = sum(entry.info.file_size for entry in entries), max(path.stat().st_size, 1)
    if size > _SMALL and size > _RATIO * packed:
        raise DataError(
            f"{path} must hold a capture, got {packed / 1e6:.1f} MB that unpack to {size / 1e9:.0f} GB; "
            "unpack it yourself if it is to be so"
        )
    return Archive(path, tuple(entries))


def _is_folder(info: zipfile.ZipInfo) -> bool:
    return info.filename.endswith(("/", "\\")) and not info.file_size


def _first_twice(files: list[PurePosixPath]) -> PurePosixPath | None:
    seen: set[PurePosixPath] = set()
    for file in files:
        if file in seen:
            return file
        seen.add(file)
    return None


def _place(path: Path, info: zipfile.ZipInfo) -> PurePosixPath:
    """Where an entry goes below the folder; every part of its name is a plain name."""
    name = info.filename
    if not info.flag_bits & _UTF8:  # then it says CP437; macOS writes UTF-8 all the same
        try:
            name = name.encode("cp437").decode("utf-8")
        except (UnicodeDecodeError, UnicodeEncodeError):
            name = info.filename
    parts = name.replace("\\", "/").split("/")
    if info.flag_bits & _ENCRYPTED:
        raise DataError(f"{path} must not be encrypted, got a password on {name}; unpack it yourself")
    if stat.S_ISLNK(info.external_attr >> 16):
        raise DataError(f"{path} must hold files, got the link {name}; pack it without links")
    clean = [part for part in parts if part not in ("", ".")]
    outside = name.startswith(("/", "\\")) or any(part == ".." or ":" in part or "\0" in part for part in clean)
    if outside or not clean:
        raise DataError(f"{path} must hold names below it, got {name!r}, which leads elsewhere; do not trust it")
    return PurePosixPath(*clean)


def unpack(archive: Archive, target: Path, on_progress: Callable[[int], None] = lambda _: None) -> None:
    """Unpack into the folder ``target``, which then holds one folder and appears when all is there, or not at all.

    Parameters
    ----------
    target : Path
        New; its parent exists.
    on_progress : callable
        Gets the number of files that are done.

    Raises
    ------
    DataError
        Damaged contents; names the file.
    DiskError
        Not enough space, or no permission.
    """
    hidden = target.with_name(f".{target.name}.unpacking")
    size = sum(entry.info.file_size for entry in archive.entries)
    try:
        shutil.rmtree(hidden, ignore_errors=True)  # of one that was killed
        if shutil.disk_usage(target.parent).free < size + _SPARE:
            raise DiskError(
                f"cannot unpack {archive.path} into {target.parent}: {size / 1e9:.1f} GB are needed; free some "
                "space or choose another folder"
            )
        hidden.mkdir()
        with zipfile.ZipFile(archive.path) as file:
            for done, entry in enumerate(archive.entries, start=1):
                _write(archive, file, entry, hidden / archive.folder / entry.path)
                on_progress(done)
        os.replace(hidden, target)
    except OSError as error:
        raise disk_error(target, error) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def _write(archive: Archive, file: zipfile.ZipFile, entry: Entry, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with file.open(entry.info) as source, open(path, "xb") as target:
            shutil.copyfileobj(source, target, _LONGEST)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{archive.path}: {entry.path} does not unpack: {error}; copy or pack it again") from error


def capture_root(folder: Path) -> Path:
    """The folder of the capture in an unpacked archive: the only folder in it, or the only one in that.

    Raises
    ------
    DataError
        No known layout; that of the innermost.
    """
    root = folder
    for _ in range(_DEPTH + 1):
        try:
            detect_format(root)
            return root
        except DataError as error:
            inner = [entry for entry in root.iterdir() if not entry.name.startswith(".")]
            if len(inner) != 1 or not inner[0].is_dir():
                raise error
            root = inner[0]
    detect_format(root)
    return root
