"""Runs tasks in order, several at once, in processes or on a cluster."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import Generic

from gs2d.contrib.lab.tasks import AnyTask, Task
from gs2d.training.events import Notice, OnEvent, Phase, Step


class Executor(ABC, Generic[AnyTask]):
    """Runs tasks, in the order in which they are started."""

    @abstractmethod
    def running(self) -> Sequence[AnyTask]:
        """Return the running tasks."""

    @abstractmethod
    def has_room(self) -> bool:
        """Return whether another task can start."""

    @abstractmethod
    def start(self, task: AnyTask) -> None:
        """Start a task."""

    @abstractmethod
    def wait(self, on_event: OnEvent) -> list[tuple[AnyTask, bool]]:
        """Wait a moment; return finished tasks, each with whether it failed. Failures are recorded and reported."""

    def detail(self) -> str:
        """Return the current activity in a few words."""
        return ", ".join(task.name for task in self.running())

    @abstractmethod
    def stop(self) -> None:
        """Stop all running tasks; always called at the end."""


def several_at_once(
    tasks: Sequence[AnyTask], executor: Executor[AnyTask], on_event: OnEvent, after_task: Callable[[AnyTask], object]
) -> None:
    """Run tasks with an executor, each after the tasks that it needs."""
    waiting, failed = list(tasks), set[str]()
    on_event(Phase("tasks", len(tasks)))
    try:
        while waiting or executor.running():
            for task in [task for task in waiting if given_up(task, failed, on_event)]:
                waiting.remove(task)
                failed.add(task.name)
                after_task(task)
            while executor.has_room() and (ready := startable(waiting, executor.running())) is not None:
                waiting.remove(ready)
                executor.start(ready)
            for task, has_failed in executor.wait(on_event):
                failed |= {task.name} if has_failed else set()
                after_task(task)
            on_event(Step(len(tasks) - len(waiting) - len(executor.running()), executor.detail()))
    finally:
        executor.stop()


def given_up(task: Task, failed: Collection[str], on_event: OnEvent) -> bool:
    """Mark a task as failed if a task that it needs has failed; return whether one has."""
    needed = next((name for name in task.after if name in failed), None)
    if needed is None:
        return False
    task.write("failed", reason=f"not started: {needed} failed", **task.details())
    on_event(Notice(f"{task.name} is not started: {needed} failed"))
    return True


def startable(waiting: Sequence[AnyTask], busy: Sequence[AnyTask]) -> AnyTask | None:
    """Return the first task that needs no unfinished task and shares no unfinished result with a running one."""
    if any(task.alone for task in busy):
        return None
    ahead = {task.name for task in (*waiting, *busy)}  # tasks behind a failed one were removed
    locked = {key for task in busy for key in task.keys_ahead()}
    ready = (task for task in waiting if not ahead & set(task.after) and not locked & task.keys())
    return next((task for task in ready if not (task.alone and busy)), None)
