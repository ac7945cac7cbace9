"""Atomic file writes: a file is either the old one or the complete new one, never a part.

What a killed write leaves is a file ``.NAME.gs2d.tmp`` beside NAME. Its writer held a lock on it, which died with the
process: the next write of NAME removes it, and so does :func:`sweep`. The temporary file of a process that lives is
never touched.
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
_LONGEST = 200  # bytes of a file's name that are in the temporary one
_ATTEMPTS = 100  # at a temporary name
_ESCAPED = "backslashreplace"  # a file name that is not UTF-8 is written as \udcff, which JSON reads back
_REMEDIES = {
    errno.ENOSPC: "free some space or choose another folder",
    errno.EDQUOT: "free some of your quota or choose another folder",
    errno.EFBIG: "the file-size limit is too small (ulimit -f)",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.EROFS: "choose a folder on a disk that is not read-only",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.ENOENT: "the folder does not exist: create it first",
    errno.EISDIR: "a folder has this name: remove it or choose another name",
    errno.EIO: "the disk reports a fault",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def disk_error(path: str | os.PathLike[str], error: OSError) -> DiskError:
    """Return the one-line DiskError for a failed write of ``path``."""
    remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
    return DiskError(f"cannot write {os.fspath(path)}: {error.strerror or error}; {remedy}", error.errno)


def is_full(error: BaseException) -> bool:
    """Whether nothing more can be written: a full disk, a quota, a limit of file sizes."""
    return isinstance(error, DiskError | OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class _RecordingFile(io.FileIO):
    """A raw file that remembers its write error, because libraries (torch.save) may turn it into another one."""

    failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        try:
            return int(super().write(data) or 0)
        except OSError as error:
            self.failure = error
            raise


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    r"""Open a file for writing that appears under its name only when it is complete.

    The bytes go to a temporary name in the same folder (hidden, ending in ``.gs2d.tmp``), reach the disk (fsync) and
    are renamed. When the body or the disk fails, the temporary file is removed and an older file stays as it was.

    Parameters
    ----------
    path : path
        The file to write. Its folder must exist.
    mode : "wb" or "w"
        Bytes, or text in UTF-8 with ``\n`` line ends.

    Raises
    ------
    DiskError
        Full disk, no permission, no such folder, a file where a folder is needed.
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
                with contextlib.suppress(OSError):  # a failed flush is already on its way up
                    file.close()
                raw.close()
        except BaseException as error:
            failure = raw.failure
            if failure is None and isinstance(error, OSError) and error.errno in _REMEDIES:
                # Only errors of this very write: an OSError about another file (an input) passes unchanged.
                named = error.filename
                failure = error if named is None or Path(os.fsdecode(named)) in (temporary, target) else None
            if failure is not None:
                raise disk_error(target, failure) from error
            raise


@contextlib.contextmanager
def temporary_beside(target: Path) -> Iterator[tuple[Path, int]]:
    """Hold an empty file in the folder of ``target``, which takes its name at the end; it goes where the body fails.

    Yields its path, which other programs may write to as long as they do not replace it, and a descriptor that is open
    for writing. At the end the bytes reach the disk (fsync) before the file is renamed.
    """
    try:
        temporary, descriptor = _claimed(target)
    except OSError as error:
        raise disk_error(target, error) from error
    try:
        yield temporary, descriptor
        try:
            os.fsync(descriptor)
            if sys.platform == "win32":  # which renames no open file
                os.close(descriptor)
                descriptor = -1
            os.replace(temporary, target)
        except OSError as error:
            raise disk_error(target, error) from error
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    finally:  # the lock is held until there is nothing left to sweep
        if descriptor >= 0:
            os.close(descriptor)
    _sync_folder(target.parent)


def _claimed(target: Path) -> tuple[Path, int]:
    """Make and lock a temporary file; one of this name that a killed process left goes first."""
    name = target.name
    while len(os.fsencode(name)) > _LONGEST:
        name = name[:-1]
    temporary = target.with_name(f".{name}.gs2d.tmp")
    for _ in range(_ATTEMPTS):
        try:
            # 0o666: the user's umask decides, as for any other file (mkstemp would make it private).
            flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
            descriptor = os.open(temporary, flags, 0o666)
        except FileExistsError:
            if not _removed(temporary):  # another process writes the same file: the last one wins
                temporary = target.with_name(f".{name}.{secrets.token_hex(4)}.gs2d.tmp")
            continue
        if _is_ours(temporary, descriptor):
            return temporary, descriptor
        os.close(descriptor)  # swept between the two lines above
    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(temporary))


def _is_ours(temporary: Path, descriptor: int) -> bool:
    """Lock a new file; False where another process took it for what a killed one left."""
    if sys.platform == "win32":  # which deletes no open file
        return True
    try:
        if not try_lock(descriptor):
            return False
        return os.path.samestat(os.stat(temporary), os.fstat(descriptor))
    except FileNotFoundError:
        return False
    except OSError:  # a file system without locks, where nothing can be swept either
        return True


def _removed(temporary: Path) -> bool:
    """Remove a temporary file, if nobody writes it any more."""
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
    """Whether a file has the name of one that is being written, or was when its process was killed."""
    return _TEMPORARY.fullmatch(name) is not None


def sweep(folder: Path) -> int:
    """Remove the temporary files in a folder that killed processes left; returns how many. Never raises OSError."""
    swept = 0
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in list(entries):
            if is_temporary(entry.name) and entry.is_file(follow_symlinks=False):
                swept += _removed(Path(entry.path))
    return swept


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise now what ``atomic_write`` would raise at the end: no such folder, no permission, a folder."""
    target = Path(path)
    try:
        # Not Path.is_dir: from Python 3.14 on it answers False where the system has an error, as for too long a name.
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISDIR(target.stat().st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise disk_error(target, error) from error


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable, where the file system lets folders be synced."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
