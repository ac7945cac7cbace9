"""Progress bar of a phase, for a terminal of any width."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from gs2d.core.text import duration, printable
from gs2d.training.events import Phase

GREW = (2.0, 60.0)  # factor and seconds by which an estimate must exceed the shown time for the work to have grown
_WIDEST, _LEAST = 32, 6  # columns of a bar; no bar with fewer
_FULL, _EMPTY = "\u2501", "\u2500"


class Bar:
    """Progress of a phase: name, bar, counts and time left; below it details."""

    def __init__(self, phase: Phase, clock: Callable[[], float] = time.monotonic) -> None:
        self.phase, self._clock = phase, clock
        self.done, self.detail = phase.done, ""
        self._began, self._shown = clock(), math.inf  # time at the beginning, and shown time left, s

    def step(self, done: int, detail: str = "") -> None:
        """Count a step."""
        self.done, self.detail = done, detail

    def left(self) -> str:
        """Return the time left ("3 min left"), or the elapsed time where it is too early to estimate.

        The time left increases only if the work grew.
        """
        elapsed = self._clock() - self._began
        seconds = self.phase.seconds_left(self.done, elapsed)
        if seconds is None:
            return duration(elapsed)
        if seconds <= GREW[0] * self._shown + GREW[1]:
            seconds = min(seconds, self._shown)
        self._shown = seconds
        return f"{duration(seconds)} left"

    def lines(self, width: int, *, ascii_only: bool = False) -> Iterator[Text]:
        """Yield the lines, at most ``width`` columns wide."""
        counts = f"{self.done:,}/{self.phase.total:,}" if self.phase.total else ""
        tail = "  ".join(word for word in (counts, self.left()) if word)
        name = _cut(self.phase.name, max(width - len(tail) - 2, 8))
        columns = min(width - len(name) - len(tail) - 4, _WIDEST)
        line = Text(name, no_wrap=True, overflow="ellipsis")
        if self.phase.total and columns >= _LEAST:
            full, empty = ("#", "-") if ascii_only else (_FULL, _EMPTY)
            filled = min(columns * self.done // self.phase.total, columns)
            line.append("  ").append(full * filled, "cyan").append(empty * (columns - filled), "dim")
        yield line.append("  " + tail)
        if self.detail:
            yield Text(_cut("  " + self.detail, width), no_wrap=True)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from self.lines(options.max_width - 1, ascii_only=options.ascii_only)


def _cut(text: str, width: int) -> str:
    text = printable(text)
    return text if len(text) <= width else text[: max(width - 3, 1)] + "..."
