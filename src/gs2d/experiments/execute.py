"""Many training runs from one list: here, one after another or several at once, and restarted at any point.

What became of a job is in ``jobs/NAME.json`` under the folder of the list; a job that is done is not done again. The
folder is locked while somebody works in it. Jobs whose recipes begin with the same stages share them through the stage
cache: of several at once those wait whose next stage another one is training.
Never imports torch at the top: a process of its own chooses its GPU before torch loads.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json, write_json
from gs2d.errors import BackendError, Gs2dError
from gs2d.io.run_dir import MESH, SPLATS, RunFolder, make_folder, now
from gs2d.pipeline.events import Event, MissingFile, Notice, OnEvent, Phase, Step, ignore
from gs2d.pipeline.options import EvaluateOptions, TrainOptions

POLL_SECONDS = 0.5


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run of a list: trained, then scored.

    Attributes
    ----------
    name : str
        Unique in the list; a file name.
    record : Path
        The file that says what became of it.
    train : TrainOptions
        With ``resume``, and with the stage cache of the list.
    evaluate : EvaluateOptions or None
        What is scored beyond what training scores.
    stage_keys : tuple of str
        One for each stage; jobs with equal keys train the same stage.
    wanted : tuple of str
        What is scored, and with what: a finished job is scored again when it was scored with less.
    """

    name: str
    record: Path
    train: TrainOptions
    evaluate: EvaluateOptions | None = None
    stage_keys: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()

    def outcome(self) -> dict[str, Any]:
        """Return what became of it: ``state`` (new, running, done, failed), ``reason``, ``trained``, ``wanted``."""
        return dict(read_json(self.record)) if self.record.exists() else {"state": "new"}

    def is_trained(self) -> bool:
        """Return whether its run has splats."""
        return RunFolder(self.train.out).file(SPLATS).exists()

    def is_done(self) -> bool:
        """Return whether nothing is left to do: trained, scored with all that is wanted, and not deleted since."""
        outcome = self.outcome()
        is_scored = set(self.wanted) <= set(outcome.get("wanted", self.wanted))
        return outcome["state"] == "done" and is_scored and (self.is_trained() or not outcome.get("trained", False))

    def write(self, state: str, **facts: Any) -> None:
        """Write what became of it."""
        write_json(self.record, {"state": state, **facts, "time": time.time(), "at": now()})

    def stages_ahead(self) -> set[str]:
        """Return the keys of the stages that its run has not finished."""
        return set(self.stage_keys[len(RunFolder(self.train.out).metrics()["stages"]) :])


def failures(jobs: Sequence[Job]) -> dict[str, str]:
    """Return the reason by job, of those that failed."""
    outcomes = {job.name: job.outcome() for job in jobs}
    return {name: outcome["reason"] for name, outcome in outcomes.items() if outcome["state"] == "failed"}


def stage_keys(facts: Sequence[Any], stages: Sequence[Any]) -> tuple[str, ...]:
    """Return a key of each stage: a hash of what the runs have in common and of the stages so far (as JSON values).

    Cheaper than ``Job.stage_key`` of the pipeline, which reads the photographs, and only used to decide who waits for
    whom: a wrong one costs time, never a wrong result.
    """
    texts = (repr((list(facts), list(stages[: i + 1]))) for i in range(len(stages)))
    return tuple(hashlib.sha256(text.encode()).hexdigest()[:32] for text in texts)


