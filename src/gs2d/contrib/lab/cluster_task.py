"""Runs a task in a process of a cluster: waits for files, sends events, returns its status."""

from __future__ import annotations

import contextlib
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gs2d.contrib.lab.tasks import Task, do
from gs2d.core.locks import try_lock
from gs2d.training.events import Event, Notice, NotMade, Phase, StageScored, Step

WAIT_SECONDS = 90.0  # a shared disk may show files and release locks a minute late
STEP_SECONDS = 1.0  # between two step events


@dataclass(frozen=True)
class Begun:
    """A task starts in a process on a machine; sent again if the first process was lost."""

    host: str


def token_file(folder: Path, token: str) -> Path:
    """Return the file by which a machine checks that it sees the output folder."""
    return folder / "jobs" / f"{token}.token"


def do_order(order: dict[str, Any], queue: Any, host: str) -> dict[str, Any]:
    """Run a task; see ``do_on_worker``."""
    folder = Path(order["folder"])
    if not token_file(folder, order["token"]).exists():
        return {
            "state": "refused",
            "reason": f"{host} of the cluster does not see {folder}; --out, and the capture, must lie on a disk that "
            "all machines have at the same path",
        }
    task: Task = pickle.loads(order["task"])
    events = EventSender(task.name, queue)
    events.send(Begun(host))
    lock = task.record.with_suffix(".lock")
    with open(lock, "a+b") as file:
        # A process of a disconnected machine may still be working.
        if not _within(WAIT_SECONDS, lambda: try_lock(file.fileno())):
            return {"state": "failed", "reason": f"another process of the cluster still works on it (lock: {lock})"}
        _within(WAIT_SECONDS, lambda: all(path.exists() for path in task.inputs))  # the task reports missing files
        if not task.is_done():  # recorded by a process whose machine was lost
            do(task, events)
        return {"state": "done"} | task.status()


def _within(seconds: float, is_so: Callable[[], bool]) -> bool:
    """Return whether a condition becomes true in time."""
    end = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() >= end:
            return False
        time.sleep(0.5)
    return True


@dataclass
class EventSender:
    """Passes on the events of a task: steps once a second, others at once."""

    name: str
    queue: Any
    _last: float = field(default=0.0, init=False)

    def __call__(self, event: Event) -> None:
        """Pass an event on."""
        if isinstance(event, Step):
            if time.monotonic() - self._last < STEP_SECONDS:
                return
            self._last = time.monotonic()
        if isinstance(event, Phase | Step | Notice | StageScored):
            self.send(event)
        elif isinstance(event, NotMade):
            self.send(replace(event, error=None))  # exceptions may not be picklable

    def send(self, event: Event | Begun) -> None:
        """Send an event; errors are ignored, so that the task continues."""
        with contextlib.suppress(Exception):
            self.queue.put_nowait((self.name, event))
