"""Sweeps: one list of jobs, many processes, any of which may be killed at any moment."""

from __future__ import annotations

import json
import os
import signal
import socket
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
from gs2d.pipeline import sweep as sweep_module
from gs2d.pipeline import sweep_claims
from gs2d.pipeline.events import OnEvent, StageDone
from gs2d.pipeline.options import TrainOptions
from gs2d.pipeline.sweep import MAX_DEATHS, StageClaims, Sweep, SweepJob, stage_keys, work
from gs2d.pipeline.sweep_claims import is_stale, take_claim
from gs2d.pipeline.sweep_slots import revive, run_sweep
from gs2d.pipeline.sweep_slurm import run_on_slurm


def make_sweep(folder: Path, keys: dict[str, tuple[str, ...]]) -> Sweep:
    """Jobs by name with the keys of their stages."""
    jobs = tuple(
        SweepJob(name=name, train=TrainOptions(scene=folder, out=folder / "runs" / name), stage_keys=stages)
        for name, stages in keys.items()
    )
    return Sweep(folder=folder, jobs=jobs, cache=folder / "cache")


def dead_pid() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def write_claim(path: Path, **facts: Any) -> None:
    path.write_text(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "began": None, **facts}))


# -- claims ------------------------------------------------------------------------------------------------------
def test_a_claim_is_held_by_one_and_free_again_after_release(tmp_path: Path) -> None:
    first = take_claim(tmp_path / "job.claim")
    assert first is not None
    assert take_claim(tmp_path / "job.claim") is None
    assert not is_stale(tmp_path / "job.claim")
    first.release()
    assert take_claim(tmp_path / "job.claim") is not None


@pytest.mark.parametrize("facts", [{"pid": None}, {"began": "12345"}], ids=["dead process", "number in use again"])
def test_a_claim_of_a_process_that_is_gone_is_taken_over(tmp_path: Path, facts: dict[str, Any]) -> None:
    path = tmp_path / "job.claim"
    write_claim(path, **({"pid": dead_pid(), "began": "1"} if facts.get("pid", 0) is None else facts))
    assert is_stale(path)
    mine = take_claim(path)
    assert mine is not None
    assert json.loads(path.read_text())["pid"] == os.getpid()


def test_of_many_that_see_a_dead_claim_one_gets_it(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    for _ in range(5):
        write_claim(path, pid=dead_pid(), began="1")
        with ThreadPoolExecutor(8) as pool:
            got = [claim for claim in pool.map(lambda _i: take_claim(path), range(8)) if claim is not None]
        assert len(got) == 1
        got[0].release()


def test_a_claim_of_another_machine_is_stale_when_it_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    write_claim(path, host="elsewhere")
    assert not is_stale(path)
    old = time.time() - sweep_claims.FOREIGN_SECONDS - 1
    os.utime(path, (old, old))
    assert is_stale(path)


def test_a_claim_that_was_never_written_is_stale_after_a_while(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    path.touch()  # killed between making the file and writing into it
    assert not is_stale(path)
    old = time.time() - sweep_claims.UNWRITTEN_SECONDS - 1
    os.utime(path, (old, old))
    assert is_stale(path)


def test_who_was_taken_over_does_not_release_the_new_holder(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    first = take_claim(path)
    assert first is not None
    path.unlink()
    second = take_claim(path)
    first.release()
    assert second is not None
    assert path.exists()


# -- shared stages -------------------------------------------------------------------------------------------------
def test_keys_are_equal_as_far_as_the_stages_are() -> None:
    a, b = stage_keys(["lego", 0], ["surface", "x"]), stage_keys(["lego", 0], ["surface", "y"])
    assert a[0] == b[0]
    assert a[1] != b[1]
    assert stage_keys(["lego", 1], ["surface"])[0] != a[0]


def test_a_stage_under_training_is_waited_for_and_free_when_it_is_finished(tmp_path: Path) -> None:
    first, second = StageClaims(tmp_path, ("s", "a")), StageClaims(tmp_path, ("s", "b"))
    assert first.take()
    assert not second.take()
    assert not (tmp_path / "b.claim").exists()  # who cannot have all holds none
    first.finished(1)
    assert second.take()
    second.release()
    first.release()
    assert not list(tmp_path.glob("*.claim"))


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


KILLED = """
import sys, time
from pathlib import Path
from gs2d.pipeline import sweep as module
sys.path.insert(0, sys.argv[2])
from test_sweep import make_sweep
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
    words = [sys.executable, "-c", KILLED, str(tmp_path), str(Path(__file__).parent)]
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
    with pytest.raises(BackendError, match="needs submitit, which is not installed; pip install '2dgs-r.slurm.'"):
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
