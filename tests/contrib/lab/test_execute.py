"""Lists of runs: done once, gone on with after a kill, several at once, and one command at a time in a folder."""

from __future__ import annotations

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

from gs2d.contrib.lab import execute as execute_module
from gs2d.contrib.lab import training_task as task_module
from gs2d.contrib.lab.execute import Workers, execute
from gs2d.contrib.lab.tasks import failures
from gs2d.contrib.lab.training_task import TrainingTask
from gs2d.errors import DataError, RunError
from gs2d.training.events import Notice, OnEvent
from sweep_jobs import fail_or_die, make_jobs

HELPERS = str(Path(__file__).resolve().parents[2] / "helpers")


# -- one after another -------------------------------------------------------------------------------------------------
def test_a_job_that_fails_does_not_stop_the_rest_and_is_tried_again_by_the_next_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    broken = {"b"}

    def train(job: TrainingTask, _on_event: OnEvent) -> dict[str, str]:
        if job.name in broken:
            raise DataError("expected a photograph, got none")
        done.append(job.name)
        return {}

    monkeypatch.setattr(task_module, "train_and_evaluate", train)
    jobs = make_jobs(tmp_path, {"a": ("1",), "b": ("2",), "c": ("3",)})
    execute(jobs, tmp_path)
    assert done == ["a", "c"]
    assert failures(jobs) == {"b": "expected a photograph, got none"}
    broken.clear()
    execute(jobs, tmp_path)
    assert done == ["a", "c", "b"]  # nothing that was done is done again
    assert failures(jobs) == {}


def test_a_finished_job_is_scored_again_for_more_scores_and_done_again_when_its_run_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def train(job: TrainingTask, _on_event: OnEvent) -> dict[str, str]:
        done.append(job.name)
        job.train.out.mkdir(parents=True, exist_ok=True)
        (job.train.out / "splats.ply").touch()
        return {}

    def run_with(*scores: str) -> None:
        execute([replace(job, scores=scores) for job in make_jobs(tmp_path, {"a": ("1",)})], tmp_path)

    monkeypatch.setattr(task_module, "train_and_evaluate", train)
    run_with("surface: x")
    run_with("surface: x")
    run_with()  # fewer scores: nothing is run again
    assert len(done) == 1
    run_with("surface: x", "lpips: y")
    assert len(done) == 2
    (tmp_path / "runs" / "a" / "splats.ply").unlink()
    run_with("surface: x")
    assert len(done) == 3


# -- one command at a time ---------------------------------------------------------------------------------------------
KILLED = """
import sys, time
from pathlib import Path
from gs2d.contrib.lab import execute as module
from gs2d.contrib.lab import training_task
sys.path.insert(0, sys.argv[2])
from sweep_jobs import fail_or_die, make_jobs
def train(job, on_event):
    if job.name == "b":
        print("at b", flush=True)
        time.sleep(60)
    return {}
training_task.train_and_evaluate = train
module.execute(make_jobs(Path(sys.argv[1]), {"a": ("s",), "b": ("s", "t"), "c": ("s", "t")}), Path(sys.argv[1]))
"""


def test_a_folder_that_another_command_works_in_is_refused_and_taken_over_when_it_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    monkeypatch.setattr(task_module, "train_and_evaluate", lambda job, _on_event: done.append(job.name) or {})
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
    assert jobs[1].status()["state"] == "running"
    execute(jobs, tmp_path)
    assert done == ["b", "c"]


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
        workers=Workers(slots=2),
        after_task=lambda job: ended.append(job.name),
    )
    assert sorted(ended) == ["a", "b", "c"]
    assert failures(jobs) == {
        "a": "no photographs",
        "b": "its process died (signal 9; out of memory?)",
        "c": "no photographs",
    }
    assert sorted(heard) == [f"{name} failed: {reason}" for name, reason in failures(jobs).items()]
