"""Everything a person sees: progress on stderr, tables or JSON on stdout."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from typing import IO, Any

from rich import box
from rich.console import Console as RichConsole
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from gs2d.cli.layout import wrapped
from gs2d.pipeline.events import Event, Missing, Notice, Phase, StageDone, Step


class _Screen(RichConsole):
    def on_broken_pipe(self) -> None:
        """Say that nobody reads, where rich would end the process itself."""
        raise BrokenPipeError


def show_help(lines: Sequence[str]) -> None:
    """Print help on stdout, headings in bold where that is wanted."""
    screen = _screen(sys.stdout)
    for line in lines:
        heading = line.endswith(":") and not line.startswith(" ")
        screen.print(line, style="bold" if heading else None, markup=False, soft_wrap=True)


def _screen(file: IO[str], **settings: Any) -> _Screen:
    """One of the two streams; without a single escape of style where ``NO_COLOR`` says that none is wanted."""
    color = None if os.environ.get("NO_COLOR") else "auto"
    return _Screen(file=file, highlight=False, color_system=color, **settings)  # type: ignore[arg-type]


class Console:
    """The screen. With ``quiet`` nothing but results asked for as JSON; with ``as_json`` stdout carries only JSON."""

    def __init__(self, *, quiet: bool, as_json: bool, before_each: Callable[[], None] = lambda: None) -> None:
        self.quiet = quiet
        self.as_json = as_json
        self._before_each = before_each  # event; may raise
        self._out = _screen(sys.stdout, soft_wrap=True)
        self._err = _screen(sys.stderr)
        self._progress: Progress | None = None
        self._task: TaskID | None = None
        self._named: set[str] = set()  # phases that a log file has heard of
        self.missing: list[Missing] = []  # what could not be made, for the end of the command

    def on_event(self, event: Event) -> None:
        """Draw an event of the pipeline."""
        self._before_each()
        if isinstance(event, Missing):
            self.missing.append(event)
        if self.quiet:
            return
        if isinstance(event, Phase):
            self._begin(event)
        elif isinstance(event, Step):
            if self._progress is not None and self._task is not None:
                self._progress.update(self._task, completed=event.done, detail=escape(event.detail))
        elif isinstance(event, Notice):
            self._err.print(f"[yellow]note[/yellow] {escape(event.text)}", soft_wrap=True)
        elif isinstance(event, Missing):
            self._err.print(f"[red]not made[/red] {escape(event.what)}: {escape(event.reason)}", soft_wrap=True)
        elif isinstance(event, StageDone):
            self._err.print(escape(stage_line(event.metrics)), soft_wrap=True)

    def _begin(self, phase: Phase) -> None:
        if not self._err.is_terminal:  # a log file: one line a phase, no bars
            if phase.name not in self._named:
                self._err.print(f"{phase.name} ({phase.total})" if phase.total else phase.name)
            self._named.add(phase.name)
            return
        if self._progress is None:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[detail]}"),
                console=self._err,
                transient=True,
                speed_estimate_period=20,
            )
            self._progress.start()
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(
            escape(phase.name), total=phase.total or None, completed=phase.done, detail=""
        )

    def close(self) -> None:
        """Take the progress bar off the screen."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = self._task = None

    def flush(self) -> None:
        """Write what stdout still holds: a full disk or a closed pipe is heard of here, not when Python shuts down."""
        if sys.stdout is not None:
            sys.stdout.flush()

    def say(self, text: str, *, indent: str = "") -> None:
        """Print a line for people on stdout; on a terminal it breaks between words, and goes on after ``indent``."""
        if self.quiet or self.as_json:
            return
        lines = wrapped(text, self._out.width, rest=indent, keep_spaces=True) if self._out.is_terminal else [text]
        for line in lines:
            self._out.print(line, markup=False)

    def heading(self, text: str) -> None:
        """Print an empty line and a heading for people, on stdout."""
        if not (self.quiet or self.as_json):
            self._out.print()
            self._out.print(text, markup=False, style="bold")

    def table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A table for people, on stdout; the first column is text, the others are figures."""
        if self.quiet or self.as_json:
            return
        table = Table(title=escape(title) or None, title_justify="left", box=box.SIMPLE)
        for i, column in enumerate(columns):
            table.add_column(escape(column), justify="left" if i == 0 else "right", no_wrap=True)
        for row in rows:
            table.add_row(*(escape(cell) for cell in row))
        self._out.print(table, soft_wrap=False)

    def result(self, value: Any) -> None:
        """The result of the command, for programs: JSON on stdout, if it was asked for."""
        if self.as_json:
            if self.missing and isinstance(value, dict):
                value = {**value, "missing": [{"what": m.what, "reason": m.reason} for m in self.missing]}
            print(json.dumps(value, indent=2, allow_nan=False))


def stage_line(metrics: dict[str, Any]) -> str:
    """One line about a finished stage."""
    words = [f"{metrics['name']}: {metrics['iterations']} iterations in {metrics['seconds']:.0f} s"]
    words.append(f"{metrics['splats']:,} splats")
    for split in ("train", "test"):
        scores = metrics.get(split)
        if scores and scores.get("psnr") is not None:
            words.append(f"{split} PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}")
    return "; ".join(words) + (" (from a cache)" if metrics.get("reused_from") else "")


def figure(value: float | None, digits: int, unit: str = "") -> str:
    """A number for a table; a dash where there is none."""
    return "-" if value is None else f"{value:,.{digits}f}{unit}"
