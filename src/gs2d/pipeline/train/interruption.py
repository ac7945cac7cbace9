"""Delay Ctrl-C and SIGTERM until the training state can be saved."""

from __future__ import annotations

import contextlib
import signal
import time
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SAME = 1.0  # s; a second signal within this time is the first one, sent to the whole process group


class HeldSignals:
    """Delays signals between :meth:`hold` and :meth:`release`; a second signal acts at once.

    Delayed signals are passed to the previous handlers. Signals that are ignored, or that end the process, are not
    delayed, nor is any signal outside the main thread.
    """

    def __init__(self) -> None:
        self._previous: dict[int, Any] = {}
        self._heard: tuple[int, float] | None = None  # number, time in s

    @property
    def pending(self) -> bool:
        """Whether a signal is delayed."""
        return self._heard is not None

    def hold(self) -> None:
        """Start to delay signals."""
        if self._previous:
            return
        with contextlib.suppress(ValueError):  # not the main thread
            for number in SIGNALS:
                if callable(handler := signal.getsignal(number)):
                    signal.signal(number, self._keep)
                    self._previous[number] = handler

    def release(self) -> None:
        """Restore the handlers and deliver a delayed signal."""
        previous, heard = self._previous, self._heard
        self._previous, self._heard = {}, None
        for number, handler in previous.items():
            signal.signal(number, handler)
        if heard is not None:
            previous[heard[0]](heard[0], None)

    def forget(self) -> None:
        """Restore the handlers and drop a delayed signal."""
        self._heard = None
        self.release()

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self._heard is None:
            self._heard = (number, time.monotonic())
        elif time.monotonic() - self._heard[1] > SAME:
            self._previous[number](number, frame)
