"""Sweeps: one list of jobs, many processes, any of which may be killed at any moment."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gs2d.errors import BackendError, DataError, RunError
from gs2d.experiments import execute as sweep_module
from gs2d.experiments.execute import MAX_DEATHS, Sweep, SweepJob, work
from gs2d.experiments.slots import revive, run_sweep
from gs2d.experiments.slurm import run_on_slurm
from gs2d.pipeline.events import OnEvent, StageDone
from sweep_jobs import dead_pid, make_sweep, write_claim


# -- shared stages -------------------------------------------------------------------------------------------------
def test_two_workers_train_a_shared_stage_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []
    both_began = threading.Event()

    def train(job: SweepJob, on_event: OnEvent) -> dict[str, str]:
        log.append("a job begins")
        if len(log) == 1:
            time.sleep(0.2)  # the other worker would begin here, if nothing held it
            log.append("surface is trained")
            job.train.out.mkdir(parents=True)
            stage = {"name": "surface", "iterations": 1, "seconds": 1, "splats": 1, "bytes": 1}
            (job.train.out / "metrics.json").write_text(json.dumps({"stages": [stage]}))
            on_event(StageDone(stage))
            assert both_began.wait(10)  # it goes on with its own stage while the other has begun
        else:
            both_began.set()
        return {}

    monkeypatch.setattr(sweep_module, "train_and_evaluate", train)
    monkeypatch.setattr(sweep_module, "POLL_SECONDS", 0.01)
    sweep = make_sweep(tmp_path, {"first": ("s", "a"), "second": ("s", "b")})
    workers = [threading.Thread(target=work, args=(sweep,)) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(20)
    assert log == ["a job begins", "surface is trained", "a job begins"]
    assert not sweep.unsettled()


# -- jobs ----------------------------------------------------------------------------------------------------------
def test_a_job_that_fails_does_not_stop_the_rest_and_is_tried_again_by_the_next_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    broken = {"b"}

    def train(job: SweepJob, on_event: OnEvent) -> dict[str, str]:
        if job.name in broken:
            raise DataError("expected a photograph, got none")
        done.append(job.name)
        return {}

    monkeypatch.setattr(sweep_module, "train_and_evaluate", train)
    sweep = make_sweep(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)})
    work(sweep)
    assert done == ["a", "c"]
    assert sweep.failures() == {"b": "expected a photograph, got none"}
    broken.clear()
    time.sleep(0.01)
    again = replace(sweep, started=time.time())
    work(again)
    assert done == ["a", "c", "b"]  # nothing that was done is done again
    assert again.failures() == {}


def test_a_job_whose_process_dies_again_and_again_counts_as_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = make_sweep(tmp_path, {"a": ("1",)})
    monkeypatch.setattr(sweep_module, "train_and_evaluate", lambda *_: pytest.fail("it must not be tried again"))
    (tmp_path / "jobs").mkdir()
    record = {"state": "running", "deaths": MAX_DEATHS - 1, "time": time.time()}
    sweep.record_file(sweep.jobs[0]).write_text(json.dumps(record))
    write_claim(sweep.claim_file(sweep.jobs[0]), pid=dead_pid(), began="1")
    work(sweep)
    assert f"died {MAX_DEATHS} times" in sweep.failures()["a"]


def test_a_finished_job_is_scored_again_when_more_is_wanted_and_done_again_when_its_run_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def train(job: SweepJob, on_event: OnEvent) -> dict[str, str]:
        done.append(job.name)
        job.train.out.mkdir(parents=True, exist_ok=True)
        (job.train.out / "splats.ply").touch()
        return {}

    def sweep_that_wants(*wanted: str) -> Sweep:
        sweep = make_sweep(tmp_path, {"a": ("1",)})
        return replace(sweep, jobs=(replace(sweep.jobs[0], wanted=wanted),))

    monkeypatch.setattr(sweep_module, "train_and_evaluate", train)
    work(sweep_that_wants("surface: x"))
    work(sweep_that_wants("surface: x"))
    work(sweep_that_wants())  # less is wanted: what is there stays
    assert len(done) == 1
    work(sweep_that_wants("surface: x", "lpips: y"))
    assert len(done) == 2
    (tmp_path / "runs" / "a" / "splats.ply").unlink()
    work(sweep_that_wants("surface: x"))
    assert len(done) == 3


def test_a_job_that_was_trained_and_could_not_be_scored_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(job: SweepJob, on_event: OnEvent) -> dict[str, str]:
        if job.name == "trained":
            job.train.out.mkdir(parents=True)
            (job.train.out / "splats.ply").touch()
        raise DataError("the log does not fit")

    monkeypatch.setattr(sweep_module, "train_and_evaluate", train)
    sweep = make_sweep(tmp_path, {"trained": ("1",), "not": ("2",)})
    work(sweep)
    assert [sweep.record(job)["trained"] for job in sweep.jobs] == [True, False]
    assert set(sweep.failures()) == {"trained", "not"}


def test_who_waits_for_another_machine_says_for_whom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = make_sweep(tmp_path, {"a": ("1",)})
    (tmp_path / "jobs").mkdir()
    claim = sweep.claim_file(sweep.jobs[0])
    write_claim(claim, host="elsewhere", pid=7)
    heard: list[str] = []

    def listen(event: object) -> None:
        heard.append(getattr(event, "text", ""))
        claim.unlink(missing_ok=True)  # it is done there

    monkeypatch.setattr(sweep_module, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(sweep_module, "train_and_evaluate", lambda *_: {})
    work(sweep, listen)
    assert heard[0].startswith("waiting for a (process 7 on elsewhere); should that machine be gone, ")
    assert heard[1] == "job 1 of 1: a"


KILLED = """
import sys, time
from pathlib import Path
from gs2d.experiments import execute as module
sys.path.insert(0, sys.argv[2])
from sweep_jobs import make_sweep
def train(job, on_event):
    if job.name == "b":
        print("at b", flush=True)
        time.sleep(60)
    return {}
