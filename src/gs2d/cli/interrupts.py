"""Ctrl-C and SIGTERM: one line and exit code 130.

While modules are imported, the process exits at once: nothing has begun, and torch contains code that catches every
exception. While a command runs, the signal becomes a KeyboardInterrupt, so that unfinished files are removed; if that
exception is caught, it is raised again at the next event.
"""

from __future__ import annotations

import os
import signal
import sys
import time

TYPE_CHECKING = False  # without importing typing, which takes time
if TYPE_CHECKING:
    from types import FrameType, TracebackType
    from typing import Any

INTERRUPTED = 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # SIGTERM: schedulers, `timeout`
_SAME = 1.0  # s; a second signal within this time is ignored


def leave_at_once() -> None:
    """Exit at once on a signal, from now on."""
    _set(_leave)


def ignore() -> None:
    """Ignore signals from now on."""
    _set(signal.SIG_IGN)


def _leave(_signal: int, _frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def _set(handler: Any) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


class Interruptible:
    """Context in which signals raise KeyboardInterrupt in the main thread. In other threads it does nothing."""

    def __init__(self) -> None:
        self._previous: dict[int, Any] = {}
        self._heard: float | None = None  # s, time of the last signal
        self._unraisable = sys.unraisablehook

    def check(self) -> None:
        """Raise KeyboardInterrupt again if it was caught."""
        if self._heard is not None:
            raise KeyboardInterrupt

    def __enter__(self) -> Interruptible:
        try:
            for number in _SIGNALS:
                self._previous[number] = signal.signal(number, self._raise)
        except ValueError:
            return self
        sys.unraisablehook = self._hook
        return self

    def __exit__(self, kind: type | None, _error: BaseException | None, _trace: TracebackType | None) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        sys.unraisablehook = self._unraisable
        if kind is None:
            self.check()

    def _raise(self, _signal: int, _frame: FrameType | None) -> None:
        before, self._heard = self._heard, time.monotonic()
        if before is None or self._heard - before > _SAME:
            raise KeyboardInterrupt

    def _hook(self, unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:  # `check` raises it
            self._unraisable(unraisable)
