"""Lists of runs: done once, gone on with after a kill, several at once, and one command at a time in a folder."""

from __future__ import annotations

import json
import multiprocessing
import signal
import subprocess
import sys
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gs2d.cli import run
from gs2d.contrib.lab import execute as execute_module
from gs2d.contrib.lab import jobs as jobs_module
from gs2d.contrib.lab.execute import execute
from gs2d.contrib.lab.jobs import Job, stage_keys
from gs2d.contrib.lab.schedule import startable
from gs2d.contrib.lab.tasks import failures
from gs2d.errors import BackendError, DataError, RunError
from gs2d.pipeline.events import Notice, OnEvent
from sweep_jobs import fail_or_die, make_jobs
from tiny import write_capture

HELPERS = str(Path(__file__).resolve().parents[2] / "helpers")


# -- one after another -------------------------------------------------------------------------------------------------
def test_a_job_that_fails_does_not_stop_the_rest_and_is_tried_again_by_the_next_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    broken = {"b"}

    def train(job: Job, _on_event: OnEvent) -> dict[str, str]:
        if job.name in broken:
            raise DataError("expected a photograph, got none")
        done.append(job.name)
        return {}

    monkeypatch.setattr(jobs_module, "train_and_evaluate", train)
    jobs = make_jobs(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)})
    execute(jobs, tmp_path)
    assert done == ["a", "c"]
    assert failures(jobs) == {"b": "expected a photograph, got none"}
    broken.clear()
    execute(jobs, tmp_path)
    assert done == ["a", "c", "b"]  # nothing that was done is done again
    assert failures(jobs) == {}


def test_a_fault_of_ours_is_written_down_with_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs_module, "train_and_evaluate", lambda *_: 1 / 0)
    (job,) = make_jobs(tmp_path, {"a": ()})
    execute((job,), tmp_path)
    assert job.outcome()["reason"] == "ZeroDivisionError: division by zero"
    assert "test_execute.py" in job.outcome()["traceback"]


def test_a_finished_job_is_scored_again_when_more_is_wanted_and_done_again_when_its_run_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def train(job: Job, _on_event: OnEvent) -> dict[str, str]:
        done.append(job.name)
        job.train.out.mkdir(parents=True, exist_ok=True)
        (job.train.out / "splats.ply").touch()
        return {}

    def run_that_wants(*wanted: str) -> None:
        execute([replace(job, wanted=wanted) for job in make_jobs(tmp_path, {"a": ("1",)})], tmp_path)

    monkeypatch.setattr(jobs_module, "train_and_evaluate", train)
    run_that_wants("surface: x")
    run_that_wants("surface: x")
    run_that_wants()  # less is wanted: what is there stays
    assert len(done) == 1
    run_that_wants("surface: x", "lpips: y")
    assert len(done) == 2
    (tmp_path / "runs" / "a" / "splats.ply").unlink()
    run_that_wants("surface: x")
    assert len(done) == 3


def test_a_job_that_was_trained_and_could_not_be_scored_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(job: Job, _on_event: OnEvent) -> dict[str, str]:
        if job.name == "trained":
            job.train.out.mkdir(parents=True)
            (job.train.out / "splats.ply").touch()
        raise DataError("the log does not fit")

    monkeypatch.setattr(jobs_module, "train_and_evaluate", train)
    jobs = make_jobs(tmp_path, {"trained": ("1",), "not": ("2",)})
    execute(jobs, tmp_path)
    assert [job.outcome()["trained"] for job in jobs] == [True, False]
    assert set(failures(jobs)) == {"trained", "not"}


# -- one command at a time ---------------------------------------------------------------------------------------------
KILLED = """
import sys, time
from pathlib import Path
from gs2d.contrib.lab import execute as module
from gs2d.contrib.lab import jobs
sys.path.insert(0, sys.argv[2])
from sweep_jobs import fail_or_die, make_jobs
def train(job, on_event):
    if job.name == "b":
        print("at b", flush=True)
        time.sleep(60)
    return {}
jobs.train_and_evaluate = train
module.execute(make_jobs(Path(sys.argv[1]), {"a": ("s",), "b": ("s", "t"), "c": ("s", "t")}), Path(sys.argv[1]))
"""


