"""The whole path on a tiny ball: what a run leaves, exact resume, reuse of stages, what fails leaves nothing."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.errors import DataError, DiskError, DivergedError, ProtocolError, RecipeError, RunError
from gs2d.io.ply import read_mesh, read_splats, write_mesh
from gs2d.io.run import RunFolder, open_run
from gs2d.pipeline.demo import DemoOptions, demo
from gs2d.pipeline.events import Event, Notice, StageDone, Step, ignore
from gs2d.pipeline.jobs import evaluate_run, export_run, mesh_run, orbit_cameras, render_run, report_run
from gs2d.pipeline.options import EvaluateOptions, MeshOptions, TrainOptions
from gs2d.pipeline.prepare import prepare
from gs2d.pipeline.train import train
from gs2d.triangles import Mesh
from tiny import write_ball_mesh, write_capture

SMALL = ("init_points=150", "surface.densify.max_splats=250")
SCALE = 0.001  # 30 + 10 + 20 iterations


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("data") / "ball")


def options(capture: Path, out: Path, **changes: Any) -> TrainOptions:
    plain = TrainOptions(scene=capture, out=out, schedule_scale=SCALE, overrides=SMALL, threads=1, checkpoint_every=4)
    return replace(plain, **changes)


@pytest.fixture(scope="module")
def undisturbed(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return train(options(capture, tmp_path_factory.mktemp("runs") / "undisturbed"))


def comparable(run: RunFolder) -> tuple[bytes, list[dict[str, Any]], list[dict[str, Any]]]:
    """All of a run that may not depend on how it got there: splats, log, metrics without times."""
    stages = [
        {k: v for k, v in stage.items() if k not in ("seconds", "peak_memory_bytes", "reused_from")}
        for stage in run.metrics()["stages"]
    ]
    return run.file("splats.ply").read_bytes(), run.events.read(), stages


def test_a_run_holds_everything_that_was_promised(undisturbed: RunFolder) -> None:
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


def test_metrics_have_an_entry_for_each_stage_with_a_reason_for_each_null(undisturbed: RunFolder) -> None:
    stages = undisturbed.metrics()["stages"]
    assert [(s["name"], s["iterations"]) for s in stages] == [("surface", 30), ("appearance", 10), ("refine", 20)]
    for stage in stages:
        assert stage["seconds"] > 0
        assert stage["peak_memory_bytes"] > 10_000_000
        for split in ("train", "test"):
            assert 0 < stage[split]["psnr"] < 60
            assert -1 < stage[split]["ssim"] < 1
            assert stage[split]["lpips"] is None
            assert "weights" in stage[split]["lpips_reason"]
    assert "after_clone" not in stages[0]
    assert stages[2]["after_clone"]["train"]["psnr"] != stages[1]["train"]["psnr"]


def test_the_log_has_the_figures_of_every_curve(undisturbed: RunFolder) -> None:
    steps = [event for event in undisturbed.events.read() if event["kind"] == "step"]
    assert steps[-1]["total_iteration"] == 60
    assert {event["stage"] for event in steps} == {"surface", "appearance", "refine"}
    for event in steps:
        assert {"loss", "losses", "splats", "mean_opacity", "mean_area", "iteration"} <= set(event)
    assert any("psnr" in event for event in steps)
    kinds = {event["kind"] for event in undisturbed.events.read()}
    assert {"initialised", "stage_start", "stage_end", "ranked", "cloned", "after_clone"} <= kinds


def test_pictures_of_every_stage_lie_beside_the_photographs(undisturbed: RunFolder) -> None:
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


class Stop(Exception):
    """Stands for a kill."""


@pytest.mark.parametrize("stop_after", [3, 13, 30, 37, 41, 59])
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


def test_a_run_stopped_between_the_end_of_a_stage_and_its_scores_is_scored_on_resume(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    def listen(event: Event) -> None:
        if isinstance(event, StageDone):
            raise Stop

    with pytest.raises(Stop):
        train(options(capture, tmp_path / "run"), listen)
    run = RunFolder(tmp_path / "run")
    run.write_metrics({"stages": [], "surface": None})  # as if killed before they were written
    assert comparable(train(options(capture, tmp_path / "run", resume=True))) == comparable(undisturbed)


def spawn(capture: Path, out: Path, *more: str) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", "gs2d", "train", str(capture), "--out", str(out), "--schedule-scale", str(SCALE)]
    words += ["--threads", "1", "--checkpoint-every", "4", "--quiet", *more]
    for override in SMALL:
        words += ["--set", override]
    return subprocess.Popen(words, env=dict(os.environ), stderr=subprocess.PIPE)


@pytest.mark.parametrize("when", [(0, 12.0), (1, float("inf"))])  # in the first stage; at the end of the second
def test_a_killed_process_resumes_to_the_same_splats_byte_for_byte(
    capture: Path, undisturbed: RunFolder, tmp_path: Path, when: tuple[int, float]
) -> None:
    process = spawn(capture, tmp_path / "run")
    deadline = time.monotonic() + 250
    while not any(saved.progress >= when for saved in RunFolder(tmp_path / "run").checkpoints()):
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < deadline
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not (tmp_path / "run" / "splats.ply").exists()
    again = spawn(capture, tmp_path / "run", "--resume")
    assert again.communicate(timeout=250)[1] == b""
    assert again.returncode == 0
    assert comparable(open_run(tmp_path / "run")) == comparable(undisturbed)


def test_resuming_a_finished_run_changes_nothing(capture: Path, undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    before = comparable(RunFolder(copy))
    mesh = (copy / "mesh.ply").read_bytes()
    assert comparable(train(options(capture, copy, resume=True))) == before
    assert (copy / "mesh.ply").read_bytes() == mesh


def test_resume_goes_back_one_checkpoint_when_the_last_is_damaged_and_says_so(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    (copy / "checkpoints" / "2-refine-end.pt").write_bytes(b"damaged")
    (copy / "splats.ply").unlink()
    heard: list[Event] = []
    resumed = train(options(capture, copy, resume=True), heard.append)
    notices = [event.text for event in heard if isinstance(event, Notice)]
    assert any("2-refine-end.pt is not a readable checkpoint" in text for text in notices)
    assert comparable(resumed) == comparable(undisturbed)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seed": 1}, r"another recipe \(seed: 0, now 1\)"),
        ({"overrides": (*SMALL, "refine.iterations=25")}, r"recipe \(stages.refine.iterations: 20, now 25\)"),
        ({"protocol": "generic"}, r"another protocol \(name: nerf-synthetic, now generic\)"),
        ({"downscale": 2}, r"another downscale \(1, now 2\)"),
        ({"stage2_cache_mb": 0}, r"another stage2_cache_bytes \(1073741824, now 0\)"),
    ],
)
def test_resuming_with_other_options_is_refused_and_names_the_difference(
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


def test_another_seed_or_setting_does_not_take_a_stage_from_the_cache(capture: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first = options(capture, tmp_path / "a", recipe="2dgs", cache=cache)
    train(first)
    train(replace(first, out=tmp_path / "b", seed=1))
    train(replace(first, out=tmp_path / "c", overrides=(*SMALL, "surface.rates.sh0=0.003")))
    train(replace(first, out=tmp_path / "d", downscale=2))
    assert len(list(cache.glob("*.pt"))) == 4
    assert all("reused_from" not in open_run(tmp_path / x).metrics()["stages"][0] for x in "abcd")


def test_runs_share_stages_with_and_without_cached_views_up_to_the_one_that_uses_them(
    capture: Path, tmp_path: Path
) -> None:
    jobs = [
        prepare(options(capture, tmp_path, overrides=(*SMALL, f"appearance.iterations={iterations}"), **more), ignore)
        for iterations in (11, 12)  # six views: cached from twelve iterations
        for more in ({}, {"stage2_cache_mb": 0})
    ]
    with_cache = jobs[0].backend.name == "cpu"
    same_key = [[a.stage_key(i) == b.stage_key(i) for i in range(3)] for a, b in (jobs[:2], jobs[2:])]
    assert same_key == [[True] * 3, [True, not with_cache, not with_cache]]
    assert [job.definition()["stage2_cache_bytes"] for job in jobs] == [1 << 30, 0, 1 << 30, 0]


def test_a_run_starts_from_the_stages_it_shares_with_another(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    overrides = (*SMALL, "refine.iterations=6")
    run = train(options(capture, tmp_path / "run", start_from=undisturbed.path, overrides=overrides))
    assert [("reused_from" in stage) for stage in run.metrics()["stages"]] == [True, True, False]
    assert run.metrics()["stages"][2]["iterations"] == 6


def test_starting_from_a_run_that_shares_no_stage_is_an_error_that_leaves_nothing(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    with pytest.raises(RunError, match=r"no finished stage in common .* \(its stages: surface, appearance, refine\)"):
        train(options(capture, tmp_path / "run", start_from=undisturbed.path, seed=5))
    assert list(tmp_path.iterdir()) == []


def test_the_same_seed_gives_the_same_bytes(capture: Path, undisturbed: RunFolder, tmp_path: Path) -> None:
    again = train(options(capture, tmp_path / "again", checkpoint_every=1000))
    assert again.file("splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()
    other = train(options(capture, tmp_path / "other", seed=1))
    assert other.file("splats.ply").read_bytes() != undisturbed.file("splats.ply").read_bytes()


def test_nan_stops_the_run_and_names_iteration_attribute_and_checkpoint(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.train import loop

    step = loop.adam_step

    def poisoned(state: Any, *args: Any, **kwargs: Any) -> None:
        step(state, *args, **kwargs)
        if state.step == 19:  # the twentieth iteration is under way
            state.splats.log_scales[0, 0] = float("nan")

    monkeypatch.setattr(loop, "adam_step", poisoned)
    with pytest.raises(DivergedError) as error:
        train(options(capture, tmp_path / "run"))
    message = str(error.value)
    assert "iteration 20 of stage 'surface'" in message
    assert "log_scales" in message
    assert f"the last good checkpoint is {tmp_path / 'run' / 'checkpoints' / '0-surface-0000016.pt'}" in message


def test_a_full_disk_before_the_first_checkpoint_leaves_nothing(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.io import run as run_module

    def full(path: Path, _payload: Any) -> None:
        raise DiskError(f"cannot write {path}: No space left on device; free some space or choose another folder")

    monkeypatch.setattr(run_module, "save_tensors", full)
    with pytest.raises(DiskError, match="No space left"):
        train(options(capture, tmp_path / "deep" / "run"))
    assert list(tmp_path.iterdir()) == []


def test_a_recipe_that_names_an_unknown_group_fails_before_the_capture_is_read(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="no earlier action writes the row group"):
        train(options(tmp_path / "missing", tmp_path / "run", overrides=("refine.train.means=nobody",)))


@pytest.mark.parametrize(
    ("changes", "got"),
    [
        ({"downscale": 0}, "got 0"),
        ({"checkpoint_every": 0}, "got 0"),
        ({"stage2_cache_mb": -1}, "got -1"),
        ({"checkpoint_seconds": float("nan")}, "got nan"),
        ({"threads": 0}, "got 0"),
        ({"threads": 1_000_000}, "from 1 to 1024, got 1000000"),
        ({"schedule_scale": 0.0}, "got 0"),
        ({"seed": 2**63}, "at most 2.63 - 1"),
        ({"overrides": ("name=",)}, "must have a name"),
    ],
)
def test_numbers_out_of_range_are_refused(capture: Path, tmp_path: Path, changes: dict[str, Any], got: str) -> None:
    with pytest.raises(RecipeError, match=got):
        train(options(capture, tmp_path / "run", **changes))
    assert list(tmp_path.iterdir()) == []


def test_meshing_again_keeps_to_the_box_and_the_voxel(undisturbed: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "half.ply"
    result = mesh_run(undisturbed.path, MeshOptions(bbox=(-1, -1, 0, 1, 1, 1), voxel=0.1, depth="median"), out=out)
    assert result["voxel"] == pytest.approx(0.1)
    assert result["truncation"] > result["voxel"]
    mesh = read_mesh(out)
    assert result["vertices"] == len(mesh.vertices)
    if len(mesh.vertices):
        assert mesh.vertices.min(axis=0)[2] > -0.2


@pytest.mark.parametrize(
    "bad",
    [
        {"voxel": -1.0},
        {"voxel": 0.0},
        {"truncation": 0.0},
        {"depth_limit": float("nan")},
        {"keep_components": -1},
        {"bbox": (1, 1, 1, 0, 0, 0)},
    ],
)
def test_meshing_with_senseless_limits_is_refused_before_anything_is_rendered(
    undisturbed: RunFolder, tmp_path: Path, bad: dict[str, Any]
) -> None:
    heard: list[Event] = []
    with pytest.raises(ProtocolError, match=f"--{next(iter(bad)).replace('_', '-')} must be"):
        mesh_run(undisturbed.path, MeshOptions(**bad), heard.append, out=tmp_path / "x.ply")
    assert list(tmp_path.iterdir()) == []
    assert not any(isinstance(event, Step) for event in heard)


def test_a_finished_run_whose_checkpoints_were_deleted_is_never_touched_by_resume(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    shutil.rmtree(copy / "checkpoints")  # to save space
    for changes, words in (({}, "finished and its checkpoints are gone"), ({"seed": 1}, "another recipe")):
        with pytest.raises(RunError, match=words):
            train(options(capture, copy, resume=True, **changes))
        for name in ("splats.ply", "mesh.ply", "metrics.json", "report.html"):
            assert (copy / name).read_bytes() == undisturbed.file(name).read_bytes()


def test_resuming_a_finished_run_keeps_the_scores_of_its_mesh(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    surface = {"chamfer": 0.5, "thresholds": []}
    run.write_metrics({**run.metrics(), "surface": surface})
    assert train(options(capture, run.path, resume=True)).metrics()["surface"] == surface


def test_splats_that_give_no_mesh_still_give_a_report(
    capture: Path, undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.pipeline import train as train_module

    def nothing(*_args: Any, **_kwargs: Any) -> None:
        raise ProtocolError("depth was expected, got none")

    monkeypatch.setattr(train_module, "extract_mesh", nothing)
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    for name in ("mesh.ply", "report.html"):
        (copy / name).unlink()
    with pytest.raises(ProtocolError, match="no mesh of .*: depth was expected, got none; splats and report"):
        train(options(capture, copy, resume=True))
    assert "There is no mesh.ply" in (copy / "report.html").read_text()


def test_an_empty_mesh_is_said_to_be_empty_in_the_report(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    write_mesh(copy / "mesh.ply", Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)))
    report_run(copy)
    assert "mesh.ply has no faces" in (copy / "report.html").read_text()


@pytest.mark.parametrize("name", ["protocol", "raster", "backend", "downscale"])
def test_a_damaged_definition_is_named_when_the_run_is_used(
    undisturbed: RunFolder, tmp_path: Path, name: str
) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    data = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({key: value for key, value in data.items() if key != name}))
    with pytest.raises(RunError, match=name):
        render_run(copy)


@pytest.mark.parametrize(("text", "kind"), [("splats.ply", "splats"), ("bad", "vertex indices below 1")])
def test_a_ground_truth_of_another_kind_is_refused_before_the_run_is_read(
    undisturbed: RunFolder, tmp_path: Path, text: str, kind: str
) -> None:
    file = undisturbed.file("splats.ply")
    if text == "bad":  # a mesh whose face names no vertex is a broken mesh, never a point cloud
        file = tmp_path / "bad.ply"
        header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        file.write_text(header + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 7\n")
    with pytest.raises(DataError, match=kind):
        evaluate_run(tmp_path / "no run", EvaluateOptions(ground_truth=file))


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("inf"), float("nan")])
def test_a_threshold_that_is_no_distance_is_refused_first(tmp_path: Path, threshold: float) -> None:
    with pytest.raises(DataError, match="--thresholds must be positive distances"):
        evaluate_run(tmp_path / "no run", EvaluateOptions(thresholds=(0.1, threshold)))


def test_a_shorter_orbit_leaves_no_frame_of_a_longer_one(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    for frames in (3, 2):
        render_run(copy, orbit=frames)
    assert len(list((copy / "renders" / "orbit").glob("*.png"))) == 2


def test_rendering_writes_one_png_for_each_view(undisturbed: RunFolder, tmp_path: Path) -> None:
    assert render_run(undisturbed.path, split="train", out=tmp_path / "train")["images"] == 6
    assert len(list((tmp_path / "train").glob("*.png"))) == 6
    assert render_run(undisturbed.path, orbit=3, out=tmp_path / "orbit")["images"] == 3
    assert sorted(p.name for p in (tmp_path / "orbit").iterdir()) == ["0000.png", "0001.png", "0002.png"]


def test_an_orbit_looks_at_the_focus_from_a_constant_height() -> None:
    from tiny import ball_cameras

    circle = orbit_cameras(ball_cameras(12), 8)
    centers = np.array([camera.center for camera in circle])
    for camera in circle:
        to_focus = -camera.center / np.linalg.norm(camera.center)  # the ball's cameras look at the origin
        assert camera.forward @ to_focus == pytest.approx(1.0, abs=1e-6)
    radii = np.linalg.norm(centers, axis=1)
    assert np.ptp(radii) < 1e-9


def test_exporting_writes_the_layout_that_viewers_open(undisturbed: RunFolder, tmp_path: Path) -> None:
    result = export_run(undisturbed.path, tmp_path / "out.ply", "3dgs")
    head = (tmp_path / "out.ply").read_bytes()[:2000].decode("latin1")
    assert "property float scale_2" in head
    assert result["splats"] == len(read_splats(undisturbed.file("splats.ply")))


def test_an_unfinished_run_cannot_be_exported(capture: Path, tmp_path: Path) -> None:
    def listen(event: Event) -> None:
        if isinstance(event, StageDone):
            raise Stop

    with pytest.raises(Stop):
        train(options(capture, tmp_path / "run"), listen)
    with pytest.raises(RunError, match="is not finished"):
        export_run(tmp_path / "run", tmp_path / "x.ply", "2dgs")
    assert report_run(tmp_path / "run").exists()


def test_evaluating_scores_the_surface_against_a_mesh(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    write_ball_mesh(copy / "mesh.ply")
    write_ball_mesh(tmp_path / "truth.ply")
    truth = EvaluateOptions(ground_truth=tmp_path / "truth.ply", thresholds=(0.02, 0.05))
    result = evaluate_run(copy, truth)
    rows = result["surface"]["thresholds"]
    assert [row["threshold"] for row in rows] == [0.02, 0.05]
    assert rows[-1]["f_score"] > 0.99  # the same surface
    assert open_run(copy).metrics()["surface"]["thresholds"] == rows
    assert result["test"]["psnr"] == pytest.approx(undisturbed.metrics()["stages"][-1]["test"]["psnr"], abs=0.02)


def test_a_capture_that_moved_is_named(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    definition = json.loads((copy / "run.json").read_text())
    definition["scene"]["path"] = str(tmp_path / "gone")
    (copy / "run.json").write_text(json.dumps(definition))
    with pytest.raises(RunError, match="was at .*gone, which is not there"):
        render_run(copy)


def test_training_leaves_the_threads_of_torch_as_asked(capture: Path, undisturbed: RunFolder) -> None:
    assert torch.get_num_threads() == 1


def test_the_demo_makes_its_capture_trains_scores_the_surface_and_reports(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    small = DemoOptions(out=out, threads=1, schedule_scale=0.0005, train_views=3, test_views=1, size=24)
    run = demo(small)
    metrics = run.metrics()
    assert [stage["name"] for stage in metrics["stages"]] == ["surface", "appearance", "refine"]
    assert len(metrics["surface"]["thresholds"]) >= 3
    assert metrics["surface"]["ground_truth"].endswith("mesh_gt.ply")
    assert (out / "capture" / "transforms_train.json").exists()
    assert (out / "report.html").exists()
    before = run.file("splats.ply").read_bytes()
    again = demo(replace(small, resume=True))  # the capture is taken as it is
    assert again.file("splats.ply").read_bytes() == before
    assert again.metrics()["surface"] is not None


def test_the_demo_does_not_replace_a_run_of_another_kind(undisturbed: RunFolder) -> None:
    before = comparable(undisturbed)
    with pytest.raises(RunError, match="holds a run that is not a demo"):
        demo(DemoOptions(out=undisturbed.path))
    assert comparable(undisturbed) == before


def test_the_user_is_told_where_training_starts_and_what_was_skipped(capture: Path, tmp_path: Path) -> None:
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
    assert "starting from 150 random points in the box the cameras look at" in texts
    assert any("r_0" in text for text in texts)
    assert "... and 1 more views skipped; `gs2d info` lists them" in texts
    assert any(text.startswith("near plane at") for text in texts)
    assert not (tmp_path / "run").exists()  # nothing was saved yet
