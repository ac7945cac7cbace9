"""`gs2d reconstruct --cluster`, with a module in place of Ray: two tasks, refusals, what is left and gone on with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from cli_runs import TINY, one_line
from fake_ray import FakeRay
from gs2d.cli import run
from gs2d.contrib.lab import reconstruct as module
from gs2d.contrib.lab.reconstruct import tasks_of
from gs2d.pipeline import reconstruct as steps
from gs2d.pipeline.prepare.options import ReconstructOptions
from room_photos import Room


def words_for(photos: Path, out: Path, *words: str) -> list[str]:
    common = ["--out", str(out), "--threads", "1", "--downscale", "8", "--quiet", *TINY]
    return ["reconstruct", str(photos), *common, "--cluster", "auto", *words]


def test_two_tasks_leave_the_run_that_the_command_here_leaves(
    ray: FakeRay, room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, alone = tmp_path / "run", tmp_path / "alone"
    shutil.copytree(room.capture, alone / "capture")  # as is found there again
    monkeypatch.setattr(steps, "find_poses", lambda *_: _found(room, out))
    assert run(words_for(room.photos, out, "--json", "--memory", "2")) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["poses"]["placed"] == 12
    assert set(ray.asked) == {"cameras", "training"}
    assert ray.asked["cameras"]["num_gpus"] == 0
    assert ray.asked["training"]["memory"] == 2 * 2**30
    here = [word for word in words_for(room.photos, alone, "--resume", "--memory", "2") if word != "auto"]
    here.remove("--cluster")
    assert run(here) == 0
    assert (out / "splats.ply").read_bytes() == (alone / "splats.ply").read_bytes()
    assert not list((out / "cluster/jobs").glob("*.replaced"))


def _found(room: Room, out: Path) -> dict[str, object]:
    shutil.copytree(room.capture, out / "capture", dirs_exist_ok=True)
    return dict(json.loads((room.capture / "poses.json").read_text()))


def test_a_resume_asks_again_and_is_refused_with_other_options(
    ray: FakeRay, room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(room.capture, out / "capture")
    assert run(words_for(room.photos, out)) == 2
    assert "go on with --resume" in one_line(capsys.readouterr().err)
    assert run(words_for(room.photos, out, "--resume", "--seed", "3")) == 2
    assert "was made with --seed 0, now 3" in one_line(capsys.readouterr().err)
    assert ray.asked == {}
    assert not (out / "cluster").exists()


def test_what_another_command_did_is_not_taken_for_done(tmp_path: Path) -> None:
    options = ReconstructOptions(photos=tmp_path / "photos", out=tmp_path / "run")
    first, second = tasks_of(options)[0], tasks_of(options)[0]
    first.record.parent.mkdir(parents=True)
    (tmp_path / "run/capture").mkdir()
    (tmp_path / "run/capture/poses.json").touch()
    first.write("done", **first.facts())
    assert first.is_done()
    assert not second.is_done()


def test_cameras_are_replaced_once_though_the_machine_was_lost_after_it(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[bool, bool]] = []
    monkeypatch.setattr(module, "find_cameras", lambda options, _: seen.append((options.overwrite, options.resume)))
    options = ReconstructOptions(photos=room.photos, out=tmp_path / "run", overwrite=True)
    task = tasks_of(options)[0]
    task.record.parent.mkdir(parents=True)
    task.work(lambda _: None)
    task.work(lambda _: None)  # the second process takes what the first has left
    assert seen == [(True, False), (False, True)]
