"""Many tasks from one list: one after another, several at once, or on a cluster, and restarted at any point.

The folder of the list is locked while somebody works in it.
Never imports torch at the top: a process of its own chooses its GPU before torch loads.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from gs2d.contrib.lab.task_order import Executor, given_up, several_at_once
from gs2d.contrib.lab.tasks import AnyTask, Task, do
from gs2d.errors import BackendError
from gs2d.io.run_dir import RunFolder, make_folder
from gs2d.training.events import Notice, OnEvent, ignore

POLL_SECONDS = 0.5


def execute(
    tasks: Sequence[AnyTask],
    folder: Path,
    on_event: OnEvent = ignore,
    *,
    slots: int | None = None,
    threads: int | None = None,
    backend: str = "auto",
    cluster: str | None = None,
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
        Tasks at the same time; None = one a GPU where the backend is CUDA, else one, in this process; on a cluster as
        many as it has room for.
    threads : int or None
        CPU threads of each of several tasks; None = the cores divided among them.
    cluster : str or None
        Address of a Ray cluster that does the tasks: ``HOST:PORT``, or ``auto``, the one that this machine is of.
    before : callable
        Called when the folder is locked.
    after_job : callable
        Called whenever a task has ended.

    Raises
    ------
    BackendError
        ``slots`` is no number of tasks; the cluster cannot be had, or not be used.
    RunError
        Another process works in the folder.
    """
    if slots is not None and slots < 1:
        raise BackendError(f"--slots must be a whole number >= 1, got {slots}")
    with contextlib.ExitStack() as held:
        ray = None
        if cluster is not None and (todo := [task for task in tasks if not task.is_done()]):
            from gs2d.contrib.lab.cluster import cluster_executor  # loads Ray

            # A cluster that cannot be had leaves no folder behind.
            ray = cluster_executor(cluster, folder, todo, slots=slots, threads=threads, backend=backend)
            held.callback(ray.stop)
        make_folder(folder / "jobs")
        held.enter_context(RunFolder(folder).locked())
        before()
        todo = [task for task in tasks if not task.is_done()]
        if cluster is not None:
            if ray is not None:
                several_at_once([ray.fitted(task) for task in todo], ray, on_event, after_job)
            return
        gpus = gpu_count(backend)
        slots = min(slots or max(1, gpus), max(1, len(todo)))
        if slots > 1:
            fraction = threads or max(1, available_cores() // slots)
            todo = [task if task.alone else task.with_threads(fraction) for task in todo]
            several_at_once(todo, Processes(slots, gpus), on_event, after_job)
            return
        failed: set[str] = set()
        for number, task in enumerate(todo, 1):
            if not given_up(task, failed, on_event):
                on_event(Notice(f"job {number} of {len(todo)}: {task.name}"))
                do(task, on_event)
            failed |= {task.name} if task.outcome()["state"] == "failed" else set()
            after_job(task)


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


# -- processes of this machine -----------------------------------------------------------------------------------------
class Processes(Executor[AnyTask]):
    """A process for each task: what one leaves in memory, or dies of, is its own matter."""

    def __init__(self, slots: int, gpus: int) -> None:
        visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
        self._devices = (visible or [str(i) for i in range(gpus)]) if gpus else []
        self._slots = slots
        self._context = multiprocessing.get_context("spawn")
        self._running: dict[int, tuple[AnyTask, BaseProcess]] = {}
        self._begun: dict[str, int] = {}

    def running(self) -> Sequence[AnyTask]:
        """Return the tasks that have a process."""
        return [task for task, _ in self._running.values()]

    def has_room(self) -> bool:
        """Return whether a slot is free."""
        return len(self._running) < self._slots

    def start(self, task: AnyTask) -> None:
        """Begin a task in the first free slot, on its GPU."""
        self._begin(next(slot for slot in range(self._slots) if slot not in self._running), task)

    def _begin(self, slot: int, task: AnyTask) -> None:
        self._begun[task.name] = self._begun.get(task.name, 0) + 1
        device = self._devices[slot % len(self._devices)] if self._devices else None
        process: BaseProcess = self._context.Process(target=_do_here, args=(task, device), daemon=True)
        process.start()
        self._running[slot] = task, process

    def wait(self, on_event: OnEvent) -> list[tuple[AnyTask, bool]]:
        """Wait for a process to end; one that was killed is begun again, as often as its task says."""
        wait([process.sentinel for _, process in self._running.values()], POLL_SECONDS)
        ended = []
        for slot, (task, process) in list(self._running.items()):
            if process.exitcode is None:
                continue
            del self._running[slot]
            if process.exitcode < 0 and self._begun[task.name] <= task.retries and not task.is_done():
                on_event(Notice(f"{task.name}: its process died ({_how(process.exitcode)}); it goes on"))
                self._begin(slot, task)
                continue
            ended.append((task, _has_failed(task, process.exitcode, on_event)))
        return ended

    def stop(self) -> None:
        """End the processes."""
        left = [process for _, process in self._running.values()]
        for process in left:
            process.terminate()
        for process in left:
            process.join(timeout=10)


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
