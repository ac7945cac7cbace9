"""Many training runs from one list, worked off by any number of processes, and restarted at any point.

Everything is on disk, under the sweep's folder: ``jobs/NAME.json`` (what became of a job) and ``jobs/NAME.claim``
(who works on it). Jobs whose recipes begin with the same stages share them through the stage cache; a stage that one
process trains is claimed in ``CACHE/claims``, and jobs that need it wait for it instead of training it again.
Never imports torch at the top: a slot chooses its GPU before torch loads.
"""

from __future__ import annotations

import hashlib
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json, write_json
from gs2d.errors import Gs2dError
from gs2d.experiments.claims import FOREIGN_SECONDS, Claim, holder, take_claim
from gs2d.io.run_dir import MESH, SPLATS, RunFolder, make_folder, now
from gs2d.pipeline.events import Event, Missing, Notice, OnEvent, Phase, StageDone, Step, ignore
from gs2d.pipeline.options import EvaluateOptions, TrainOptions

MAX_DEATHS = 3  # so often may the process of a job die before the job counts as failed
POLL_SECONDS = 0.5


@dataclass(frozen=True, kw_only=True)
class SweepJob:
    """One run: trained, then scored.

    Attributes
    ----------
    name : str
        Unique in the sweep; a file name.
    train : TrainOptions
        With ``resume``, and with the sweep's cache.
    evaluate : EvaluateOptions or None
        What is scored beyond what training scores.
    stage_keys : tuple of str
        One for each stage; jobs with equal keys train the same stage.
    wanted : tuple of str
        What is scored, and with what: a finished job is scored again when it was scored with less.
    """

    name: str
    train: TrainOptions
    evaluate: EvaluateOptions | None = None
    stage_keys: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A list of jobs and where it is worked off.

    Attributes
    ----------
    folder : Path
    jobs : tuple of SweepJob
    cache : Path
        The stage cache of all jobs.
    started : float
        Time (seconds since 1970) of this command: what failed before it is tried again.
    """

    folder: Path
    jobs: tuple[SweepJob, ...]
    cache: Path
    started: float = field(default_factory=time.time)

    def record_file(self, job: SweepJob) -> Path:
        """Where it is written what became of a job."""
        return self.folder / "jobs" / f"{job.name}.json"

    def claim_file(self, job: SweepJob) -> Path:
        """Where a process says that it works on a job."""
        return self.folder / "jobs" / f"{job.name}.claim"

    def record(self, job: SweepJob) -> dict[str, Any]:
        """What became of a job: ``state`` (new, running, done, failed), ``reason``, ``trained``, ``deaths``."""
        path = self.record_file(job)
        return dict(read_json(path)) if path.exists() else {"state": "new"}

    def settled(self, job: SweepJob) -> bool:
        """Whether nothing is left to do for a job in this command."""
        record = self.record(job)
        if record["state"] == "done":
            gone = record.get("trained", False) and not is_trained(job)
            scored = set(job.wanted) <= set(record.get("wanted", job.wanted))
            return not gone and (scored or record["time"] >= self.started)
        return record["state"] == "failed" and record["time"] >= self.started

    def unsettled(self) -> list[SweepJob]:
        """Jobs that are not settled, in order."""
        return [job for job in self.jobs if not self.settled(job)]

    def failures(self) -> dict[str, str]:
        """Reason by job, of those that failed."""
        records = {job.name: self.record(job) for job in self.jobs}
        return {name: record["reason"] for name, record in records.items() if record["state"] == "failed"}


def is_trained(job: SweepJob) -> bool:
    """Whether the run of a job has its splats."""
    return RunFolder(job.train.out).file(SPLATS).exists()


def stage_keys(facts: Sequence[Any], stages: Sequence[Any]) -> tuple[str, ...]:
    """A key of each stage: a hash of what the runs have in common and of the stages so far (as JSON values).

    Cheaper than ``Job.stage_key``, which reads the photographs, and only used to decide who waits for whom: a wrong
    one costs time, never a wrong result.
    """
    return tuple(
        hashlib.sha256(repr((list(facts), list(stages[: i + 1]))).encode()).hexdigest()[:32] for i in range(len(stages))
    )


# -- stages that jobs share ----------------------------------------------------------------------------------------
class StageClaims:
    """The claims of one job on the stages it is going to train."""

    def __init__(self, folder: Path, keys: Sequence[str]) -> None:
        self._folder, self._keys = folder, keys
        self._held: dict[int, Claim] = {}

    def _done(self, index: int) -> Path:
        return self._folder / f"{self._keys[index]}.done"

    def take(self) -> bool:
        """Claim every stage that is not trained yet; False (and nothing held) if another process has one of them."""
        make_folder(self._folder)
        for index, key in enumerate(self._keys):
            if self._done(index).exists():
                continue
            claim = take_claim(self._folder / f"{key}.claim")
            if claim is None:
                self.release()
                return False
            if self._done(index).exists():  # finished between the two looks
                claim.release()
                continue
            self._held[index] = claim
        return True

    def finished(self, stages: int) -> None:
        """So many stages are in the cache: whoever waits for them may go on."""
        for index in [i for i in self._held if i < stages]:
            self._done(index).touch()
            self._held.pop(index).release()

    def touch(self) -> None:
        """Say that the holder lives."""
        for claim in self._held.values():
            claim.touch()

    def release(self) -> None:
        """Give all back."""
        for index in list(self._held):
            self._held.pop(index).release()


# -- working ---------------------------------------------------------------------------------------------------------
def work(
    sweep: Sweep,
    on_event: OnEvent = ignore,
    *,
    after_job: Callable[[SweepJob], None] = lambda _job: None,
    wait: bool = True,
) -> None:
    """Do jobs until all are settled, whoever does them.

    Parameters
    ----------
    sweep : Sweep
    on_event : callable
        Gets what training says, and a notice about each job.
    after_job : callable
        Called after each job of this process.
    wait : bool
        Whether to stay until the jobs of other processes are settled too (and take them over if those die).
    """
    make_folder(sweep.folder / "jobs")
    said = ""
    while True:
        left = sweep.unsettled()
        if not left:
            return
        taken = _take_one(sweep, left)
        if taken is None:
            if not wait:
                return
            others = _waiting_for(sweep, left)
            if others and others != said:
                on_event(Notice(others))
                said = others
            time.sleep(POLL_SECONDS)
            continue
        job, claim, stages = taken
        try:
            number = 1 + sweep.jobs.index(job)
            on_event(Notice(f"job {number} of {len(sweep.jobs)}: {job.name}"))
            _do(sweep, job, claim, stages, on_event)
        finally:
            stages.release()
            claim.release()
        after_job(job)


def watch(
    sweep: Sweep, on_event: OnEvent, after_job: Callable[[SweepJob], None], each_round: Callable[[], None]
) -> None:
    """Tell the user how far other processes are, until all jobs are settled."""
    settled: set[str] = set()
    on_event(Phase("jobs", len(sweep.jobs)))
    while True:
        fresh = [job for job in sweep.jobs if job.name not in settled and sweep.settled(job)]
        for job in fresh:
            settled.add(job.name)
            record = sweep.record(job)
            if record["state"] == "failed":
                on_event(Notice(f"{job.name} failed: {record['reason']}"))
            after_job(job)
        left = [job for job in sweep.jobs if job.name not in settled]
        running = [job.name for job in left if sweep.record(job)["state"] == "running"]
        on_event(Step(len(settled), ", ".join(running)))
        if not left:
            return
        each_round()
        time.sleep(POLL_SECONDS)


def _take_one(sweep: Sweep, jobs: Sequence[SweepJob]) -> tuple[SweepJob, Claim, StageClaims] | None:
    """The first job that is free and whose stages nobody else is training."""
    for job in jobs:
        claim = take_claim(sweep.claim_file(job))
        if claim is None:
            continue
        stages = StageClaims(sweep.cache / "claims", job.stage_keys)
        if not sweep.settled(job) and stages.take():
            return job, claim, stages
        claim.release()
    return None


def _waiting_for(sweep: Sweep, jobs: Sequence[SweepJob]) -> str:
    """Who has what is left: a claim of a machine that died looks like a hang to whoever waits for it."""
    held = {job.name: found for job in jobs if (found := holder(sweep.claim_file(job)))}
    names = [f"{name} (process {found.get('pid')} on {found.get('host')})" for name, found in held.items()]
    if not names:
        return ""
    return (
        f"waiting for {', '.join(names)}; should that machine be gone, its work is taken over after "
        f"{FOREIGN_SECONDS / 60:.0f} minutes"
    )


def _do(sweep: Sweep, job: SweepJob, claim: Claim, stages: StageClaims, on_event: OnEvent) -> None:
    """One job; what goes wrong is written down, and the sweep goes on."""
    path, record = sweep.record_file(job), sweep.record(job)
    died = record["state"] == "running" and record.get("time", 0.0) >= sweep.started
    deaths = record.get("deaths", 0) + 1 if died else 0
    if deaths >= MAX_DEATHS:
        reason = f"its process died {deaths} times (out of memory?)"
        write_json(path, {"state": "failed", "reason": reason, "time": time.time()})
        on_event(Notice(f"{job.name} failed: {reason}"))
        return
    write_json(path, {"state": "running", "deaths": deaths, "time": time.time(), "at": now()})

    def listen(event: Event) -> None:
        claim.touch()
        stages.touch()
        if isinstance(event, Phase | StageDone):
            stages.finished(len(RunFolder(job.train.out).metrics()["stages"]))
        on_event(event)

    try:
        notes = train_and_evaluate(job, listen)
    except Exception as error:
        mended = isinstance(error, Gs2dError)
        reason = " ".join(str(error).split()) if mended else f"{type(error).__name__}: {error}"
        failed: dict[str, Any] = {"state": "failed", "reason": reason or type(error).__name__}
        failed |= {"time": time.time(), "at": now()}
        failed["trained"] = is_trained(job)  # then its pictures were scored, and those scores stand
        write_json(path, failed if mended else {**failed, "traceback": traceback.format_exc()})
        on_event(Notice(f"{job.name} failed: {reason}"))
        return
    facts = {"notes": notes, "wanted": list(job.wanted), "trained": is_trained(job)}
    write_json(path, {"state": "done", **facts, "time": time.time(), "at": now()})


def train_and_evaluate(job: SweepJob, on_event: OnEvent) -> dict[str, str]:
    """Train and score one run; returns what could not be had, with reasons (``surface``).

    Raises
    ------
    Gs2dError
        The run itself failed.
    """
    from gs2d.pipeline.jobs import evaluate_run
    from gs2d.pipeline.train import train

    run = RunFolder(job.train.out)
    missing: list[Missing] = []

    def listen(event: Event) -> None:
        missing.extend([event] if isinstance(event, Missing) else [])
        on_event(event)

    train(job.train, listen)
    no_mesh = [event.reason for event in missing if event.what == MESH]
    if no_mesh:
        if job.evaluate is not None and job.evaluate.lpips_weights is not None:
            images = EvaluateOptions(lpips_weights=job.evaluate.lpips_weights)
            evaluate_run(run.path, images, on_event, threads=job.train.threads)
        return {"surface": f"no mesh: {no_mesh[0]}"}
    if job.evaluate is not None:
        evaluate_run(run.path, job.evaluate, on_event, threads=job.train.threads)
    return {}
