"""Exact resume, shared stages, and the same bytes from the same seed."""

from __future__ import annotations

import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ball_runs import SMALL, Stop, comparable, options, spawn
from gs2d.errors import DiskError, RunError
from gs2d.io.run_dir import RunFolder, open_run
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, StageScored, Step


@pytest.mark.parametrize("stop_after", [3, 13, 30, 37, 59])
def test_a_run_stopped_at_any_iteration_resumes_to_the_same_bytes(
    capture: Path, undisturbed: RunFolder, tmp_path: Path, stop_after: int
) -> None:
    def listen(event: Event) -> None:
        if isinstance(event, Step) and event.done >= stop_after and "loss" in event.detail:
            raise Stop

    with pytest.raises(Stop):
        train(options(capture, tmp_path / "run"), listen)
    resumed = train(options(capture, tmp_path / "run", resume=True))
    assert comparable(resumed) == comparable(undisturbed)


def test_a_run_stopped_before_the_scores_of_a_stage_is_scored_on_resume(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    def listen(event: Event) -> None:
        if isinstance(event, StageScored):
            raise Stop

    with pytest.raises(Stop):
        train(options(capture, tmp_path / "run"), listen)
    run = RunFolder(tmp_path / "run")
    run.write_metrics({"stages": [], "surface": None})  # as if killed before they were written
    assert comparable(train(options(capture, tmp_path / "run", resume=True))) == comparable(undisturbed)


@pytest.mark.parametrize("when", [(0, 12.0), (1, float("inf"))])  # in the first stage; at the end of the second
def test_a_killed_process_resumes_to_the_same_splats_byte_for_byte(
    capture: Path, undisturbed: RunFolder, tmp_path: Path, when: tuple[int, float]
) -> None:
    process = spawn(capture, tmp_path / "run")
    deadline = time.monotonic() + 900
    while not any(saved.progress >= when for saved in RunFolder(tmp_path / "run").checkpoints()):
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < deadline
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not (tmp_path / "run" / "splats.ply").exists()
    assert comparable(train(options(capture, tmp_path / "run", resume=True))) == comparable(undisturbed)


def test_resuming_a_finished_run_changes_nothing(capture: Path, undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    before = comparable(RunFolder(copy))
    mesh = (copy / "mesh.ply").read_bytes()
    assert comparable(train(options(capture, copy, resume=True))) == before
    assert (copy / "mesh.ply").read_bytes() == mesh
    assert RunFolder(copy).metrics()["mesh"] == undisturbed.metrics()["mesh"]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seed": 1}, "another"),
        ({"overrides": (*SMALL, "refine.iterations=25")}, "recipe"),
        ({"protocol": "generic"}, "synthetic"),
        ({"downscale": 2}, "another"),
    ],
)
def test_resuming_with_other_options_is_an_error_with_the_difference(
    capture: Path, undisturbed: RunFolder, changes: dict[str, Any], named: str
) -> None:
    before = comparable(undisturbed)
    with pytest.raises(RunError, match=named):
        train(options(capture, undisturbed.path, resume=True, **changes))
    assert comparable(undisturbed) == before


def test_a_cache_gives_the_same_bytes_without_training_the_shared_stages(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    train(options(capture, tmp_path / "plain", recipe="2dgs", cache=cache))
    heard: list[Event] = []
    shared = train(options(capture, tmp_path / "r", cache=cache), heard.append)
    assert comparable(shared) == comparable(undisturbed)
    stages = shared.metrics()["stages"]
    assert [("reused_from" in stage) for stage in stages] == [True, False, False]
    assert shared.file("renders/surface").is_dir()
    assert not any(isinstance(event, Step) and event.detail.startswith("surface") for event in heard)
    assert len(list(cache.glob("*.pt"))) == 3


def test_another_seed_or_setting_does_not_use_the_cache(capture: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first = options(capture, tmp_path / "a", recipe="2dgs", cache=cache)
    train(first)
    train(replace(first, out=tmp_path / "b", seed=1))
    train(replace(first, out=tmp_path / "c", overrides=(*SMALL, "surface.lr.sh0=0.003")))
    train(replace(first, out=tmp_path / "d", downscale=2))
    assert len(list(cache.glob("*.pt"))) == 4
    assert all("reused_from" not in open_run(tmp_path / x).metrics()["stages"][0] for x in "abcd")


def test_a_failing_overwrite_keeps_the_old_run(capture: Path, undisturbed: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(undisturbed.path, tmp_path / "run")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(DiskError, match="part"):
        train(options(capture, tmp_path / "run", overwrite=True, cache=tmp_path / "run/run.json/cache"))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_the_same_seed_gives_the_same_bytes(capture: Path, undisturbed: RunFolder, tmp_path: Path) -> None:
    again = train(options(capture, tmp_path / "again", checkpoint_every=1000))
    assert again.file("splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()
    other = train(options(capture, tmp_path / "other", seed=1))
    assert other.file("splats.ply").read_bytes() != undisturbed.file("splats.ply").read_bytes()


def test_a_finished_run_without_checkpoints_is_not_changed_by_resume(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    shutil.rmtree(copy / "checkpoints")  # to save space
    for changes, words in (({}, "is finished and has no checkpoints"), ({"seed": 1}, "another recipe")):
        with pytest.raises(RunError, match=words):
            train(options(capture, copy, resume=True, **changes))
        for name in ("splats.ply", "mesh.ply", "metrics.json", "report.html"):
            assert (copy / name).read_bytes() == undisturbed.file(name).read_bytes()
