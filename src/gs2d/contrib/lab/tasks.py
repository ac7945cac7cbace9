"""A task of a list: a value that another process, or another machine, can be handed, and what became of it.

What became of it is in ``jobs/NAME.json`` under the folder of the list; a task that is done is not done again.
Never imports torch at the top: a process of its own chooses its GPU before torch loads.
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

_OUTCOME = {"state": str, "reason?": str, "notes?": (dict, None), "wanted?": [str], "trained?": bool}


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """One piece of work: a frozen value of plain values and paths, so that any process can do it.

    Attributes
    ----------
    name : str
        Unique in the list; a file name.
    record : Path
        The file that says what became of it.
    after : tuple of str
        Tasks of the list that must be done before.
    inputs, outputs : tuple of Path
        Files that it reads beside the capture, and files that it leaves: it is done only while those are there. Both
        lie in the folder of the list.
    alone : bool
        Nothing runs beside it: it has all CPU threads.
    retries : int
        How often it restarts from its last checkpoint when its process dies.
    memory : float or None, GiB
        That it keeps to.
    gpu : bool
        Whether it uses a GPU, where the backend does.
    """

    name: str
    record: Path
    after: tuple[str, ...] = ()
    inputs: tuple[Path, ...] = ()
    outputs: tuple[Path, ...] = ()
    alone: bool = False
    retries: int = 0
    memory: float | None = None
    gpu: bool = True

    def outcome(self) -> dict[str, Any]:
        """Return what became of it: ``state`` (new, running, done, failed), ``reason``, and what it says of itself.

        Raises
        ------
        DataError, RunError
            The record was changed by hand.
        """
        if not self.record.exists():
            return {"state": "new"}
        found: dict[str, Any] = read_json(self.record)
        check_shape(self.record, found, _OUTCOME, f"delete it, and {self.name} is done again")
        return found

    def is_done(self) -> bool:
        """Return whether nothing is left to do."""
        return self.outcome()["state"] == "done" and all(path.exists() for path in self.outputs)

    def write(self, state: str, **facts: Any) -> None:
        """Write what became of it."""
        write_json(self.record, {"state": state, **facts, "time": time.time(), "at": now()})

    def facts(self) -> dict[str, Any]:
        """Return what is true of it however it ended, for its record."""
        return {}

    def keys(self) -> set[str]:
        """Return names of all that it makes for others, beside its outputs."""
        return set()

    def keys_ahead(self) -> set[str]:
        """Return those that it has not made yet: while it runs, a task with one of these waits."""
        return set()

    @abstractmethod
    def with_threads(self, threads: int) -> Self:
        """Return the task on so many CPU threads."""

    @abstractmethod
    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Do it, or go on with it; returns what is written down of it.

        Raises
        ------
        Gs2dError
            What the user can mend.
        """


AnyTask = TypeVar("AnyTask", bound=Task)


def failures(tasks: Sequence[Task]) -> dict[str, str]:
    """Return the reason by task, of those that failed."""
    outcomes = {task.name: task.outcome() for task in tasks}
    return {
        name: outcome.get("reason", "no reason was written down")
        for name, outcome in outcomes.items()
        if outcome["state"] == "failed"
    }


def do(task: Task, on_event: OnEvent = ignore) -> None:
    """Do one task; what goes wrong is written down."""
    task.write("running")
    try:
        found = task.work(on_event)
    except Exception as error:
        is_ours = not isinstance(error, Gs2dError)
        text = " ".join(str(error).split())
        reason = f"{type(error).__name__}: {error}" if is_ours else text or type(error).__name__
        more = {"traceback": traceback.format_exc()} if is_ours else {}
        task.write("failed", reason=reason, **task.facts(), **more)
        on_event(Notice(f"{task.name} failed: {reason}"))
        return
    task.write("done", **found, **task.facts())
