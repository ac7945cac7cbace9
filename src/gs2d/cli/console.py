"""Console output: progress on stderr, tables or JSON on stdout."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any

from rich.console import Console as RichConsole
from rich.console import ConsoleOptions, RenderResult
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from gs2d.core.text import duration, printable
from gs2d.training.events import Event, Notice, NotMade, Phase, StageScored, Step

GREW = (2.0, 60.0)  # factor and seconds by which an estimate must exceed the shown time to increase it
_WIDEST, _LEAST = 32, 6  # columns of a bar; no bar with fewer
_FULL, _EMPTY = "\u2501", "\u2500"
LOG_SECONDS, LOG_FRACTION = 60.0, 0.02  # minimum time and fraction of a phase between two lines of a log file
_ANY_WIDTH = 10_000  # columns
_NO_SCREENS = ("dumb", "unknown")  # values of TERM without cursor movement


class Bar:
    """Progress of a phase: name, bar, counts and remaining time; below it details."""

    def __init__(self, phase: Phase, clock: Callable[[], float] = time.monotonic) -> None:
        self.phase, self._clock = phase, clock
        self.done, self.detail = phase.done, ""
        self._began, self._shown = clock(), math.inf  # time at the beginning, and shown remaining time, s

    def step(self, done: int, detail: str = "") -> None:
        """Count a step."""
        self.done, self.detail = done, detail

    def remaining(self) -> str:
        """Return the remaining time ("3 min left"), or the elapsed time while it cannot be estimated.

        The remaining time increases only if the estimate exceeds it by ``GREW``.
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
        tail = "  ".join(word for word in (counts, self.remaining()) if word)
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

    def __rich_console__(self, console: RichConsole, options: ConsoleOptions) -> RenderResult:
        yield from self.lines(options.max_width - 1, ascii_only=options.ascii_only)


def _cut(text: str, width: int) -> str:
    text = printable(text)
    return text if len(text) <= width else text[: max(width - 3, 1)] + "..."


class _Screen(RichConsole):
    def print(self, *objects: Any, **how: Any) -> None:
        """Print, with control characters in file names escaped."""
        super().print(*(printable(it, lines=True) if isinstance(it, str) else it for it in objects), **how)

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, where rich would end the process."""
        raise BrokenPipeError


def show_help(lines: Sequence[str]) -> None:
    """Print help on stdout, with headings in bold on a terminal."""
    screen = _screen(sys.stdout)
    for line in lines:
        heading = line.endswith(":") and not line.startswith(" ")
        screen.print(line, style="bold" if heading else None, markup=False, soft_wrap=True)


def _screen(file: IO[str], **settings: Any) -> _Screen:
    """Return a console for a stream; ``NO_COLOR`` disables styles."""
    color = None if os.environ.get("NO_COLOR") else "auto"
    return _Screen(file=file, highlight=False, color_system=color, **settings)  # type: ignore[arg-type]


class Console:
    """Prints events and results. ``quiet``: only JSON results; ``as_json``: only JSON on stdout.

    Detail notices are printed with ``verbose`` only.
    """

    def __init__(
        self, *, quiet: bool, as_json: bool, verbose: bool = False, before_each: Callable[[], None] = lambda: None
    ) -> None:
        self.quiet = quiet
        self._verbose = verbose
        self.as_json = as_json
        self._before_each = before_each  # event; may raise
        self._out = _screen(sys.stdout, soft_wrap=True)
        self._err = _screen(sys.stderr)
        # Whether lines can be overwritten: on a terminal with cursor movement.
        self._interactive = sys.stderr is not None and sys.stderr.isatty() and os.environ.get("TERM") not in _NO_SCREENS
        self._live: Live | None = None
        self._bar: Bar | None = None
        self._named: set[str] = set()  # phases with a line in the log file
        self.missing: list[NotMade] = []  # reported at the end of the command
        self._logged = (0.0, 0)  # time in s and finished steps of the last line of a log file

    def on_event(self, event: Event) -> None:
        """Print an event of the pipeline."""
        self._before_each()
        if isinstance(event, NotMade):
            self.missing.append(event)
        if self.quiet:
            return
        if isinstance(event, Phase):
            self._begin(event)
        elif isinstance(event, Step):
            self._step(event)
        elif isinstance(event, Notice):
            if self._verbose or not event.detail:
                label, style = ("warning", "bold red") if event.is_warning else ("note", "yellow")
                self._err.print(f"[{style}]{label}[/{style}] {escape(printable(event.text))}", soft_wrap=True)
        elif isinstance(event, NotMade):
            line = f"[red]not made[/red] {escape(printable(event.what))}: {escape(printable(event.reason))}"
            self._err.print(line, soft_wrap=True)
        elif isinstance(event, StageScored):
            self._err.print(event.line(), markup=False, soft_wrap=True)

    def _begin(self, phase: Phase) -> None:
        self._bar = Bar(phase)
        if not self._interactive:  # a log file: one line per phase, then occasional progress
            if phase.name not in self._named:
                name = printable(phase.name)
                self._err.print(f"{name} ({phase.total})" if phase.total else name, markup=False)
            self._named.add(phase.name)
            self._logged = (time.monotonic(), phase.done)
        elif self._live is None:
            self._live = Live(self._bar, console=self._err, transient=True, refresh_per_second=4)
            self._live.start()
        else:
            self._live.update(self._bar)

    def _step(self, step: Step) -> None:
        if self._bar is None:
            return
        self._bar.step(step.done, step.detail)
        total, (at, done) = self._bar.phase.total, self._logged
        due = time.monotonic() - at >= LOG_SECONDS and step.done - done >= LOG_FRACTION * total
        if not self._interactive and total and due:
            self._logged = (time.monotonic(), step.done)
            line = f"{printable(self._bar.phase.name)}: {step.done:,} of {total:,}, {self._bar.remaining()}"
            self._err.print(line, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Remove the progress bar."""
        if self._live is not None:
            self._live.stop()
            self._live = None
        self._bar = None

    def flush(self) -> None:
        """Flush stdout, so that a full disk or a closed pipe raises here and not at exit."""
        if sys.stdout is not None:
            sys.stdout.flush()

    def say(self, text: str, style: str | None = None) -> None:
        """Print a line on stdout."""
        self.close()
        if not (self.quiet or self.as_json):
            self._out.print(text, markup=False, style=style)

    def table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print a table on stdout; the first column is text, the others are numbers."""
        self.close()
        if self.quiet or self.as_json:
            return
        if title:
            self._out.print(title, markup=False, style="italic")  # rich would wrap it to the width of the columns
        table = Table(box=None, pad_edge=False)
        for i, column in enumerate(columns):
            table.add_column(escape(printable(column)), justify="left" if i == 0 else "right", no_wrap=True)
        for row in rows:
            table.add_row(*(escape(printable(cell)) for cell in row))
        needed = self._out.measure(table, options=self._out.options.update(max_width=_ANY_WIDTH)).maximum
        screen = self._out if needed <= self._out.width else _screen(sys.stdout, width=needed)
        screen.print(table, soft_wrap=False)

    def result(self, value: Any) -> None:
        """Print the result as JSON on stdout, with ``as_json``."""
        self.close()
        if self.as_json:
            if self.missing and isinstance(value, dict):
                value = {**value, "missing": [{"what": m.what, "reason": m.reason} for m in self.missing]}
            print(json.dumps(value, indent=2, allow_nan=False))


def figure(value: float | None, digits: int, unit: str = "") -> str:
    """Return a number for a table, or a dash for None."""
    return "-" if value is None else f"{value:,.{digits}f}{unit}"
