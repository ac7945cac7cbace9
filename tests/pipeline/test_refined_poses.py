"""Refined poses in a whole run: file, later commands, aligned scores, resuming and errors."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ball_runs import SMALL, Stop, comparable, options
from gs2d.config.quantities import QUANTITIES
from gs2d.contrib.pictures.pictures_command import RenderOptions
from gs2d.contrib.pictures.render_run import render_run
from gs2d.core.transforms import perturb_pose
from gs2d.data import load_scene
from gs2d.errors import RunError
from gs2d.evaluation.image_metrics import mean_metrics
from gs2d.io.run_dir import POSES, RunFolder
from gs2d.pipeline.finish.evaluate import aligned, evaluate_run
from gs2d.pipeline.finish.scoring import score_views
from gs2d.pipeline.prepare.learned_views import camera_motion
from gs2d.pipeline.prepare.loaded import open_finished, reload_run
from gs2d.pipeline.prepare.options import EvaluateOptions, TrainOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, Step, ignore
from gs2d.training.learned.camera_pose import CameraPose

EARLY = (*SMALL, "learned.poses.start=5", "learned.poses.rate=0.01")  # so that 60 iterations show something


def learning(capture: Path, out: Path, **changes: object) -> TrainOptions:
    return options(capture, out, learn="poses", overrides=EARLY, **changes)


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    notices: list[str] = []

    def listen(event: Event) -> None:
        notices.extend([event.text] if isinstance(event, Notice) else [])

    made = train(learning(capture, tmp_path_factory.mktemp("runs") / "poses"), listen)
    assert any(text.startswith("cameras moved by ") and text.endswith("of the extent): poses.json") for text in notices)
    return made


def test_the_poses_are_written_with_their_motions(run: RunFolder) -> None:
    """That they can be loaded is tested with refined focal lengths."""
    frames = json.loads(run.file(POSES).read_text())["frames"]
    assert [frame["split"] for frame in frames] == ["train"] * 6 + ["test"] * (len(frames) - 6)
    assert frames[0]["file_path"] == "train/r_0.png"
    assert max(frame["moved"]["pixels"] for frame in frames[:6]) > 0.05


def test_later_commands_use_the_refined_cameras(run: RunFolder, capture: Path, tmp_path: Path) -> None:
    _, job = open_finished(run.path, 1, ignore)
    given = load_scene(capture)
    for view, before in zip(job.scene.train, given.train, strict=True):
        assert not np.array_equal(view.camera.T_cam_world, before.camera.T_cam_world)
        assert np.array_equal(view.image(), before.image())
    for view, before in zip(job.scene.test, given.test, strict=True):
        assert np.array_equal(view.camera.T_cam_world, before.camera.T_cam_world)
    # Scored while it trained, scored again, and drawn.
    psnr = run.metrics()["stages"][-1]["train"]["psnr"]
    own = mean_metrics(list(score_views(job, job.scene.train, ignore).values()))
    assert own.to_json()["psnr"] == psnr
    original_scores = mean_metrics(list(score_views(job, given.train, ignore).values()))
    assert original_scores.to_json()["psnr"] != psnr
    assert evaluate_run(run.path)["train"]["psnr"] == psnr
    render_run(run.path, RenderOptions(split="train"), out=tmp_path)
    assert len(list(tmp_path.glob("*.png"))) == 6


def test_a_quantity_of_a_package_may_move_cameras(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(QUANTITIES._objects, "guest", CameraPose)
    early = (*SMALL, "learned.guest.start=5", "learned.guest.rate=0.01")
    made = train(options(capture, tmp_path / "run", learn="guest", overrides=early), ignore)
    _, job = open_finished(made.path, 1, ignore)
    for view, before in zip(job.scene.train, load_scene(capture).train, strict=True):
        assert not np.array_equal(view.camera.T_cam_world, before.camera.T_cam_world)
    assert evaluate_run(made.path)["train"]["psnr"] == made.metrics()["stages"][-1]["train"]["psnr"]
    events: list[Event] = []
    reload_run(made, events.append)
    assert not any("guest" in event.text for event in events if isinstance(event, Notice))
    monkeypatch.delitem(QUANTITIES._objects, "guest")
    reload_run(made, events.append)
    assert any("guest, whose package is not installed" in event.text for event in events if isinstance(event, Notice))


def test_aligned_scores_are_added_on_request(run: RunFolder) -> None:
    plain = run.metrics()["stages"][-1]
    assert "test_aligned" not in plain
    both = evaluate_run(run.path, EvaluateOptions(match="poses"))
    assert both["test"]["psnr"] == plain["test"]["psnr"]
    assert both["test_aligned"]["psnr"] > plain["test"]["psnr"]
    assert run.metrics()["stages"][-1]["test_aligned"] == both["test_aligned"]
    assert "new views, cameras aligned with the photograph" in run.file("report.html").read_text()


@pytest.mark.parametrize("gain", [1.0, 0.3])
def test_a_view_is_aligned_to_its_photograph_in_its_exposure(run: RunFolder, gain: float) -> None:
    _, job = open_finished(run.path, 1, ignore)
    view = job.scene.train[0]
    color = job.render(view.camera).color.clamp(0, 1).numpy()
    image = type(view).from_arrays("a", view.camera, np.rint(255 * gain * color).astype(np.uint8))
    image = replace(image, appearance={"exposure": gain * np.eye(3, 4)})
    off = perturb_pose(view.camera, torch.tensor([0.01, -0.01, 0, 0.01, 0.02, 0], dtype=torch.float64))
    (found,) = aligned(job, [image.at(off.T_cam_world)], ignore)
    middle = np.zeros(3)
    before, after = (camera_motion(view.camera, c, middle, job.scene.extent)["pixels"] for c in (off, found.camera))
    assert after < 0.3 * before


def test_an_interrupted_run_resumes_to_the_same_splats_and_poses(run: RunFolder, capture: Path, tmp_path: Path) -> None:
    def listen(event: Event) -> None:
        if isinstance(event, Step) and event.done >= 37 and "loss" in event.detail:  # in the second stage
            raise Stop

    with pytest.raises(Stop):
        train(learning(capture, tmp_path / "run"), listen)
    assert not (tmp_path / "run" / POSES).exists()
    stopped = RunFolder(tmp_path / "run")
    given = load_scene(capture).train[0].camera.T_cam_world
    assert np.array_equal(reload_run(stopped, ignore).scene.train[0].camera.T_cam_world, given)  # not refined yet
    resumed = train(learning(capture, tmp_path / "run", resume=True))
    assert comparable(resumed)[0] == comparable(run)[0]
    assert resumed.file(POSES).read_bytes() == run.file(POSES).read_bytes()


def test_a_missing_or_damaged_file_of_poses_is_an_error_with_a_remedy(run: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(tmp_path / "copy")
    shutil.copytree(run.path, copy.path)
    one = {"name": "train/r_0.png", "split": "train", "T_cam_world": np.eye(4).tolist()}
    for frames in ([{"name": "a"}], [{**one, "T_cam_world": [[1]]}], [one], "{"):
        copy.file(POSES).write_text(json.dumps({"frames": frames}))
        with pytest.raises(RunError, match="--resume"):
            evaluate_run(copy.path)
    stretched = json.loads(run.file(POSES).read_text())
    stretched["frames"][0]["T_cam_world"][0] = [9.0, 9.0, 9.0, 9.0]
    copy.file(POSES).write_text(json.dumps(stretched))
    with pytest.raises(RunError, match="--resume"):
        evaluate_run(copy.path)
    copy.file(POSES).unlink()
    with pytest.raises(RunError, match="--resume"):
        evaluate_run(copy.path)
