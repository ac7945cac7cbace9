"""Ctrl-C and SIGTERM while training waits for a moment at which all of it can be saved."""

from __future__ import annotations

import contextlib
import signal
import time
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SAME = 1.0  # s; a second signal so soon is the first one, sent to the whole group


class HeldSignals:
    """Between :meth:`hold` and :meth:`release` signals are kept for later; a second one acts at once.

    What a signal does is decided by the handler of before. One that is ignored, or that ends the process, stays so.
    In another thread than the main one, nothing is held.
    """

    def __init__(self) -> None:
        self._previous: dict[int, Any] = {}
        self._heard: tuple[int, float] | None = None  # number, and when, s

    @property
    def asked(self) -> bool:
        """Whether a signal is waiting."""
        return self._heard is not None

    def hold(self) -> None:
        """Keep signals from now on."""
        if self._previous:
            return
        with contextlib.suppress(ValueError):  # not the main thread: others have the signals
            for number in SIGNALS:
                if callable(handler := signal.getsignal(number)):
                    signal.signal(number, self._keep)
                    self._previous[number] = handler

    def release(self) -> None:
        """Let signals act again, and the one that was kept act now."""
        previous, heard = self._previous, self._heard
        self._previous, self._heard = {}, None
        for number, handler in previous.items():
            signal.signal(number, handler)
        if heard is not None:
            previous[heard[0]](heard[0], None)

    def forget(self) -> None:
        """Let signals act again; the work has ended in another way."""
        self._heard = None
        self.release()

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self._heard is None:
            self._heard = (number, time.monotonic())
        elif time.monotonic() - self._heard[1] > SAME:
            self._previous[number](number, frame)
