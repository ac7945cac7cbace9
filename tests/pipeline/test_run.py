"""A whole run on a tiny ball: its files, errors, and the demo."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ball_runs import Stop, options
from capture_writers import small_colmap
from gs2d.contrib.capture.json_captures import read_blender
from gs2d.contrib.demo.demo_command import DemoOptions
from gs2d.contrib.demo.run_demo import demo
from gs2d.contrib.pictures.pictures_command import RenderOptions
from gs2d.contrib.pictures.render_run import render_run
from gs2d.data.build import Capture
from gs2d.data.image_files import read_image
from gs2d.data.readers.capture_readers import READERS
from gs2d.errors import DataError, DiskError, DivergedError, ProtocolError, RecipeError, RunError
from gs2d.io.run_dir import RunFolder
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.prepare.loaded import prepare_run
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, Phase, Step, ignore
from tiny import write_capture


def test_a_run_has_all_documented_files(undisturbed: RunFolder) -> None:
    files = {
        "run.json",
        "events.jsonl",
        "checkpoints",
        "splats.ply",
        "mesh.ply",
        "metrics.json",
        "renders",
        "report.html",
    }
    assert files <= {entry.name for entry in undisturbed.path.iterdir()}
    assert not list(undisturbed.path.rglob("*.tmp"))
    definition = undisturbed.definition()
    assert [stage["name"] for stage in definition["recipe"]["stages"]] == ["surface", "appearance", "refine"]
    assert definition["scene"]["format"] == "blender"
    assert definition["protocol"]["name"] == "nerf-synthetic"
    assert definition["raster"]["near"] == 0.2
    splats = read_splats(undisturbed.file("splats.ply"))
    last = undisturbed.metrics()["stages"][-1]
    assert last["splats"] == len(splats)
    assert last["bytes"] == splats.nbytes


def test_metrics_have_an_entry_per_stage_with_reasons_for_nulls(undisturbed: RunFolder) -> None:
    stages = undisturbed.metrics()["stages"]
    assert [(s["name"], s["iterations"]) for s in stages] == [("surface", 30), ("appearance", 10), ("refine", 20)]
    for stage in stages:
        assert stage["seconds"] > 0
        assert stage["peak_memory_bytes"] > 10_000_000
        for split in ("train", "test"):
            assert 5 < stage[split]["psnr"] < 25  # after 60 iterations
            assert 0 < stage[split]["ssim"] < 1
            assert stage[split]["lpips"] is None
            assert "weights" in stage[split]["lpips_reason"]


def test_the_log_has_the_values_of_every_curve(undisturbed: RunFolder) -> None:
    steps = [event for event in undisturbed.events.read() if event["kind"] == "progress"]
    assert steps[-1]["total_iteration"] == 60
    assert {event["stage"] for event in steps} == {"surface", "appearance", "refine"}
    for event in steps:
        assert {"loss", "losses", "splats", "mean_opacity", "mean_area", "iteration"} <= set(event)
    assert any("psnr" in event for event in steps)
    kinds = {event["kind"] for event in undisturbed.events.read()}
    assert {"initialised", "stage_started", "stage_finished", "ranked", "cloned"} <= kinds


def test_images_of_every_stage_are_written_with_the_photographs(undisturbed: RunFolder) -> None:
    index = json.loads(undisturbed.file("renders/index.json").read_text())
    assert index["stages"] == ["surface", "appearance", "refine"]
    assert [view["split"] for view in index["views"]] == ["test", "test"]
    for view in index["views"]:
        assert undisturbed.file(f"renders/photos/{view['file']}.png").exists()
        for stage in index["stages"]:
            for what in ("color", "normal", "depth", "error"):
                assert undisturbed.file(f"renders/{stage}/{view['file']}.{what}.png").exists()
        assert not undisturbed.file(f"renders/surface/{view['file']}.high_error.png").exists()
        assert undisturbed.file(f"renders/refine/{view['file']}.high_error.png").exists()


def test_nan_stops_the_run_with_iteration_attribute_and_checkpoint(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.training import trainer as loop

    def poisoned(step: Any) -> Any:
        def changed(state: Any, *args: Any, **kwargs: Any) -> None:
            step(state, *args, **kwargs)
            if state.step == 19:  # the twentieth iteration is under way
                state.splats.log_scales[0, 0] = float("nan")

        return changed

    monkeypatch.setattr(loop, "adam_step", poisoned(loop.adam_step))
    with pytest.raises(DivergedError) as error:
        train(options(capture, tmp_path / "run"))
    message = str(error.value)
    assert "iteration 20 of stage 'surface'" in message
    assert "log_scales" in message
    assert f"the last good checkpoint is {tmp_path / 'run' / 'checkpoints' / '0-surface-0000016.pt'}" in message


def test_a_full_disk_before_the_first_checkpoint_leaves_nothing(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.io import run_dir as run_module

    def full(path: Path, _payload: Any) -> None:
        raise DiskError(f"cannot write {path}: No space left on device; free some space or choose another folder")

    monkeypatch.setattr(run_module, "save_tensors", full)
    with pytest.raises(DiskError, match="No space left"):
        train(options(capture, tmp_path / "deep" / "run"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "got"),
    [
        ({"downscale": 0}, "got 0"),
        ({"checkpoint_every": 0}, "got 0"),
        ({"checkpoint_every": "2h"}, "got 2h"),
        ({"learn": "poses,size"}, "got 'size'"),
        ({"threads": 0}, "got 0"),
        ({"threads": 1_000_000}, "from 1 to 1024, got 1000000"),
        ({"schedule_scale": 0.0}, "got 0"),
        ({"seed": 2**63}, "at most 2.63 - 1"),
        ({"overrides": ("name=",)}, "must have a name"),
    ],
)
def test_options_out_of_range_are_errors(capture: Path, tmp_path: Path, changes: dict[str, Any], got: str) -> None:
    with pytest.raises(RecipeError, match=got):
        train(options(capture, tmp_path / "run", **changes))
    assert list(tmp_path.iterdir()) == []


def test_the_demo_trains_scores_the_surface_and_reports(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    few = {"train_views": 3, "test_views": 1, "size": 24}
    small = DemoOptions(out=out, recipe="2dgs-r", threads=1, schedule_scale=0.0005, **few)
    run = demo(small)
    metrics = run.metrics()
    assert [stage["name"] for stage in metrics["stages"]] == ["surface", "appearance", "refine"]
    assert len(metrics["surface"]["thresholds"]) >= 3
    assert metrics["surface"]["ground_truth"].endswith("mesh_gt.ply")
    assert (out / "capture" / "transforms_train.json").exists()
    assert "gs2d demo: " in (out / "report.html").read_text()
    before = run.file("splats.ply").read_bytes()
    again = demo(replace(small, resume=True))  # the capture is reused
    assert again.file("splats.ply").read_bytes() == before
    assert again.metrics()["surface"] is not None


def test_initial_splats_and_skipped_photographs_are_reported(capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    shutil.copytree(capture, folder)
    for i in range(4):
        (folder / "train" / f"r_{i}.png").unlink()
    heard: list[Event] = []

    def listen(event: Event) -> None:
        heard.append(event)
        if isinstance(event, Step) and "loss" in event.detail:
            raise Stop

    with pytest.raises(Stop):
        train(options(folder, tmp_path / "run", protocol="generic"), listen)
    texts = [event.text for event in heard if isinstance(event, Notice)]
    assert "starting from 150 random points in the box that the cameras look at" in texts
    (warning,) = [event.text for event in heard if isinstance(event, Notice) and event.is_warning]
    assert re.fullmatch(
        r"4 of \d+ photographs are left out \(`gs2d info` lists them\): \S*r_0: .*; \S*r_1: .*; "
        r"\S*r_2: listed in transforms_train.json, but there is no such file.* \.\.\.",
        warning,
    )
    assert not (tmp_path / "run").exists()  # nothing was saved yet


def test_two_notes_precede_training_and_the_estimate_does_not_change_the_bytes(
    undisturbed: RunFolder, capture: Path, tmp_path: Path
) -> None:
    heard: list[Event] = []
    run = train(options(capture, tmp_path / "run", quality="full", downscale=1), heard.append)
    assert run.file("splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()
    training = next(i for i, event in enumerate(heard) if isinstance(event, Phase) and event.name == "training 2dgs-r")
    told = [event for event in heard[:training] if isinstance(event, Notice)]
    used, takes = (event.text for event in told if not event.detail)
    assert " are held out for testing" in used
    assert " photographs train at 24x24 for 60 iterations (--schedule-scale 0.001); " in used
    assert takes.startswith("the run will take about ")
    details = [event.text for event in told if event.detail]
    assert [event["text"] for event in run.events.read() if event["kind"] == "notice"] == details


@pytest.mark.parametrize(("every", "test"), [(0, 0), (2, 4), (3, 3)])
def test_every_nth_view_is_a_test_view(tmp_path: Path, every: int, test: int) -> None:
    capture = tmp_path / "capture"
    write_capture(capture, train=8, test=0, size=20)
    (capture / "transforms_train.json").rename(capture / "transforms.json")  # of nerfstudio: without a split
    job = prepare_run(options(capture, tmp_path / "run", test_every=every), ignore)
    assert (len(job.scene.train), len(job.scene.test)) == (8 - test, test)


def test_a_reader_of_a_package_can_define_the_split(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Guest:
        def detect(self, path: Path) -> bool:
            return False

        def read(self, path: Path, *, downscale: int) -> Capture:
            return replace(read_blender(path), format="guest")

    monkeypatch.setitem(READERS._objects, "guest", Guest)
    chosen = options(capture, tmp_path / "run", format="guest")
    job = prepare_run(chosen, ignore)
    assert {view.name.split("/")[0] for view in job.scene.test} == {"test"}
    assert job.scene.own_split
    with pytest.raises(ProtocolError, match="--test-every: .* has its own test views; omit the option"):
        prepare_run(replace(chosen, test_every=4), ignore)


def test_a_run_without_test_views_renders_its_training_views(tmp_path: Path) -> None:
    small_colmap(tmp_path / "run" / "capture")
    short = options(tmp_path / "run" / "capture", tmp_path / "run", protocol="generic", schedule_scale=0.0005)
    train(replace(short, test_every=0, downscale=2), allowed=("capture",))
    heard: list[Event] = []
    result = render_run(tmp_path / "run", RenderOptions(width=31), heard.append, threads=1)
    assert (result["images"], Path(result["folder"]).name) == (9, "train")
    assert any("because the run has no test views" in e.text for e in heard if isinstance(e, Notice))
    sizes = {read_image(path).shape for path in Path(result["folder"]).glob("*.png")}
    assert sizes == {(23, 31, 3)}  # of 20x15
    with pytest.raises(DataError, match="no test views; use --split train or --orbit 120"):
        render_run(tmp_path / "run", RenderOptions(split="test"), threads=1)
    with pytest.raises(RunError, match="--width must be a number of pixels from 1 to 16384, got 0"):
        render_run(tmp_path / "run", RenderOptions(width=0))
