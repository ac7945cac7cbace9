"""Runs tasks on the machines of a Ray cluster with a shared disk.

Ray selects the machine of a task and repeats tasks of lost machines. Files are on the shared disk; Ray transfers only
the tasks, their events and their results, a few hundred bytes each.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import secrets
import signal
import socket
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gs2d
from gs2d.contrib.lab import cluster_worker
from gs2d.contrib.lab.cluster_task import Begun, token_file
from gs2d.contrib.lab.task_order import Executor
from gs2d.contrib.lab.tasks import AnyTask, Task
from gs2d.core.extras import install
from gs2d.errors import BackendError
from gs2d.training.events import Event, Notice, NotMade, OnEvent, Phase, StageScored, Step

RETRIES = 2  # minimum for a task whose machine or process is lost
CONNECT_SECONDS, TCP_SECONDS = 60.0, 5.0
POLL_SECONDS, GOODBYE_SECONDS = 0.5, 15.0
# ray.init tries for minutes in C++ and cannot be interrupted, so it is tried in another process first.
PROBE = """
import logging, os, sys
try:
    import ray
    ray.init(address=sys.argv[1], log_to_driver=False, logging_level=logging.CRITICAL)
except BaseException as error:
    print(type(error).__name__, " ".join(str(error).split()), sep=": ", flush=True)
    os._exit(1)
ray.shutdown()
"""


# -- connection --------------------------------------------------------------------------------------------------------
def check_address(address: str) -> None:
    """Raise if an address is invalid, or nothing listens there."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if "/" in address or not host or not (port.isdecimal() and 0 < int(port) < 1 << 16):
        raise BackendError(
            f"--cluster must be auto, or HOST:PORT as `ray start --head` prints it, got {address!r}; this machine must "
            "be one of the cluster's"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=TCP_SECONDS).close()
    except OSError as error:
        raise BackendError(
            f"no Ray cluster at {address} ({error.strerror or error}); start one with `ray start --head`, or check the "
            "address"
        ) from None


def check_cluster(address: str) -> None:
    """Connect to a cluster in another process, in limited time; BackendError if no Ray answers, or another version."""
    try:
        probe = subprocess.run(
            [sys.executable, "-c", PROBE, address], capture_output=True, text=True, timeout=CONNECT_SECONDS
        )
    except subprocess.TimeoutExpired:
        raise BackendError(
            f"no Ray cluster answers at {address} within {CONNECT_SECONDS:.0f} s; check the address, and that this "
            "machine is one of the cluster's (`ray status`)"
        ) from None
    if probe.returncode:
        output = (probe.stdout.splitlines() or [f"exit code {probe.returncode}"])[-1]
        raise BackendError(
            f"no Ray cluster can be used at {address}: {output[:300]}; start one with `ray start --head`, join it from "
            "this machine with `ray start --address HOST:PORT`"
        )


def connect(address: str) -> tuple[Any, bool]:
    """Return the connected ``ray`` module, and whether this call connected it."""
    try:
        import ray
    except ImportError:
        raise BackendError(f"--cluster needs Ray, which is not installed; {install('cluster')}") from None
    if ray.is_initialized():  # by the calling program
        return ray, False
    check_address(address)
    check_cluster(address)
    before = signal.getsignal(signal.SIGTERM)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ray.init(address=address, log_to_driver=False, logging_level=logging.CRITICAL)
    except Exception as error:
        raise BackendError(f"no Ray cluster can be used at {address}: {' '.join(str(error).split())[:300]}") from None
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)  # Ray replaces the handler
    return ray, True


# -- resources ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Shares:
    """Resources of a task."""

    cores: int  # CPU threads of a task
    alone: int  # CPU threads of a task that runs alone
    gpus: int  # 0 or 1

    def of(self, task: Task) -> dict[str, Any]:
        """Return the resources of a task by Ray's names."""
        gpus = self.gpus if task.gpu else 0
        resources: dict[str, Any] = {"num_cpus": self.alone if task.alone else self.cores, "num_gpus": gpus}
        return resources if task.memory is None else {**resources, "memory": int(task.memory * 2**30)}


