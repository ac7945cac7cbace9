"""One input under guard: what a reader may do with it, and what it may not.

Allowed is a result, or an error in one line that the user can mend. Not allowed is any other exception, a warning or
a word on the terminal, more than 20 s, more than 512 MB and four times the input, a file outside, another process.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gs2d.cli.app import _USER_ERRORS
from gs2d.contrib.formats import usd_process
from gs2d.errors import Gs2dError

SECONDS = 20
MEMORY = 512 << 20  # bytes, of the whole process
LOADED = 270 << 20  # of that are torch and whatever else is loaded; what a process held beyond it before is not counted
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "shutil.rmtree"}
_NEVER = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect", "socket.bind")


class _Hang(BaseException):
    """Not an Exception: nothing on the way catches it."""


class Watch:
    """Sees what Python opens, changes and starts, below ``inside`` and elsewhere; made once a process."""

    _made: Watch | None = None

    def __init__(self) -> None:
        self.inside = ""
        self.seen: list[str] = []
        self.on = False
        sys.addaudithook(self._hook)

    @classmethod
    def get(cls) -> Watch:
        """Hooks cannot be removed: there is one."""
        cls._made = cls._made or cls()
        return cls._made

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, _, flags = args
            if isinstance(flags, int) and flags & _WRITES:
                self._check(event, path)
        elif event in _CHANGES:
            folders = [a for a in args if isinstance(a, int) and a >= 0] if event != "os.mkdir" else []
            for path in args[:2]:
                self._check(event, path, folders[0] if folders else None)
        elif event == "subprocess.Popen" and usd_process.__file__ in args[1]:
            return  # OpenUSD's parser crashes on damaged files: it has a process of its own, with limits
        elif event.startswith(_NEVER):
            self.seen.append(f"{event} {args[:1]!r}"[:200])

    def _check(self, event: str, path: Any, folder: int | None = None) -> None:
        if not isinstance(path, str | bytes | os.PathLike):  # of a descriptor
            return
        here = os.getcwd() if folder is None else os.readlink(f"/proc/self/fd/{folder}")
        name = os.path.normpath(os.path.join(here, os.fsdecode(path)))
        # The folder itself is opened for a file without a name in it (O_TMPFILE).
        if name != self.inside and not name.startswith((self.inside + os.sep, os.devnull, "/proc/self/clear_refs")):
            self.seen.append(f"{event} of {name[:150]}")


@contextlib.contextmanager
def _terminal_bytes() -> Iterator[Callable[[], bytes]]:
    """What is written to descriptors 1 and 2 within, by Python or by a library."""
    _flush()
    with open(os.memfd_create("terminal"), "w+b") as file:
        kept = os.dup(1), os.dup(2)
        os.dup2(file.fileno(), 1), os.dup2(file.fileno(), 2)

        def written() -> bytes:
            _flush()
            return os.pread(file.fileno(), 4000, 0)

        try:
            yield written
        finally:
            _flush()
            for number, copy in enumerate(kept, 1):
                os.dup2(copy, number)
                os.close(copy)


def _flush() -> None:
    sys.stdout.flush(), sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)


def _reset_peak() -> None:
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def _peak() -> int:
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="ascii") as file:
        for line in file:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return 0


def _raise_hang(*_: Any) -> None:
    raise _Hang


def outcome(target: Callable[[Path], object], folder: Path, size: int) -> tuple[str | None, str, int]:
    """Run ``target(folder)``, which reads ``size`` bytes, under guard.

    Returns
    -------
    (finding or None, "read" or "refused", peak of memory in bytes)
    """
    watch = Watch.get()
    watch.inside, watch.seen = str(folder.resolve()), []
    verdict, finding = "read", None
    before = signal.signal(signal.SIGALRM, _raise_hang)
    start = time.monotonic()
    _reset_peak()
    held = max(0, _peak() - LOADED)
    with warnings.catch_warnings(record=True) as said, _terminal_bytes() as words:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", module=r"PIL\.|numpy\.lib")  # as the command line does
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        watch.on = True
        try:
            target(folder)
        except Exception as error:
            verdict = "refused"
            finding = _judged(error)
        except _Hang:
            finding = "hang: did not end"
        finally:
            watch.on = False
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        printed = words()
    peak, seconds = _peak() - held, time.monotonic() - start
    if finding is None and seconds > SECONDS:
        finding = f"hang: {seconds:.0f} s"
    if finding is None and peak > MEMORY + 4 * size:
        finding = f"memory: {peak >> 20} MB for {size} bytes"
    if finding is None and watch.seen:
        finding = f"outside: {watch.seen[0]}"
    if finding is None and said:
        finding = f"warning: {said[0].category.__name__}: {said[0].message} ({said[0].filename}:{said[0].lineno})"
    if finding is None and printed:
        finding = f"printed: {printed[:200]!r}"
    return finding, verdict, peak


def _judged(error: Exception) -> str | None:
    """Nothing for an error that the command line says in one line and calls the user's to mend."""
    if isinstance(error, Gs2dError):
        return "a message of several lines: " + str(error)[:200] if "\n" in str(error).strip() else None
    if isinstance(error, OSError) and error.errno in _USER_ERRORS:
        return None
    at = error.__traceback__
    where = ""
    while at is not None:
        name = at.tb_frame.f_code.co_filename
        if "gs2d" in name.rsplit("/src/", 1)[-1].split("/")[0]:
            where = f"{Path(name).name}:{at.tb_lineno}"
        at = at.tb_next
    return f"traceback: {type(error).__name__} at {where}: {' '.join(str(error).split())[:150]}"
