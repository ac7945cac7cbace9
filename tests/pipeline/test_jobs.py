"""Commands on a trained run: mesh, render, evaluate, export, report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ball_runs import Stop, options
from gs2d.contrib.pictures.pictures_command import RenderOptions
from gs2d.contrib.pictures.render_run import render_run
from gs2d.data import View
from gs2d.errors import DataError, DiskError, RunError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import RunFolder, open_run
from gs2d.io.splat_ply import read_splats, write_splats
from gs2d.pipeline.finish.evaluate import evaluate_run
from gs2d.pipeline.finish.run_images import file_names
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.finish.run_report import report_run
from gs2d.pipeline.finish.splat_files import export_run
from gs2d.pipeline.look.page import page_run
from gs2d.pipeline.prepare.options import EvaluateOptions, MeshOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, StageScored
from tiny import ball_cameras, write_ball_mesh


def test_meshing_again_uses_the_box_and_the_voxel_size(undisturbed: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "half.ply"
    result = mesh_run(undisturbed.path, MeshOptions(bbox=(-1, -1, 0, 1, 1, 1), voxel=0.1, depth="median"), out=out)
    assert result["voxel"] == pytest.approx(0.1)
    assert result["truncation"] > result["voxel"]
    mesh = read_mesh(out)
    assert result["vertices"] == len(mesh.vertices)
    if len(mesh.vertices):
        assert mesh.vertices.min(axis=0)[2] > -0.2


@pytest.mark.parametrize(("text", "kind"), [("splats.ply", "splats"), ("bad", "vertex indices from")])
def test_an_invalid_ground_truth_is_an_error_before_the_run_is_read(
    undisturbed: RunFolder, tmp_path: Path, text: str, kind: str
) -> None:
    file = undisturbed.file("splats.ply")
    if text == "bad":  # a mesh whose face names no vertex is a broken mesh, never a point cloud
        file = tmp_path / "bad.ply"
        header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        file.write_text(header + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 7\n")
    with pytest.raises(DataError, match=kind):
        evaluate_run(tmp_path / "no run", EvaluateOptions(ground_truth=file))


def test_two_commands_cannot_render_into_a_run(undisturbed: RunFolder, tmp_path: Path) -> None:
    """The second would delete the frames of the first, which it then could not make a film of."""
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    render_run(copy, RenderOptions(orbit=3), threads=1)
    with (
        RunFolder(copy).locked(),
        pytest.raises(RunError, match="process"),
    ):
        render_run(copy, RenderOptions(orbit=2), threads=1)
    assert len(list((copy / "renders" / "orbit").glob("*.png"))) == 3
    render_run(copy, RenderOptions(orbit=2), threads=1)
    assert len(list((copy / "renders" / "orbit").glob("*.png"))) == 2


def test_views_with_similar_names_have_different_files() -> None:
    wanted = ["x.png", "x.jpg", "a/b.png", "a__b.png", "Y.png", "y.png", "z.png"]
    views = [View.from_arrays(name, ball_cameras(1, 2)[0], np.zeros((2, 2, 3), np.uint8)) for name in wanted]
    names = file_names(views)
    assert len({name.lower() for name in names}) == len(wanted)
    assert names[-1] == "z"  # its name is unique
    assert names[0].startswith("x-")
    assert file_names(views) == names


@pytest.mark.parametrize("command", [export_run, mesh_run, page_run, report_run])
def test_a_command_removes_temporary_files_of_a_killed_one(
    undisturbed: RunFolder, tmp_path: Path, command: Callable[..., Any]
) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    for name in (".scene.html.gs2d.tmp", "checkpoints/.2-refine-end.pt.gs2d.tmp"):
        run.file(name).write_bytes(b"half")
    command(run.path, *([tmp_path / "out.spz"] if command is export_run else []))
    assert not list(run.path.rglob("*.tmp"))


def test_an_unfinished_run_cannot_be_exported(capture: Path, tmp_path: Path) -> None:
    def listen(event: Event) -> None:
        if isinstance(event, StageScored):
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


def test_a_missing_capture_is_an_error_with_its_path(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(undisturbed.path, copy)
    definition = json.loads((copy / "run.json").read_text())
    definition["scene"]["path"] = str(tmp_path / "gone")
    (copy / "run.json").write_text(json.dumps(definition))
    with pytest.raises(RunError, match="gone"):
        render_run(copy)


@pytest.mark.parametrize("name", ["x.obj", "photo.png", "x", "run/run.json", "run/splats.ply"])
def test_outputs_need_the_right_ending_and_do_not_overwrite_the_splats(
    undisturbed: RunFolder, tmp_path: Path, name: str
) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    (tmp_path / "photo.png").write_text("mine")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(RunError, match=r"--out .*(a \.ply file|splats of the run)"):
        export_run(copy, tmp_path / name, "3dgs")
    with pytest.raises(RunError, match=r"--out .*(a \.ply file|splats of the run)"):
        mesh_run(copy, out=tmp_path / name)
    with pytest.raises(RunError, match="is the mesh of the run"):
        export_run(copy, copy / ".." / "run" / "mesh.ply", "3dgs")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_rendering_does_not_overwrite_a_photograph(
    capture: Path, undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def plain(views: Sequence[View]) -> list[str]:
        return [Path(view.name).stem for view in views]  # as in captures without sub-folders

    monkeypatch.setattr("gs2d.contrib.pictures.render_run.file_names", plain)
    image = capture / "test" / "r_0.png"
    before = image.read_bytes()
    with pytest.raises(RunError, match="--out"):
        render_run(undisturbed.path, out=capture / "test", threads=1)
    assert image.read_bytes() == before
    assert render_run(undisturbed.path, out=tmp_path / "out", threads=1)["images"] == 2


def test_a_failed_rendering_leaves_no_images_and_no_folder(
    undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.contrib.pictures import render_run as render

    write = render.write_image

    def full(path: Path, image: np.ndarray) -> None:
        if path.name.startswith("0003"):
            raise DiskError("no space left")
        write(path, image)

    monkeypatch.setattr(render, "write_image", full)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "0001.png").write_text("an older picture")
    for folder in (tmp_path / "new" / "deep", tmp_path / "mine"):
        with pytest.raises(DiskError):
            render_run(undisturbed.path, RenderOptions(orbit=5), out=folder, threads=1)
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["0001.png"]


def test_splats_with_nan_are_an_error(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    splats = read_splats(copy / "splats.ply")
    splats.means[3, 1], splats.shN[5, 0, 0] = float("nan"), float("inf")
    write_splats(copy / "splats.ply", splats)
    with pytest.raises(RunError, match=r"splats\.ply"):
        render_run(copy, threads=1)
