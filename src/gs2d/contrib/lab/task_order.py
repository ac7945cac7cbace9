"""The order in which the tasks of a list are done, several at once: here in processes, or on a cluster."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import Generic

from gs2d.contrib.lab.tasks import AnyTask, Task
from gs2d.training.events import Notice, OnEvent, Phase, Step


class Executor(ABC, Generic[AnyTask]):
    """Where tasks are done. It knows of no order: it begins what it is given, and says what has ended."""

    @abstractmethod
    def running(self) -> Sequence[AnyTask]:
        """Return what was begun and has not ended."""

    @abstractmethod
    def has_room(self) -> bool:
        """Return whether it takes another task."""

    @abstractmethod
    def start(self, task: AnyTask) -> None:
        """Begin a task."""

    @abstractmethod
    def wait(self, on_event: OnEvent) -> list[tuple[AnyTask, bool]]:
        """Wait a moment; return the tasks that have ended, and whether each failed, which is written down and said."""

    def detail(self) -> str:
        """Return in a few words what it does now."""
        return ", ".join(task.name for task in self.running())

    @abstractmethod
    def stop(self) -> None:
        """End what is running; called at the end, whatever it is."""


def several_at_once(
    tasks: Sequence[AnyTask], executor: Executor[AnyTask], on_event: OnEvent, after_job: Callable[[AnyTask], object]
) -> None:
    """Do tasks where an executor does them, each after those that it needs."""
    waiting, failed = list(tasks), set[str]()
    on_event(Phase("jobs", len(tasks)))
    try:
        while waiting or executor.running():
            for task in [task for task in waiting if given_up(task, failed, on_event)]:
                waiting.remove(task)
                failed.add(task.name)
                after_job(task)
            while executor.has_room() and (ready := startable(waiting, executor.running())) is not None:
                waiting.remove(ready)
                executor.start(ready)
            for task, has_failed in executor.wait(on_event):
                failed |= {task.name} if has_failed else set()
                after_job(task)
            on_event(Step(len(tasks) - len(waiting) - len(executor.running()), executor.detail()))
    finally:
        executor.stop()


def given_up(task: Task, failed: Collection[str], on_event: OnEvent) -> bool:
    """Give a task up that needs one which has failed now."""
    lacking = next((name for name in task.after if name in failed), None)
    if lacking is None:
        return False
    task.write("failed", reason=f"not begun: it needs {lacking}, which failed", **task.facts())
    on_event(Notice(f"{task.name} is not begun: it needs {lacking}, which failed"))
    return True


def startable(waiting: Sequence[AnyTask], busy: Sequence[AnyTask]) -> AnyTask | None:
    """Return the first task that waits for none, and would make nothing which another one is making."""
    if any(task.alone for task in busy):
        return None
    ahead = {task.name for task in (*waiting, *busy)}  # those that failed were given up with all that need them
    taken = {key for task in busy for key in task.keys_ahead()}
    ready = (task for task in waiting if not ahead & set(task.after) and not taken & task.keys())
    return next((task for task in ready if not (task.alone and busy)), None)
