"""A sweep on this machine's GPUs or CPU slots, or on Slurm: who works where."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from multiprocessing.process import BaseProcess
from typing import Any

from gs2d.errors import BackendError, RunError
from gs2d.experiments.execute import MAX_DEATHS, Sweep, SweepJob, watch, work
from gs2d.experiments.slurm import run_on_slurm
from gs2d.pipeline.events import OnEvent


def run_sweep(
    sweep: Sweep,
    on_event: OnEvent,
    *,
    slots: int | None = None,
    threads: int | None = None,
    backend: str = "auto",
    slurm: Mapping[str, Any] | None = None,
    after_job: Callable[[SweepJob], None] = lambda _job: None,
) -> None:
    """Do all jobs of a sweep; returns when all are settled, also those of other processes with the same folder.

    Parameters
    ----------
    sweep : Sweep
    on_event : callable
        Gets what training says (one slot), or how many jobs are done (several).
    slots : int or None
        Processes on this machine; None = one a GPU where the backend is CUDA, else one, in this process.
    threads : int or None
        CPU threads of each slot; None = the cores divided among the slots.
    slurm : mapping, optional
        Parameters of submitit's executor: the slots are Slurm jobs instead.
    after_job : callable
        Called whenever a job is settled.

    Raises
    ------
    BackendError
        ``slots`` is no number, or submitit is not installed.
    """
    if slots is not None and slots < 1:
        raise BackendError(f"--slots must be a whole number >= 1, got {slots}")
    if slurm is not None:
        run_on_slurm(sweep, on_event, slots=slots or 1, parameters=slurm, after_job=after_job)
        return
    gpus = gpu_count(backend)
    slots = min(slots or max(1, gpus), max(1, len(sweep.jobs)))
    if slots == 1:
        work(sweep, on_event, after_job=after_job)
        return
    share = threads or max(1, available_cores() // slots)
    divided = replace(sweep, jobs=tuple(replace(job, train=replace(job.train, threads=share)) for job in sweep.jobs))
    _local(divided, on_event, slots, gpus, after_job)


def available_cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def gpu_count(backend: str) -> int:
    """GPUs to spread jobs over; 0 where the backend does not use any."""
    if backend not in ("auto", "cuda"):
        return 0
    from gs2d.render.backends import backend_report

    status = {entry.name: entry for entry in backend_report()}
    if not (status.get("cuda") and status["cuda"].available):
        return 0
    import torch

    return torch.cuda.device_count()


def _slot(sweep: Sweep, device: str | None) -> None:
    """The body of a slot's process."""
    if device is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = device  # before torch loads
    try:
        work(sweep)
    except KeyboardInterrupt:  # Ctrl-C reaches every process of the terminal; the parent says so
        os._exit(130)


def _local(sweep: Sweep, on_event: OnEvent, slots: int, gpus: int, after_job: Callable[[SweepJob], None]) -> None:
    """Slots as processes of this machine; a slot whose process dies is started again."""
    context = multiprocessing.get_context("spawn")
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    devices = visible or [str(i) for i in range(gpus)]

    def start(index: int) -> BaseProcess:
        device = devices[index % len(devices)] if gpus else None
        process = context.Process(target=_slot, args=(sweep, device), daemon=True, name=f"gs2d-slot-{index}")
        process.start()
        return process

    processes, deaths = [start(index) for index in range(slots)], list[int]()
    try:
        watch(sweep, on_event, after_job, lambda: revive(sweep, processes, start, deaths))
    finally:
        for process in processes:
            if process.is_alive():
                process.terminate()
        for process in processes:
            process.join(timeout=10)


def revive(sweep: Sweep, processes: list[BaseProcess], start: Callable[[int], BaseProcess], deaths: list[int]) -> None:
    """Start dead slots again while there is work; ``deaths`` collects their exit codes.

    Raises
    ------
    RunError
        They die more often than jobs can explain: something is wrong with the machine, not with a job.
    """
    if not sweep.unsettled():
        return
    for index, process in enumerate(processes):
        if not process.is_alive():
            process.join()
            deaths.append(process.exitcode or 0)
            if len(deaths) > MAX_DEATHS * len(sweep.jobs):
                raise RunError(
                    f"{len(deaths)} processes of --slots died (the last with exit code {deaths[-1]}); "
                    "try --slots 1, which shows why"
                )
            processes[index] = start(index)
