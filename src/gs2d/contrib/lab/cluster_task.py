"""One task in a process of a cluster: what it waits for, what it tells, what is returned of it."""

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

WAIT_SECONDS = 90.0  # a shared disk may show a new file, and give the lock of a dead machine back, a minute late
STEP_SECONDS = 1.0  # between two steps that are told


@dataclass(frozen=True)
class Begun:
    """A process on a machine begins a task; a second one of the same task: the first was lost."""

    host: str


def token_file(folder: Path, token: str) -> Path:
    """Return the file by which a machine shows that it sees the folder of the list."""
    return folder / "jobs" / f"{token}.token"


def do_order(order: dict[str, Any], queue: Any, host: str) -> dict[str, Any]:
    """Do a task; see ``do_on_worker``."""
    folder = Path(order["folder"])
    if not token_file(folder, order["token"]).exists():
        return {
            "state": "refused",
            "reason": f"{host} of the cluster does not see {folder}; --out, and the capture, must lie on a disk that "
            "all machines have at the same path",
        }
    task: Task = pickle.loads(order["task"])
    tell = Told(task.name, queue)
    tell.send(Begun(host))
    lock = task.record.with_suffix(".lock")
    with open(lock, "a+b") as file:
        # Of a machine that is only cut off the process may work for a while yet.
        if not _within(WAIT_SECONDS, lambda: try_lock(file.fileno())):
            return {"state": "failed", "reason": f"another process of the cluster still works on it (it holds {lock})"}
        _within(WAIT_SECONDS, lambda: all(path.exists() for path in task.inputs))  # what is missing says the task
        if not task.is_done():  # by a process whose machine was lost before it could say so
            do(task, tell)
        return {"state": "done"} | task.outcome()


def _within(seconds: float, is_so: Callable[[], bool]) -> bool:
    """Whether something becomes true in time."""
    end = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() >= end:
            return False
        time.sleep(0.5)
    return True


@dataclass
class Told:
    """Listens to a task and passes on what the driver shows: steps once a second, all else at once."""

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
            self.send(replace(event, error=None))  # which need not survive the way

    def send(self, event: Event | Begun) -> None:
        """Send an event; where nobody listens any more, the task is none the worse."""
        with contextlib.suppress(Exception):
            self.queue.put_nowait((self.name, event))
