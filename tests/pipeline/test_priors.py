"""Runs with depth and normal priors: results, report, resuming and errors."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ball_runs import SMALL, Stop, options
from gs2d.errors import DataError
from gs2d.io.run_dir import REPORT, RunFolder
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, NotMade, Step
from tiny import RADIUS, SIZE, ball_cameras


@pytest.fixture(autouse=True, scope="module")
def faint_pixels_count() -> Iterator[None]:
    """Compare depths of faint pixels too: the short trainings here leave most pixels faint."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gs2d.losses.prior_formulas.OPACITY", 0.05)
        yield


@pytest.fixture(scope="module")
def valid(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball with a sensor's depth maps in thousandths, and normals."""
    folder = tmp_path_factory.mktemp("data") / "known"
    shutil.copytree(capture, folder)
    for split in ("depths", "normals"):
        (folder / split / "train").mkdir(parents=True)
    for i, camera in enumerate(ball_cameras(6)):
        rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
        rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1)
        center = camera.T_cam_world[:3, 3]  # of the ball, in the camera
        a, b, c = (rays**2).sum(-1), rays @ center, center @ center - RADIUS**2
        hit = b * b > a * c
        z = np.where(hit, (b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, 0)
        Image.fromarray(np.rint(1000 * z).astype(np.uint16)).save(folder / "depths" / "train" / f"r_{i}.png")
        normals = (rays * z[..., None] - center) / RADIUS * (1, -1, -1)
        encoded = np.where(hit[..., None], np.rint(127.5 * (normals + 1)), 0)
        Image.fromarray(encoded.astype(np.uint8)).save(folder / "normals" / "train" / f"r_{i}.png")
    return folder


def knowing(capture: Path, out: Path, **changes: Any) -> TrainOptions:
    made = options(capture, out, depth_prior="sensor", normal_prior=True, overrides=SMALL)
    return replace(made, **changes)


@pytest.fixture(scope="module")
def run(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return train(knowing(valid, tmp_path_factory.mktemp("runs") / "known"))


def test_a_run_with_priors_logs_their_losses(run: RunFolder) -> None:
    logged = [line["losses"] for line in run.events.read() if line["kind"] == "progress"]
    assert any(losses.get("depth_prior", 0) > 0 for losses in logged)
    assert any(losses.get("normal_prior", 0) > 0 for losses in logged)


def test_a_run_resumes_only_with_the_same_maps(valid: Path, tmp_path: Path) -> None:
    from gs2d.errors import RunError

    changed = tmp_path / "changed"
    shutil.copytree(valid, changed)

    def listen(event: Event) -> None:
        if isinstance(event, Step) and event.done >= 10 and "loss" in event.detail:
            raise Stop

    with pytest.raises(Stop):
        train(knowing(changed, tmp_path / "run"), listen)
    (changed / "depths" / "train" / "r_0.png").unlink()
    with pytest.raises(RunError, match="photographs"):
        train(knowing(changed, tmp_path / "run", resume=True))


@pytest.mark.parametrize("source", ["auto", "relative"])
def test_relative_maps_without_points_are_fitted_to_renderings(valid: Path, tmp_path: Path, source: str) -> None:
    said: list[str] = []
    made = knowing(valid, tmp_path / "run", depth_prior=source, normal_prior=False, recipe="2dgs")
    found = train(made, lambda event: said.append(event.text) if isinstance(event, Notice) else None)
    assert any("depth prior (relative): 6 of 6" in text for text in said)
    logged = [line["losses"]["depth_prior"] for line in found.events.read() if line["kind"] == "progress"]
    assert max(logged) > 0


def test_a_broken_map_is_an_error_before_training_and_leaves_nothing(valid: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(valid, broken)
    coloured = np.full((SIZE, SIZE, 3), (90, 120, 90), np.uint8)
    Image.fromarray(coloured).save(broken / "depths" / "train" / "r_4.png")
    with pytest.raises(DataError, match="r_4"):
        train(knowing(broken, tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    train(options(broken, tmp_path / "plain"))  # not used


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names of files are text")
def test_depth_maps_work_with_file_names_that_are_not_utf_8(valid: Path, tmp_path: Path) -> None:
    named, name = tmp_path / "named", os.fsdecode(b"\xe9\x1b]0;owned\x07")
    shutil.copytree(valid, named)
    for folder in ("train", "depths/train", "normals/train"):
        (named / folder / "r_0.png").rename(named / folder / f"{name}.png")
    file = named / "transforms_train.json"
    meta = json.loads(file.read_text())
    meta["frames"][0]["file_path"] = f"./train/{name}"
    file.write_text(json.dumps(meta))
    heard: list[Event] = []
    train(knowing(named, tmp_path / "run"), heard.append)
    assert any(isinstance(event, Notice) and "(sensor): 6 of 6" in event.text for event in heard)
    assert (tmp_path / "run" / REPORT).exists()
    assert not any(isinstance(event, NotMade) for event in heard)
