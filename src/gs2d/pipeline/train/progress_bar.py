"""The progress bar of ``gs2d.train``, for programs and notebooks; commands draw theirs in ``cli/console.py``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gs2d.core.text import printable
from gs2d.training import events
from gs2d.training.events import Notice

__all__ = ["progress_bar"]


@contextmanager
def progress_bar(on_event: Callable[[Any], None]) -> Iterator[Callable[[Any], None]]:
    """Yield a listener that shows notices and one bar for each stage on stderr, and passes events on."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True, highlight=False)) as bars:
        task = bars.add_task("preparing", total=None)

        def shown(event: Any) -> None:
            nonlocal task
            if isinstance(event, Notice):
                bars.console.print(f"note {printable(event.text)}", markup=False, soft_wrap=True)
            elif isinstance(event, events.StageStarted):
                if bars.tasks[-1].total is None:
                    bars.remove_task(task)
                task = bars.add_task(event.stage, total=event.iterations)
            elif isinstance(event, events.Progress):
                text = f"{event.stage}, loss {event.loss:.4f}, {event.splats:,} splats"
                bars.update(task, completed=event.iteration, description=text)
            on_event(event)

        yield shown