module.train_and_evaluate = train
module.work(make_sweep(Path(sys.argv[1]), {"a": ("s",), "b": ("s", "t"), "c": ("s", "t")}))
"""


def test_a_sweep_goes_on_after_sigkill_without_doing_anything_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [sys.executable, "-c", KILLED, str(tmp_path), str(Path(__file__).resolve().parents[1] / "helpers")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "at b\n"
        sweep = make_sweep(tmp_path, {"a": ("s",), "b": ("s", "t"), "c": ("s", "t")})
        done: list[str] = []
        monkeypatch.setattr(sweep_module, "train_and_evaluate", lambda job, _on_event: done.append(job.name) or {})
        work(sweep, wait=False)
        assert done == []  # b is held, and c waits for the stage that b trains
        process.send_signal(signal.SIGKILL)
    work(sweep)
    assert done == ["b", "c"]
    assert not list(tmp_path.glob("**/*.claim"))


# -- slots ---------------------------------------------------------------------------------------------------------
def test_slots_must_be_a_number_of_processes(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="--slots must be a whole number >= 1, got 0"):
        run_sweep(make_sweep(tmp_path, {}), lambda _event: None, slots=0)


def test_slots_that_die_for_no_job_are_not_started_for_ever(tmp_path: Path) -> None:
    class Dead:
        exitcode = 9

        def is_alive(self) -> bool:
            return False

        def join(self) -> None: ...

    sweep, deaths, started = make_sweep(tmp_path, {"a": ("1",)}), list[int](), []
    processes: list[Any] = [Dead()]
    start: Any = lambda index: started.append(index) or Dead()  # noqa: E731
    for _ in range(MAX_DEATHS):  # as often as the job may kill its process
        revive(sweep, processes, start, deaths)
    with pytest.raises(RunError, match="4 processes of --slots died .the last with exit code 9."):
        revive(sweep, processes, start, deaths)
    assert started == [0] * MAX_DEATHS


@pytest.mark.slow
def test_slots_share_the_list_and_report_what_failed(tmp_path: Path) -> None:
    sweep = make_sweep(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)})
    (tmp_path / "jobs").mkdir()  # their capture is an empty folder: each fails at once, in a process of its own
    settled: list[str] = []
    run_sweep(sweep, lambda _event: None, slots=2, backend="cpu", after_job=lambda job: settled.append(job.name))
    assert sorted(settled) == ["a", "b", "c"]
    assert set(sweep.failures()) == {"a", "b", "c"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # submitit does not wait for processes
def test_submitit_runs_the_slots_on_this_machine(tmp_path: Path) -> None:
    submitit = pytest.importorskip("submitit")
    sweep = make_sweep(tmp_path, {"a": ("1",), "b": ("2",)})
    executor = submitit.AutoExecutor(folder=tmp_path / "slurm", cluster="local")
    options = {"slots": 2, "parameters": {"timeout_min": 5}, "after_job": lambda _job: None}
    run_on_slurm(sweep, lambda _event: None, executor=executor, **options)  # type: ignore[arg-type]
    assert set(sweep.failures()) == {"a", "b"}  # their capture is an empty folder


class Submitted:
    """A job of the fake executor: a thread."""

    job_id = "17"

    def __init__(self, future: Future[None]) -> None:
        self.future = future

    def done(self) -> bool:
        return self.future.done()

    def exception(self) -> BaseException | None:
        return self.future.exception()

    def cancel(self) -> None:
        self.future.cancel()


class FakeExecutor:
    """submitit's interface, without a cluster."""

    def __init__(self, fail: bool = False) -> None:
        self.pool, self.fail, self.parameters = ThreadPoolExecutor(2), fail, {}

    def update_parameters(self, **parameters: Any) -> None:
        self.parameters = parameters

    def submit(self, function: Any, *args: Any) -> Submitted:
        return Submitted(self.pool.submit((lambda *_: 1 / 0) if self.fail else function, *args))