# -- the list ----------------------------------------------------------------------------------------------------------
def execute(
    jobs: Sequence[Job],
    folder: Path,
    on_event: OnEvent = ignore,
    *,
    slots: int | None = None,
    threads: int | None = None,
    backend: str = "auto",
    before: Callable[[], None] = lambda: None,
    after_job: Callable[[Job], object] = lambda _job: None,
) -> None:
    """Do the jobs of a list that are not done; one that fails is written down, and the others go on.

    Parameters
    ----------
    jobs : sequence of Job
    folder : Path
        Of the list; locked meanwhile. The system gives the lock of a killed process back.
    on_event : callable
        Gets what training says (one at a time), or how many jobs are done (several).
    slots : int or None
        Runs at the same time; None = one a GPU where the backend is CUDA, else one, in this process.
    threads : int or None
        CPU threads of each of several runs; None = the cores divided among them.
    before : callable
        Called when the folder is locked.
    after_job : callable
        Called whenever a job has ended.

    Raises
    ------
    BackendError
        ``slots`` is no number of runs.
    RunError
        Another process works in the folder.
    """
    if slots is not None and slots < 1:
        raise BackendError(f"--slots must be a whole number >= 1, got {slots}")
    make_folder(folder / "jobs")
    with RunFolder(folder).locked():
        before()
        todo = [job for job in jobs if not job.is_done()]
        gpus = gpu_count(backend)
        slots = min(slots or max(1, gpus), max(1, len(todo)))
        if slots > 1:
            fraction = threads or max(1, available_cores() // slots)
            todo = [replace(job, train=replace(job.train, threads=fraction)) for job in todo]
            _several_at_once(todo, on_event, slots, gpus, after_job)
            return
        for number, job in enumerate(todo, 1):
            on_event(Notice(f"job {number} of {len(todo)}: {job.name}"))
            do(job, on_event)
            after_job(job)


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
    jobs: Sequence[Job], on_event: OnEvent, slots: int, gpus: int, after_job: Callable[[Job], object]
) -> None:
    """Do jobs in a process each, ``slots`` at a time: what one leaves in memory, or dies of, is its own matter."""
    context = multiprocessing.get_context("spawn")
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    devices = visible or [str(i) for i in range(gpus)]
    waiting, running = list(jobs), dict[int, tuple[Job, BaseProcess]]()
    on_event(Phase("jobs", len(jobs)))
    try:
        while waiting or running:
            for slot in set(range(slots)) - running.keys():
                if (job := _startable(waiting, running)) is None:
                    break
                waiting.remove(job)
                device = devices[slot % len(devices)] if gpus else None
                process: BaseProcess = context.Process(target=_do_here, args=(job, device), daemon=True)
                process.start()
                running[slot] = job, process
            wait([process.sentinel for _, process in running.values()], POLL_SECONDS)
            for slot, (job, process) in list(running.items()):
                if process.exitcode is not None:
                    del running[slot]
                    _end(job, process.exitcode, on_event)
                    after_job(job)
            names = ", ".join(job.name for job, _ in running.values())
            on_event(Step(len(jobs) - len(waiting) - len(running), names))
    finally:
        left = [process for _, process in running.values()]
        for process in left:
            process.terminate()
        for process in left:
            process.join(timeout=10)


def _startable(waiting: Sequence[Job], running: Mapping[int, tuple[Job, BaseProcess]]) -> Job | None:
    """Return the first job that would train no stage which another one is training."""
    taken = {key for job, _ in running.values() for key in job.stages_ahead()}
    return next((job for job in waiting if not taken & set(job.stage_keys)), None)


def _end(job: Job, code: int, on_event: OnEvent) -> None:
    """Say of a job whose process has ended that it failed, if it did."""
    outcome = job.outcome()
    if outcome["state"] not in ("done", "failed"):
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        outcome = {"reason": f"its process died ({how}; out of memory?)", "trained": job.is_trained()}
        job.write("failed", **outcome)
    if "reason" in outcome:
        on_event(Notice(f"{job.name} failed: {outcome['reason']}"))


def _do_here(job: Job, device: str | None) -> None:
    """Do a job in a process made for it."""
    if device is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = device  # before torch loads
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    try:
        do(job)
    except KeyboardInterrupt:  # Ctrl-C reaches every process of the terminal; the parent says so
        os._exit(130)


def _leave_with_parent() -> None:
    """End this process when the one that started it is gone: nobody else would, and its lock is free again."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# -- one job -----------------------------------------------------------------------------------------------------------
def do(job: Job, on_event: OnEvent = ignore) -> None:
    """Train and score one run; what goes wrong is written down."""
    job.write("running")
    try:
        notes = train_and_evaluate(job, on_event)
    except Exception as error:
        is_ours = not isinstance(error, Gs2dError)
        text = " ".join(str(error).split())
        reason = f"{type(error).__name__}: {error}" if is_ours else text or type(error).__name__
        more = {"traceback": traceback.format_exc()} if is_ours else {}
        # Where it was trained, its pictures were scored, and those scores stand.
        job.write("failed", reason=reason, trained=job.is_trained(), **more)
        on_event(Notice(f"{job.name} failed: {reason}"))
        return
    job.write("done", notes=notes, wanted=list(job.wanted), trained=job.is_trained())


def train_and_evaluate(job: Job, on_event: OnEvent) -> dict[str, str]:
    """Train and score one run; returns what could not be had, with reasons (``surface``).

    Raises
    ------
    Gs2dError
        The run itself failed.
    """
    from gs2d.pipeline.evaluate import evaluate_run
    from gs2d.pipeline.train import train

    missing: list[MissingFile] = []

    def listen(event: Event) -> None:
        missing.extend([event] if isinstance(event, MissingFile) else [])
        on_event(event)

    train(job.train, listen)
    no_mesh = [event.reason for event in missing if event.what == MESH]
    evaluate = job.evaluate
    if evaluate is not None and no_mesh:  # nothing to compare with a true surface
        weights = evaluate.lpips_weights
        evaluate = None if weights is None else EvaluateOptions(lpips_weights=weights)
    if evaluate is not None:
        evaluate_run(job.train.out, evaluate, on_event, threads=job.train.threads)
    return {"surface": f"no mesh: {no_mesh[0]}"} if no_mesh else {}
