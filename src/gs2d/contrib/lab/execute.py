"""Runs tasks one after another, in parallel processes, or on a cluster. Interrupted tasks continue when run again.

Imports torch only in functions, because a process selects its GPU before torch loads.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from gs2d.contrib.lab.task_order import Executor, given_up, several_at_once
from gs2d.contrib.lab.tasks import AnyTask, Task, do
from gs2d.core.processes import available_cores
from gs2d.errors import BackendError
from gs2d.io.run_dir import RunFolder, make_folder
from gs2d.training.events import Notice, OnEvent, ignore

POLL_SECONDS = 0.5


@dataclass(frozen=True)
class Workers:
    """Where and with which resources tasks run; the fields are options of `gs2d sweep` and `blocks`."""

    # Number of parallel tasks; None: one per GPU if the backend is CUDA, else one, in this process; on a cluster, as
    # many as fit.
    slots: int | None = None
    threads: int | None = None  # CPU threads of each parallel task; None: the cores divided by the number of tasks
    backend: str = "auto"
    # Address of a Ray cluster, ``HOST:PORT`` or ``auto`` for the cluster of this machine; None: this machine.
    cluster: str | None = None


def execute(
    tasks: Sequence[AnyTask],
    folder: Path,
    on_event: OnEvent = ignore,
    *,
    workers: Workers = Workers(),
    before: Callable[[], None] = lambda: None,
    after_task: Callable[[AnyTask], object] = lambda _task: None,
) -> None:
    """Run all unfinished tasks, each after those that it needs; a failure is recorded, and the other tasks continue.

    ``folder``, the output folder of the tasks, is locked while they run; the operating system releases the lock of a
    killed process. ``on_event`` receives the events of a single task, or the progress of several tasks. ``before`` is
    called when the folder is locked. Raises BackendError if the number of slots is invalid, or the cluster cannot be
    used, and RunError if another process works in the folder.
    """
    slots, cluster = workers.slots, workers.cluster
    if slots is not None and slots < 1:
        raise BackendError(f"--set slots must be a whole number >= 1, got {slots}")
    with contextlib.ExitStack() as held:
        ray = None
        if cluster is not None and (todo := [task for task in tasks if not task.is_done()]):
            from gs2d.contrib.lab.cluster import cluster_executor  # loads Ray

            # First, so that an unusable cluster leaves no folder behind.
            ray = cluster_executor(cluster, folder, todo, slots=slots, threads=workers.threads, backend=workers.backend)
            held.callback(ray.stop)
        make_folder(folder / "jobs")
        held.enter_context(RunFolder(folder).locked())
        before()
        todo = [task for task in tasks if not task.is_done()]
        if cluster is not None:
            if ray is not None:
                several_at_once([ray.fitted(task) for task in todo], ray, on_event, after_task)
            return
        gpus = gpu_count(workers.backend)
        slots = min(slots or max(1, gpus), max(1, len(todo)))
        if slots > 1:
            threads = workers.threads or max(1, available_cores() // slots)
            todo = [task if task.alone else task.with_threads(threads) for task in todo]
            several_at_once(todo, Processes(slots, gpus), on_event, after_task)
            return
        failed: set[str] = set()
        for number, task in enumerate(todo, 1):
            if not given_up(task, failed, on_event):
                on_event(Notice(f"task {number} of {len(todo)}: {task.name}"))
                do(task, on_event)
            failed |= {task.name} if task.status()["state"] == "failed" else set()
            after_task(task)


def gpu_count(backend: str) -> int:
    """Return the number of GPUs for tasks; 0 if the backend uses none."""
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
    """Runs each task in a process, so that its memory is freed and its crash ends nothing else."""

    def __init__(self, slots: int, gpus: int) -> None:
        visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
        self._devices = (visible or [str(i) for i in range(gpus)]) if gpus else []
        self._slots = slots
        self._context = multiprocessing.get_context("spawn")
        self._running: dict[int, tuple[AnyTask, BaseProcess]] = {}
        self._begun: dict[str, int] = {}

    def running(self) -> Sequence[AnyTask]:
        """Return the tasks with a process."""
        return [task for task, _ in self._running.values()]

    def has_room(self) -> bool:
        """Return whether a slot is free."""
        return len(self._running) < self._slots

    def start(self, task: AnyTask) -> None:
        """Start a task in the first free slot, on the GPU of the slot."""
        self._begin(next(slot for slot in range(self._slots) if slot not in self._running), task)

    def _begin(self, slot: int, task: AnyTask) -> None:
        self._begun[task.name] = self._begun.get(task.name, 0) + 1
        device = self._devices[slot % len(self._devices)] if self._devices else None
        process: BaseProcess = self._context.Process(target=_do_here, args=(task, device), daemon=True)
        process.start()
        self._running[slot] = task, process

    def wait(self, on_event: OnEvent) -> list[tuple[AnyTask, bool]]:
        """Wait for a process to end; a killed process is restarted, ``Task.retries`` times."""
        wait([process.sentinel for _, process in self._running.values()], POLL_SECONDS)
        ended = []
        for slot, (task, process) in list(self._running.items()):
            if process.exitcode is None:
                continue
            del self._running[slot]
            if process.exitcode < 0 and self._begun[task.name] <= task.retries and not task.is_done():
                on_event(Notice(f"{task.name}: its process died ({_how(process.exitcode)}); restarted"))
                self._begin(slot, task)
                continue
            ended.append((task, _has_failed(task, process.exitcode, on_event)))
        return ended

    def stop(self) -> None:
        """End all processes."""
        processes = [process for _, process in self._running.values()]
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(timeout=10)


def _how(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"


def _has_failed(task: Task, code: int, on_event: OnEvent) -> bool:
    """Return whether a task whose process has ended has failed; report the failure."""
    status = task.status()
    if status["state"] not in ("done", "failed"):
        task.write("failed", reason=f"its process died ({_how(code)}; out of memory?)", **task.details())
        status = task.status()
    if "reason" in status:
        on_event(Notice(f"{task.name} failed: {status['reason']}"))
    return status["state"] == "failed"


def _do_here(task: Task, device: str | None) -> None:
    """Run a task in its own process."""
    if device is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = device  # before torch loads
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    try:
        do(task)
    except KeyboardInterrupt:  # Ctrl-C reaches all processes; the parent reports it
        os._exit(130)


def _leave_with_parent() -> None:
    """Exit when the parent process ends, as its lock on the folder is released."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
