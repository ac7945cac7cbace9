"""Atomic file writes: a file is either the old one or the complete new one.

A killed process leaves ``.NAME.gs2d.tmp`` beside NAME, without its lock. The next write of NAME and :func:`sweep`
remove it; locked temporary files of running processes are never touched.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from gs2d.core.locks import try_lock
from gs2d.errors import DiskError

_TEMPORARY = re.compile(r"\..+\.gs2d\.tmp", re.DOTALL)
_LONGEST = 200  # bytes of the file name kept in the temporary name
_ATTEMPTS = 100  # to find a free temporary name
_ESCAPED = "backslashreplace"  # surrogates of file names become \udcff, which JSON reads back
_REMEDIES = {
    errno.ENOSPC: "free some space or choose another folder",
    errno.EDQUOT: "free some of your quota or choose another folder",
    errno.EFBIG: "raise the file-size limit (ulimit -f)",
    errno.EACCES: "choose a writable folder",
    errno.EPERM: "choose a writable folder",
    errno.EROFS: "choose a writable folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.ENOENT: "the folder does not exist: create it first",
    errno.EISDIR: "a folder has this name: remove it or choose another name",
    errno.EIO: "the disk reports a fault",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def disk_error(path: str | os.PathLike[str], error: OSError) -> DiskError:
    """Return a DiskError for a failed write of ``path``."""
    remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
    return DiskError(f"cannot write {os.fspath(path)}: {error.strerror or error}; {remedy}", error.errno)


def is_full(error: BaseException) -> bool:
    """Whether an error means a full disk, a quota or a file-size limit."""
    return isinstance(error, DiskError | OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class _RecordingFile(io.FileIO):
    """A raw file that records its write error, because libraries (torch.save) may replace it."""

    failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        try:
            return int(super().write(data) or 0)
        except OSError as error:
            self.failure = error
            raise


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    r"""Open a file for writing that gets its name only when it is complete.

    Data is written to a hidden temporary file in the same folder, which must exist, synchronised to disk (fsync) and
    renamed. If writing fails, the temporary file is removed, an existing file stays unchanged, and DiskError is raised.
    ``mode`` is "wb" for bytes, or "w" for text in UTF-8 with ``\n`` line ends.
    """
    if mode not in ("wb", "w"):
        raise ValueError(f"mode must be 'wb' or 'w', got {mode!r}")
    target = Path(path)
    with temporary_beside(target) as (temporary, descriptor):
        raw = _RecordingFile(os.dup(descriptor), "wb")
        try:
            buffer = io.BufferedWriter(raw, 1 << 20)
            file: IO[Any] = io.TextIOWrapper(buffer, "utf-8", _ESCAPED, newline="\n") if mode == "w" else buffer
            try:
                yield file
                file.flush()
            finally:
                with contextlib.suppress(OSError):  # a failed flush is already being raised
                    file.close()
                raw.close()
        except BaseException as error:
            failure = raw.failure
            if failure is None and isinstance(error, OSError) and error.errno in _REMEDIES:
                # Only errors of this write: an OSError about another file passes unchanged.
                named = error.filename
                failure = error if named is None or Path(os.fsdecode(named)) in (temporary, target) else None
            if failure is not None:
                raise disk_error(target, failure) from error
            raise


@contextlib.contextmanager
def temporary_beside(target: Path) -> Iterator[tuple[Path, int]]:
    """Create a temporary file beside ``target`` that is renamed to it at the end, or removed if the body fails.

    Yields its path, which other programs may write to but not replace, and a writable descriptor. The file is
    synchronised to disk (fsync) before it is renamed.
    """
    try:
        temporary, descriptor = _claimed(target)
    except OSError as error:
        raise disk_error(target, error) from error
    try:
        yield temporary, descriptor
        try:
            os.fsync(descriptor)
            if sys.platform == "win32":  # cannot rename open files
                os.close(descriptor)
                descriptor = -1
            os.replace(temporary, target)
        except OSError as error:
            raise disk_error(target, error) from error
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    finally:  # the lock is held until the file is renamed or removed
        if descriptor >= 0:
            os.close(descriptor)
    _sync_folder(target.parent)


def _claimed(target: Path) -> tuple[Path, int]:
    """Create and lock a temporary file; removes one that a killed process left."""
    name = target.name
    while len(os.fsencode(name)) > _LONGEST:
        name = name[:-1]
    temporary = target.with_name(f".{name}.gs2d.tmp")
    for _ in range(_ATTEMPTS):
        try:
            # 0o666: the umask applies, as for any other file (mkstemp would make it private).
            flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
            descriptor = os.open(temporary, flags, 0o666)
        except FileExistsError:
            if not _removed(temporary):  # another process writes the same file; the last one wins
                temporary = target.with_name(f".{name}.{secrets.token_hex(4)}.gs2d.tmp")
            continue
        if _is_ours(temporary, descriptor):
            return temporary, descriptor
        os.close(descriptor)  # swept by another process before it was locked
    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(temporary))


def _is_ours(temporary: Path, descriptor: int) -> bool:
    """Lock a new file; False if another process has swept it."""
    if sys.platform == "win32":  # cannot delete open files
        return True
    try:
        if not try_lock(descriptor):
            return False
        return os.path.samestat(os.stat(temporary), os.fstat(descriptor))
    except FileNotFoundError:
        return False
    except OSError:  # a file system without locks; nothing is swept there
        return True


def _removed(temporary: Path) -> bool:
    """Remove a temporary file unless it is being written."""
    try:
        if sys.platform == "win32":
            os.unlink(temporary)
            return True
        descriptor = os.open(temporary, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            if not try_lock(descriptor):
                return False
            os.unlink(temporary)
        finally:
            os.close(descriptor)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return True


def is_temporary(name: str) -> bool:
    """Whether a file name is that of a temporary file."""
    return _TEMPORARY.fullmatch(name) is not None


def sweep(folder: Path) -> int:
    """Remove temporary files of killed processes in a folder; returns their number. Never raises OSError."""
    swept = 0
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in list(entries):
            if is_temporary(entry.name) and entry.is_file(follow_symlinks=False):
                swept += _removed(Path(entry.path))
    return swept


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise DiskError early if ``atomic_write`` would fail: missing folder, no permission, path is a folder."""
    target = Path(path)
    try:
        # Not Path.is_dir: since Python 3.14 it returns False for errors such as a name that is too long.
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISDIR(target.stat().st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise disk_error(target, error) from error


def _sync_folder(folder: Path) -> None:
    """Make the rename durable, if the file system supports it."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
