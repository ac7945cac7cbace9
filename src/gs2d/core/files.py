"""Atomic file writes: a file is either the old one or the complete new one, never a part."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from gs2d.errors import DiskError

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

    The bytes go to a temporary name in the same folder (hidden, ending in ``.tmp``), reach the disk (fsync) and
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
    temporary = target.with_name(f".{target.name[:100]}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        # 0o666: the user's umask decides, as for any other file (mkstemp would make it private).
        raw = _RecordingFile(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666), "wb")
    except OSError as error:
        raise disk_error(target, error) from error
    try:
        buffer = io.BufferedWriter(raw, 1 << 20)
        file: IO[Any] = io.TextIOWrapper(buffer, "utf-8", _ESCAPED, newline="\n") if mode == "w" else buffer
        try:
            yield file
            file.flush()
            os.fsync(raw.fileno())
        finally:
            with contextlib.suppress(OSError):  # a failed flush is already on its way up
                file.close()
            raw.close()
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        failure = raw.failure
        if failure is None and isinstance(error, OSError) and error.errno in _REMEDIES:
            # Only errors of this very write: an OSError about another file (an input) passes unchanged.
            named = error.filename
            failure = error if named is None or Path(os.fsdecode(named)) in (temporary, target) else None
        if failure is not None:
            raise disk_error(target, failure) from error
        raise
    _sync_folder(target.parent)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise now what ``atomic_write`` would raise at the end of a long work: no such folder, no permission, a folder.

    Raises
    ------
    DiskError
    """
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
