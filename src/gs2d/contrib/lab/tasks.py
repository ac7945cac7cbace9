"""Tasks: values that other processes and machines can run, with a record of their status.

The record is ``jobs/NAME.json`` in the output folder; finished tasks are not run again. The module imports torch only
in functions, because a process selects its GPU before torch loads.
"""

from __future__ import annotations

import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from gs2d.core.json_files import read_json, write_json
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import now
from gs2d.io.run_schema import check_shape
from gs2d.training.events import Notice, OnEvent, ignore

_RECORD = {"state": str, "reason?": str, "notes?": (dict, None), "wanted?": [str], "trained?": bool}


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A piece of work, as a frozen dataclass of plain values and paths that can be pickled."""

    name: str  # unique, valid as a file name
    record: Path  # file of the status
    after: tuple[str, ...] = ()  # names of tasks that must finish first
    inputs: tuple[Path, ...] = ()  # files in the output folder that the task reads
    outputs: tuple[Path, ...] = ()  # files there that it writes; a task is finished only while they exist
    alone: bool = False  # whether the task runs alone, with all CPU threads
    retries: int = 0  # number of restarts, from the last checkpoint, if its process dies
    memory: float | None = None  # limit, GiB
    gpu: bool = True  # whether the task uses a GPU, if the backend does

    def status(self) -> dict[str, Any]:
        """Return the record: ``state`` (new, running, done or failed), ``reason``, and results of the task."""
        if not self.record.exists():
            return {"state": "new"}
        record: dict[str, Any] = read_json(self.record)
        check_shape(self.record, record, _RECORD, f"delete it to run {self.name} again")
        return record

    def is_done(self) -> bool:
        """Return whether the task is finished."""
        return self.status()["state"] == "done" and all(path.exists() for path in self.outputs)

    def write(self, state: str, **entries: Any) -> None:
        """Write the record."""
        write_json(self.record, {"state": state, **entries, "time": time.time(), "at": now()})

    def details(self) -> dict[str, Any]:
        """Return entries of the record that do not depend on success."""
        return {}

    def keys(self) -> set[str]:
        """Return the keys of results that other tasks share, such as stages in the cache."""
        return set()

    def keys_ahead(self) -> set[str]:
        """Return the keys of results that are not finished; tasks with one of them wait."""
        return set()

    @abstractmethod
    def with_threads(self, threads: int) -> Self:
        """Return the task with another number of CPU threads."""

    @abstractmethod
    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Run the task, or continue it; return entries of its record, or raise Gs2dError if the user has to act."""


AnyTask = TypeVar("AnyTask", bound=Task)


def failures(tasks: Sequence[Task]) -> dict[str, str]:
    """Return the reasons of failed tasks by name."""
    statuses = {task.name: task.status() for task in tasks}
    return {
        name: status.get("reason", "no reason was recorded")
        for name, status in statuses.items()
        if status["state"] == "failed"
    }


def do(task: Task, on_event: OnEvent = ignore) -> None:
    """Run a task and write its record, also if it fails."""
    task.write("running")
    try:
        result = task.work(on_event)
    except Exception as error:
        is_fault = not isinstance(error, Gs2dError)
        text = " ".join(str(error).split())
        reason = f"{type(error).__name__}: {error}" if is_fault else text or type(error).__name__
        more = {"traceback": traceback.format_exc()} if is_fault else {}
        task.write("failed", reason=reason, **task.details(), **more)
        on_event(Notice(f"{task.name} failed: {reason}"))
        return
    task.write("done", **result, **task.details())
