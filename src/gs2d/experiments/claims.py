"""Claims: files that one process at a time holds, so that several processes can share one list of work.

A claim is made with ``O_EXCL`` (atomic on local and network file systems) and names host, process and the time at
which that process began, so that the claim of a killed process is recognised, even if its number is in use again.
A claim of another machine or container is stale when it was not touched for ``FOREIGN_SECONDS`` by the disk's clock.
Pure Python; never imports torch.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gs2d.core.files import disk_error
from gs2d.errors import RunError
from gs2d.io.run_dir import RunFolder

FOREIGN_SECONDS = 1800.0
UNWRITTEN_SECONDS = 10.0
TOUCH_SECONDS = 20.0


@dataclass(eq=False)
class Claim:
    """A claim that this process holds."""

    path: Path
    text: str
    touched: float = field(default_factory=time.monotonic)

    def touch(self) -> None:
        """Say that the holder lives (at most every ``TOUCH_SECONDS``)."""
        if time.monotonic() - self.touched > TOUCH_SECONDS:
            with contextlib.suppress(OSError):
                os.utime(self.path)
            self.touched = time.monotonic()

    def release(self) -> None:
        """Give it back, unless somebody has taken it over."""
        with contextlib.suppress(OSError):
            if self.path.read_text() == self.text:
                self.path.unlink()


def take_claim(path: Path) -> Claim | None:
    """Claim a name; None if a living process holds it.

    Raises
    ------
    DiskError
        The file cannot be written.
    """
    claim = _create(path)
    if claim is not None or not is_stale(path):
        return claim
    # Taking over is done by one process at a time: two that both saw a dead claim must not both end up with a new one.
    try:
        with RunFolder(path.parent).locked():
            if is_stale(path):
                path.unlink(missing_ok=True)
            return _create(path)
    except RunError:  # another process is taking something over: ask again later
        return None


def _create(path: Path) -> Claim | None:
    text = json.dumps({**_me(), "token": uuid.uuid4().hex})
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        with os.fdopen(descriptor, "w") as file:
            file.write(text)
    except FileExistsError:
        return None
    except OSError as error:
        raise disk_error(path, error) from error
    return Claim(path, text)


def holder(path: Path) -> dict[str, Any] | None:
    """Who holds a claim; None if nobody does."""
    try:
        return dict(json.loads(path.read_text()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}


def is_stale(path: Path) -> bool:
    """Whether a claim's holder is dead."""
    found = holder(path)
    if found is None:
        return False
    if not found:  # killed between making the file and writing into it, or about to write
        return _is_old(path, UNWRITTEN_SECONDS)
    here = found.get("host") == socket.gethostname() and found.get("space", _space()) == _space()
    if here:
        return _began(int(found.get("pid", -1))) != found.get("began") or found.get("began") is None
    return _is_old(path, FOREIGN_SECONDS)


def _is_old(path: Path, seconds: float) -> bool:
    """Whether a file was not touched for so long, by this machine's clock and by the disk's; False if it is gone."""
    try:
        touched = path.stat().st_mtime
        return time.time() - touched > seconds and _clock_of(path.parent) - touched > seconds
    except OSError:
        return False


def _clock_of(folder: Path) -> float:
    """What time it is where the files are: a server's clock may differ from ours."""
    probe = folder / f".clock-{uuid.uuid4().hex}"
    try:
        probe.touch()
        return probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)


def _me() -> dict[str, Any]:
    return {"host": socket.gethostname(), "space": _space(), "pid": os.getpid(), "began": _began(os.getpid())}


def _space() -> str:
    """The container, as far as process numbers go: containers that share a host's name do not see each other's."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def _began(pid: int) -> str | None:
    """When a process began (Linux: ticks since boot; elsewhere just "alive"); None if it is not there."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if words[0] in "ZX" else words[19]
    except OSError:
        if Path("/proc/self/stat").exists():
            return None
    try:
        os.kill(pid, 0)
    except PermissionError:
        return "alive"
    except (OSError, ValueError):
        return None
    return "alive"
