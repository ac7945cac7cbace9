"""The progress bar of ``gs2d.train`` for scripts and notebooks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from gs2d.core.text import printable
from gs2d.training.events import Event, Notice, OnEvent, Progress, StageStarted


@contextmanager
def progress_bar(on_event: OnEvent) -> Iterator[OnEvent]:
    """Yield a listener that shows notices and a bar per stage on stderr, and forwards events."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=Console(stderr=True, highlight=False)) as bars:
        task = bars.add_task("preparing", total=None)

        def shown(event: Event) -> None:
            nonlocal task
            if isinstance(event, Notice):
                bars.console.print(f"note {printable(event.text)}", markup=False, soft_wrap=True)
            elif isinstance(event, StageStarted):
                if bars.tasks[-1].total is None:
                    bars.remove_task(task)
                task = bars.add_task(event.stage, total=event.iterations)
            elif isinstance(event, Progress):
                text = f"{event.stage}, loss {event.loss:.4f}, {event.splats:,} splats"
                bars.update(task, completed=event.iteration, description=text)
            on_event(event)

        yield shown
