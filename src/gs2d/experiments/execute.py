"""Many tasks from one list: here, one after another or several at once, and restarted at any point.

A task is a value that another process, or another machine, can be handed: what it needs, what it makes, what must be
done before. What became of it is in ``jobs/NAME.json`` under the folder of the list; a task that is done is not done
again. The folder is locked while somebody works in it.
Never imports torch at the top: a process of its own chooses its GPU before torch loads.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self, TypeVar

from gs2d.core.json_files import read_json, write_json
from gs2d.errors import BackendError, Gs2dError
from gs2d.io.run_dir import RunFolder, make_folder, now
from gs2d.pipeline.events import Notice, OnEvent, Phase, Step, ignore

POLL_SECONDS = 0.5


@dataclass(frozen=True, kw_only=True)
class Task:
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
        Times that it is begun again by itself when its process dies; what it had saved is gone on with.
    memory : float or None, GiB
        That it keeps to.
    """

    name: str
    record: Path
    after: tuple[str, ...] = ()
    inputs: tuple[Path, ...] = ()
    outputs: tuple[Path, ...] = ()
    alone: bool = False
    retries: int = 0
    memory: float | None = None

    def outcome(self) -> dict[str, Any]:
        """Return what became of it: ``state`` (new, running, done, failed), ``reason``, and what it says of itself."""
        return dict(read_json(self.record)) if self.record.exists() else {"state": "new"}

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

    def with_threads(self, threads: int) -> Self:
        """Return the task on so many CPU threads."""
        raise NotImplementedError

    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Do it, or go on with it; returns what is written down of it.

        Raises
        ------
        Gs2dError
            What the user can mend.
        """
        raise NotImplementedError


AnyTask = TypeVar("AnyTask", bound=Task)


def failures(tasks: Sequence[Task]) -> dict[str, str]:
    """Return the reason by task, of those that failed."""
    outcomes = {task.name: task.outcome() for task in tasks}
    return {name: outcome["reason"] for name, outcome in outcomes.items() if outcome["state"] == "failed"}


# -- the list ----------------------------------------------------------------------------------------------------------
def execute(
    tasks: Sequence[AnyTask],
    folder: Path,
    on_event: OnEvent = ignore,
    *,
    slots: int | None = None,
    threads: int | None = None,
    backend: str = "auto",
    before: Callable[[], None] = lambda: None,
    after_job: Callable[[AnyTask], object] = lambda _task: None,
) -> None:
    """Do the tasks of a list that are not done; one that fails is written down, and the others go on.

    Parameters
    ----------
    tasks : sequence of Task
        Each behind those that must be done before it.
    folder : Path
        Of the list; locked meanwhile. The system gives the lock of a killed process back.
    on_event : callable
        Gets what a task says (one at a time), or how many tasks are done (several).
    slots : int or None
        Tasks at the same time; None = one a GPU where the backend is CUDA, else one, in this process.
    threads : int or None
        CPU threads of each of several tasks; None = the cores divided among them.
    before : callable
        Called when the folder is locked.
    after_job : callable
        Called whenever a task has ended.

    Raises
    ------
    BackendError
        ``slots`` is no number of tasks.
    RunError
        Another process works in the folder.
    """
    if slots is not None and slots < 1:
        raise BackendError(f"--slots must be a whole number >= 1, got {slots}")
    make_folder(folder / "jobs")
    with RunFolder(folder).locked():
        before()
        todo = [task for task in tasks if not task.is_done()]
        gpus = gpu_count(backend)
        slots = min(slots or max(1, gpus), max(1, len(todo)))
        if slots > 1:
            fraction = threads or max(1, available_cores() // slots)
            todo = [task if task.alone else task.with_threads(fraction) for task in todo]
            _several_at_once(todo, on_event, slots, gpus, after_job)
            return
        failed: set[str] = set()
        for number, task in enumerate(todo, 1):
            if not _given_up(task, failed, on_event):
                on_event(Notice(f"job {number} of {len(todo)}: {task.name}"))
                do(task, on_event)
            failed |= {task.name} if task.outcome()["state"] == "failed" else set()
            after_job(task)


def _given_up(task: Task, failed: Collection[str], on_event: OnEvent) -> bool:
    """Give a task up that needs one which has failed now."""
    lacking = next((name for name in task.after if name in failed), None)
    if lacking is None:
        return False
    task.write("failed", reason=f"not begun: it needs {lacking}, which failed", **task.facts())
    on_event(Notice(f"{task.name} is not begun: it needs {lacking}, which failed"))
    return True


def available_cores() -> int:
    """Return the CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def gpu_count(backend: str) -> int:
    """Return the GPUs to spread jobs over; 0 where the backend does not use any."""
    if backend not in ("auto", "cuda"):
        return 0
    from gs2d.render.backends import backend_report  # loads torch

    status = {entry.name: entry for entry in backend_report()}
    if not (status.get("cuda") and status["cuda"].available):
        return 0
    import torch

    return torch.cuda.device_count()