def shares(
    nodes: Sequence[Mapping[str, float]], backend: str, slots: int | None, threads: int | None, address: str
) -> Shares:
    """Return the resources of tasks on machines with these resources (``CPU``, ``GPU``, ``memory``).

    Raises BackendError if no machine has a CPU, or a GPU that the backend needs.
    """
    gpus = int(backend == "cuda" or (backend == "auto" and any(node.get("GPU", 0) >= 1 for node in nodes)))
    able = [node for node in nodes if node.get("CPU", 0) >= 1 and node.get("GPU", 0) >= gpus]
    if not able:
        there = f"{len(nodes)} with {_sum(nodes, 'CPU'):g} CPUs and {_sum(nodes, 'GPU'):g} GPUs"
        raise BackendError(
            f"the cluster at {address} must have a machine with a CPU{' and a GPU' if gpus else ''} for tasks, got "
            f"{there}; start them with `ray start --address`, or choose another --backend"
        )
    cores = int(min(node["CPU"] for node in able))
    if threads is not None:
        return Shares(threads, threads, gpus)
    each = cores // int(max(node["GPU"] for node in able)) if gpus else cores
    if slots is not None:
        each = min(each, int(_sum(able, "CPU")) // slots)
    return Shares(max(1, each), cores, gpus)


def _sum(nodes: Sequence[Mapping[str, float]], name: str) -> float:
    return sum(node.get(name, 0.0) for node in nodes)


def check_room(nodes: Sequence[Mapping[str, float]], resources: Mapping[str, Any], name: str) -> None:
    """Raise for a task that fits on no machine, for which Ray would wait forever."""
    required = {"CPU": resources["num_cpus"], "GPU": resources["num_gpus"], "memory": resources.get("memory", 0)}
    if not any(all(node.get(key, 0) >= value for key, value in required.items()) for node in nodes):
        memory = f" and {required['memory'] / 2**30:.3g} GiB" if required["memory"] else ""
        there = "; ".join(
            f"{node.get('CPU', 0):g} CPUs, {node.get('GPU', 0):g} GPUs, {node.get('memory', 0) / 2**30:.3g} GiB"
            for node in nodes
        )
        raise BackendError(
            f"{name} fits on no machine of the cluster: it takes {required['CPU']} CPUs, {required['GPU']} GPUs"
            f"{memory}, the machines have {there}; use fewer --threads or less --memory"
        )


# -- the executor ------------------------------------------------------------------------------------------------------
def cluster_executor(
    address: str, folder: Path, tasks: Sequence[Task], *, slots: int | None, threads: int | None, backend: str
) -> OnCluster[Any]:
    """Return an executor on a cluster; BackendError if the cluster cannot be used, or a task fits on no machine."""
    ray, owned = connect(address)
    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        task_shares = shares(nodes, backend, slots, threads, address)
        for task in tasks:
            check_room(nodes, task_shares.of(task), task.name)
        return OnCluster(ray, folder, task_shares, slots or len(tasks), ray.shutdown if owned else lambda: None)
    except BaseException:
        if owned:
            ray.shutdown()
        raise


class OnCluster(Executor[AnyTask]):
    """Runs each task as a Ray task in its own process."""

    def __init__(self, ray: Any, folder: Path, task_shares: Shares, slots: int, leave: Callable[[], None]) -> None:
        from ray.util.queue import Queue
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray, self._folder, self._shares, self._slots, self._leave = ray, folder, task_shares, slots, leave
        ray.cloudpickle.register_pickle_by_value(cluster_worker)
        self._remote = ray.remote(max_calls=1)(cluster_worker.do_on_worker)
        # On this machine, as other machines can be lost.
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self._queue = Queue(actor_options={"num_cpus": 0, "scheduling_strategy": here})
        self._running: dict[Any, AnyTask] = {}
        self._progress: dict[str, TaskProgress] = {}
        self._token, self._stopped = secrets.token_hex(8), False

    def fitted(self, task: AnyTask) -> AnyTask:
        """Return a task with the number of CPU threads of its resources."""
        return task.with_threads(self._shares.of(task)["num_cpus"])

    def running(self) -> Sequence[AnyTask]:
        """Return the tasks that were submitted to Ray, including waiting ones."""
        return list(self._running.values())

    def has_room(self) -> bool:
        """Return whether another task can be submitted to Ray, where it may wait."""
        return len(self._running) < self._slots

    def start(self, task: AnyTask) -> None:
        """Submit a task to Ray."""
        token_file(self._folder, self._token).touch()
        order = {
            "name": task.name,
            "task": pickle.dumps(task),
            "version": gs2d.__version__,
            "folder": str(self._folder),
            "token": self._token,
            "cwd": os.getcwd(),
        }
        remote = self._remote.options(
            name=task.name,
            max_retries=_retries(task),
            scheduling_strategy="SPREAD",
            **self._shares.of(task),
        )
        self._running[remote.remote(order, self._queue)] = task

    def wait(self, on_event: OnEvent) -> list[tuple[AnyTask, bool]]:
        """Wait for a task to end, and pass on events of all tasks; BackendError if a machine cannot run any task."""
        refs = list(self._running)
        self._ray.wait(refs, num_returns=1, timeout=POLL_SECONDS)
        ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
        for name, event in self._new_events():
            self._pass_on(name, event, on_event)
        for ref, task in self._running.items():  # Ray restarts tasks without memory forever
            if ref not in ready and self._progress.get(task.name, TaskProgress()).begun > 1 + _retries(task):
                self._ray.cancel(ref, force=True)
        ended = []
        for ref in ready:
            task = self._running[ref]
            status = self._status(ref, task)
            if status["state"] == "refused":
                raise BackendError(status["reason"])
            del self._running[ref]
            self._progress.pop(task.name, None)
            with contextlib.suppress(OSError):
                os.listdir(task.record.parent)  # refreshes the cache of NFS
            if "reason" in status:
                on_event(Notice(f"{task.name} failed: {status['reason']}"))
            ended.append((task, status["state"] == "failed"))
        return ended

    def _new_events(self) -> list[tuple[str, Event | Begun]]:
        """Return the events of tasks since the last call."""
        size = self._queue.size()
        return list(self._queue.get_nowait_batch(size)) if size else []

    def _status(self, ref: Any, task: AnyTask) -> dict[str, Any]:
        """Return the status of a task that has ended."""
        try:
            return dict(self._ray.get(ref))
        except Exception as error:  # its last machine was lost, or it could not start
            kind = type(error).__name__
            lost = "its process or machine was lost repeatedly, or ran out of memory"
            words = " ".join(str(error).split())[-200:]
            reason = f"{lost} ({kind})" if kind in LOST else f"{kind}: {words}"
            task.write("failed", reason=reason, **task.details())
            return task.status()

    def _pass_on(self, name: str, event: Event | Begun, on_event: OnEvent) -> None:
        """Pass on an event of a task, with the name of the task."""
        at = self._progress.setdefault(name, TaskProgress())
        if isinstance(event, Begun):
            if at.host:
                on_event(Notice(f"{name}: its process or machine ({at.host}) was lost; it continues on {event.host}"))
            else:
                on_event(Notice(f"{name} starts on {event.host}"))
            at.host, at.begun = event.host, at.begun + 1
        elif isinstance(event, Phase):
            at.phase, at.total, at.done = event.name, event.total, event.done
        elif isinstance(event, Step):
            at.done = event.done
        elif isinstance(event, Notice) and not event.text.startswith(f"{name} failed: "):  # reported at the end
            on_event(Notice(f"{name}: {event.text}", event.detail))
        elif isinstance(event, StageScored):
            on_event(Notice(f"{name}: {event.line()}"))
        elif isinstance(event, NotMade):
            on_event(event)

    def detail(self) -> str:
        """Return the progress of all started tasks."""
        return ", ".join(f"{name}{at.words()}" for name, at in self._progress.items() if at.host)

    def stop(self) -> None:
        """Cancel running tasks, first gently so that they save a checkpoint, and disconnect; only once."""
        if self._stopped:
            return
        self._stopped = True
        refs = list(self._running)
        try:
            for force in (False, True) if refs else ():
                for ref in refs:
                    with contextlib.suppress(Exception):  # it has just ended
                        self._ray.cancel(ref, force=force)
                _, refs = self._ray.wait(refs, num_returns=len(refs), timeout=GOODBYE_SECONDS) if refs else ([], [])
                if not refs:
                    break
        finally:
            with contextlib.suppress(OSError):
                token_file(self._folder, self._token).unlink()
            with contextlib.suppress(Exception):
                self._queue.shutdown(force=True)
            self._leave()


LOST = ("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError", "LocalRayletDiedError", "TaskCancelledError")


def _retries(task: Task) -> int:
    return max(task.retries, RETRIES)


@dataclass
class TaskProgress:
    """Progress of a task and the machine it runs on."""

    host: str = ""
    begun: int = 0
    phase: str = ""
    total: int = 0
    done: int = 0

    def words(self) -> str:
        """Return the progress as text: `` (surface 40 %)``."""
        if not self.phase:
            return ""
        return f" ({self.phase} {100 * self.done // self.total} %)" if self.total else f" ({self.phase})"
