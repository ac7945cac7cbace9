"""Refined focal lengths in a whole run: file, report, and later commands."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from ball_runs import SMALL, options
from gs2d.data import load_scene
from gs2d.errors import RunError
from gs2d.io.run_dir import POSES, RunFolder
from gs2d.pipeline.finish.run_texture import _views
from gs2d.pipeline.prepare.loaded import open_finished, reload_run
from gs2d.pipeline.prepare.options import TextureOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, ignore

EARLY = (*SMALL, "learned.poses.start=5", "learned.intrinsics.start=5", "learned.intrinsics.rate=0.01")


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    notices: list[str] = []

    def listen(event: Event) -> None:
        notices.extend([event.text] if isinstance(event, Notice) else [])

    folder = tmp_path_factory.mktemp("runs") / "cameras"
    made = train(options(capture, folder, learn="intrinsics", overrides=EARLY), listen)
    assert any(text.startswith("refined focal lengths are ") for text in notices)
    return made


def test_views_have_the_refined_focal_length_and_the_file_can_be_loaded(
    run: RunFolder, capture: Path, tmp_path: Path
) -> None:
    given, job = load_scene(capture), reload_run(run, ignore)
    zoom = job.scene.train[0].zoom
    assert zoom is not None
    assert abs(zoom.scale - 1) > 1e-3
    assert (zoom.right, zoom.down) == (0.0, 0.0)
    for view, before in zip(job.scene.views, given.views, strict=True):
        assert view.zoom == zoom
        assert view.camera.fx == pytest.approx(before.camera.fx * zoom.scale)
    frames = {entry["name"]: entry for entry in json.loads(run.file(POSES).read_text())["frames"]}
    assert frames[job.scene.test[0].name]["fl_x"] == job.scene.test[0].camera.fx
    shutil.copytree(capture, tmp_path / "again")
    for name in ("transforms_train.json", "transforms_test.json"):
        (tmp_path / "again" / name).unlink()
    shutil.copy(run.file(POSES), tmp_path / "again" / "transforms.json")
    again = {view.name: view for view in load_scene(tmp_path / "again", format="nerfstudio").views}
    for view in job.scene.views:
        assert again[view.name].camera.fx == view.camera.fx
        np.testing.assert_array_equal(again[view.name].image(), view.image())
        np.testing.assert_allclose(again[view.name].camera.T_cam_world, view.camera.T_cam_world, atol=1e-9)


def test_resized_photographs_have_the_refined_focal_length(run: RunFolder) -> None:
    _, job = open_finished(run.path, 1, ignore)
    larger = _views(job, TextureOptions(texture_downscale=2), ignore, 1)
    for view, here in zip(larger, job.scene.train, strict=True):
        assert view.camera.width == here.camera.width // 2
        assert np.array_equal(view.camera.T_cam_world, here.camera.T_cam_world)
        assert view.camera.fx == pytest.approx(here.camera.fx / 2)


def test_a_file_without_focal_lengths_is_an_error(run: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(Path(shutil.copytree(run.path, tmp_path / "run")))
    data = json.loads(copy.file(POSES).read_text())
    for broken, words in (([1.0, np.nan, 0.0], "finite"), ([-1.0, 0.0, 0.0], "positive"), (None, "zoom")):
        for entry in data["frames"]:
            entry["zoom"] = broken
            if broken is None:
                del entry["zoom"]
        copy.file(POSES).write_text(json.dumps(data))
        with pytest.raises(RunError, match=words):
            reload_run(copy, ignore)
