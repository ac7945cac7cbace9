"""Ctrl-C and SIGTERM at any moment: one line, exit code 130, and a run is kept or deleted as it was designed.

While modules load nothing has begun, and code that catches every exception (there is some in torch) would swallow a
KeyboardInterrupt: there the process leaves at once. While a command works the signal becomes a KeyboardInterrupt, so
that what was begun is undone; one that was swallowed all the same is raised again at the next event.
"""

from __future__ import annotations

import os
import signal
import sys
import time

TYPE_CHECKING = False  # of typing, which takes its time to load
if TYPE_CHECKING:
    from types import FrameType, TracebackType
    from typing import Any

INTERRUPTED = 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # the second: a scheduler, `timeout`
_SAME = 1.0  # s; a second signal so soon is an impatient finger, or the first one sent to the whole group


def leave_at_once() -> None:
    """From now on a signal ends the process: nothing has begun that must be undone."""
    _set(_leave)


def ignore() -> None:
    """From now on signals do nothing."""
    _set(signal.SIG_IGN)


def _leave(_signal: int, _frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def _set(handler: Any) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)


class Interruptible:
    """While it is entered, signals raise KeyboardInterrupt in the main thread.

    Entered in another thread it does nothing: whoever runs gs2d there has the signals.
    """

    def __init__(self) -> None:
        self._previous: dict[int, Any] = {}
        self._heard: float | None = None  # s, when the last signal came
        self._unraisable = sys.unraisablehook

    def check(self) -> None:
        """Raise the KeyboardInterrupt that somebody swallowed."""
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
        if unraisable.exc_type is not KeyboardInterrupt:  # that one will be raised by `check`
            self._unraisable(unraisable)