def test_a_folder_that_another_command_works_in_is_refused_and_taken_over_when_it_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    monkeypatch.setattr(jobs_module, "train_and_evaluate", lambda job, _on_event: done.append(job.name) or {})
    jobs = make_jobs(tmp_path, {"a": ("s",), "b": ("s", "t"), "c": ("s", "t")})
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path), HELPERS], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "at b\n"
        with pytest.raises(RunError, match="another process; wait for it or choose another --out"):
            execute(jobs, tmp_path)
        assert done == []
        process.send_signal(signal.SIGKILL)
    assert jobs[1].outcome()["state"] == "running"
    execute(jobs, tmp_path)
    assert done == ["b", "c"]


def test_the_refusal_is_one_line_of_the_command_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    words = ["--data", str(tmp_path / "ball"), "--out", str(tmp_path / "out"), "--quiet"]
    codes: list[int] = []

    def train(*_: object) -> dict[str, str]:
        codes.append(run(["sweep", "2dgs-r", *words]))
        about = json.loads((tmp_path / "out" / "about.json").read_text())
        assert about["recipes"] == ["2dgs"]  # nothing of the command that was refused
        return {}

    monkeypatch.setattr(jobs_module, "train_and_evaluate", train)
    run(["sweep", "2dgs", *words])
    assert codes == [2]
    first = capsys.readouterr().err.splitlines()[0]
    assert first.startswith(f"error: {tmp_path / 'out'} is ")
    assert "another process; wait for it or choose another --out" in first


# -- several at once ---------------------------------------------------------------------------------------------------
def test_keys_are_equal_as_far_as_the_stages_are() -> None:
    a, b = stage_keys(["lego", 0], ["surface", "x"]), stage_keys(["lego", 0], ["surface", "y"])
    assert a[0] == b[0]
    assert a[1] != b[1]
    assert stage_keys(["lego", 1], ["surface"])[0] != a[0]


def test_a_job_waits_while_another_one_trains_a_stage_of_its(tmp_path: Path) -> None:
    first, second, third = make_jobs(tmp_path, {"a": ("s", "x"), "b": ("s", "y"), "c": ("r",)})
    assert startable([second], [first]) is None
    assert startable([second, third], [first]) == third
    first.train.out.mkdir(parents=True)
    stage = {"name": "surface", "iterations": 1, "seconds": 1, "splats": 1, "bytes": 1}
    (first.train.out / "metrics.json").write_text(json.dumps({"stages": [stage]}))
    assert startable([second], [first]) == second  # takes it from the cache


def test_slots_must_be_a_number_of_processes(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="--slots must be a whole number >= 1, got 0"):
        execute((), tmp_path, slots=0)


class Context:
    """In place of `multiprocessing`'s: its processes do something else, and are ready in a moment, without torch."""

    def Process(self, *, args: tuple[Any, ...], **_more: Any) -> BaseProcess:
        return multiprocessing.get_context("spawn").Process(target=fail_or_die, args=args)


def test_several_at_once_report_what_failed_and_whose_process_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execute_module, "multiprocessing", SimpleNamespace(get_context=lambda _how: Context()))
    jobs = make_jobs(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)})
    ended: list[str] = []
    heard: list[str] = []
    execute(
        jobs,
        tmp_path,
        lambda event: heard.append(event.text) if isinstance(event, Notice) else None,
        slots=2,
        after_job=lambda job: ended.append(job.name),
    )
    assert sorted(ended) == ["a", "b", "c"]
    assert failures(jobs) == {
        "a": "no photographs",
        "b": "its process died (signal 9; out of memory?)",
        "c": "no photographs",
    }
    assert sorted(heard) == [f"{name} failed: {reason}" for name, reason in failures(jobs).items()]


@pytest.mark.slow
def test_processes_of_their_own_train(tmp_path: Path) -> None:
    jobs = make_jobs(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)})
    execute(jobs, tmp_path, slots=2, backend="cpu")
    assert all(reason.startswith(f"{tmp_path} ") for reason in failures(jobs).values())
    assert len(failures(jobs)) == 3