def test_slurm_jobs_work_off_the_same_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    monkeypatch.setattr(sweep_module, "train_and_evaluate", lambda job, _on_event: done.append(job.name) or {})
    sweep, executor = make_sweep(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)}), FakeExecutor()
    settled: list[str] = []
    run_on_slurm(
        sweep,
        lambda _event: None,
        slots=2,
        parameters={"slurm_partition": "gpu"},
        after_job=lambda job: settled.append(job.name),
        executor=executor,
    )
    assert sorted(done) == sorted(settled) == ["a", "b", "c"]
    assert executor.parameters == {"slurm_partition": "gpu"}


def test_slurm_that_is_not_there_and_parameters_that_are_none_are_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = make_sweep(tmp_path, {"a": ("1",)})
    options: dict[str, Any] = {"slots": 1, "parameters": {"colour": 1}, "after_job": lambda _job: None}
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(BackendError, match="needs submitit, which is not installed; pip install 'submitit>="):
        run_on_slurm(sweep, lambda _event: None, **options)
    executor = FakeExecutor()
    monkeypatch.setattr(executor, "update_parameters", lambda: None)
    with pytest.raises(BackendError, match="'colour': 1. is not what submitit takes"):
        run_on_slurm(sweep, lambda _event: None, executor=executor, **options)


def test_slurm_jobs_that_end_too_early_are_an_error_with_the_reason(tmp_path: Path) -> None:
    sweep = make_sweep(tmp_path, {"a": ("1",)})
    options = {"slots": 1, "parameters": {}, "after_job": lambda _job: None}
    with pytest.raises(RunError, match="ended before the runs were done .division by zero"):
        run_on_slurm(sweep, lambda _event: None, executor=FakeExecutor(fail=True), **options)  # type: ignore[arg-type]