def _several_at_once(
    tasks: Sequence[AnyTask], on_event: OnEvent, slots: int, gpus: int, after_job: Callable[[AnyTask], object]
) -> None:
    """Do tasks in a process each, ``slots`` at a time: what one leaves in memory, or dies of, is its own matter."""
    context = multiprocessing.get_context("spawn")
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    devices = visible or [str(i) for i in range(gpus)]
    waiting, running = list(tasks), dict[int, tuple[AnyTask, BaseProcess]]()
    begun, failed = dict.fromkeys((task.name for task in tasks), 0), set[str]()
    on_event(Phase("jobs", len(tasks)))
    try:
        while waiting or running:
            for task in [task for task in waiting if _given_up(task, failed, on_event)]:
                waiting.remove(task)
                failed.add(task.name)
                after_job(task)
            for slot in set(range(slots)) - running.keys():
                if (startable := _startable(waiting, running)) is None:
                    break
                waiting.remove(startable)
                begun[startable.name] += 1
                device = devices[slot % len(devices)] if gpus else None
                process: BaseProcess = context.Process(target=_do_here, args=(startable, device), daemon=True)
                process.start()
                running[slot] = startable, process
            wait([process.sentinel for _, process in running.values()], POLL_SECONDS)
            for slot, (task, process) in list(running.items()):
                if process.exitcode is None:
                    continue
                del running[slot]
                if process.exitcode < 0 and begun[task.name] <= task.retries and not task.is_done():
                    on_event(Notice(f"{task.name}: its process died ({_how(process.exitcode)}); it goes on"))
                    waiting.insert(0, task)
                    continue
                failed |= {task.name} if _has_failed(task, process.exitcode, on_event) else set()
                after_job(task)
            names = ", ".join(task.name for task, _ in running.values())
            on_event(Step(len(tasks) - len(waiting) - len(running), names))
    finally:
        left = [process for _, process in running.values()]
        for process in left:
            process.terminate()
        for process in left:
            process.join(timeout=10)


def _startable(waiting: Sequence[AnyTask], running: Mapping[int, tuple[AnyTask, BaseProcess]]) -> AnyTask | None:
    """Return the first task that waits for none, and would make nothing which another one is making."""
    busy = [task for task, _ in running.values()]
    if any(task.alone for task in busy):
        return None
    ahead = {task.name for task in (*waiting, *busy)}  # those that failed were given up with all that need them
    taken = {key for task in busy for key in task.keys_ahead()}
    ready = (task for task in waiting if not ahead & set(task.after) and not taken & task.keys())
    return next((task for task in ready if not (task.alone and busy)), None)


def _how(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"


def _has_failed(task: Task, code: int, on_event: OnEvent) -> bool:
    """Whether a task whose process has ended failed; then it is said."""
    outcome = task.outcome()
    if outcome["state"] not in ("done", "failed"):
        task.write("failed", reason=f"its process died ({_how(code)}; out of memory?)", **task.facts())
        outcome = task.outcome()
    if "reason" in outcome:
        on_event(Notice(f"{task.name} failed: {outcome['reason']}"))
    return outcome["state"] == "failed"


def _do_here(task: Task, device: str | None) -> None:
    """Do a task in a process made for it."""
    if device is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = device  # before torch loads
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    try:
        do(task)
    except KeyboardInterrupt:  # Ctrl-C reaches every process of the terminal; the parent says so
        os._exit(130)


def _leave_with_parent() -> None:
    """End this process when the one that started it is gone: nobody else would, and its lock is free again."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# -- one task ----------------------------------------------------------------------------------------------------------
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
