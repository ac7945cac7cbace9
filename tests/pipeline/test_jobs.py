"""What is done with a trained run: mesh, render, score, export, report again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ball_runs import Stop, options
from gs2d.core.mesh import Mesh
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.data.image_files import read_image
from gs2d.errors import DataError, DiskError, ProtocolError, RecipeError, RunError
from gs2d.io.meshes import read_mesh, write_mesh
from gs2d.io.run_dir import RunFolder, open_run
from gs2d.io.splat_ply import read_splats, write_splats
from gs2d.pipeline.events import Event, StageDone, Step
from gs2d.pipeline.finish.camera_paths import orbit_cameras
from gs2d.pipeline.finish.evaluate import evaluate_run
from gs2d.pipeline.finish.export import export_run
from gs2d.pipeline.finish.run_images import file_name, file_names, render_run
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.finish.run_report import report_run
from gs2d.pipeline.look.page import page_run
from gs2d.pipeline.prepare.options import EvaluateOptions, MeshOptions, TrainOptions
from gs2d.pipeline.train.train_run import train
from tiny import ball_cameras, write_ball_mesh


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
    with pytest.raises((ProtocolError, DataError), match=f"--{next(iter(bad)).replace('_', '-')} must be"):
        mesh_run(undisturbed.path, MeshOptions(**bad), heard.append, out=tmp_path / "x.ply")
    assert list(tmp_path.iterdir()) == []
    assert not any(isinstance(event, Step) for event in heard)


def test_an_empty_mesh_is_said_to_be_empty_in_the_report(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    write_mesh(copy / "mesh.ply", Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)))
    report_run(copy)
    assert "mesh.ply has no faces" in (copy / "report.html").read_text()


@pytest.mark.parametrize("name", ["protocol", "raster", "backend", "downscale"])
def test_a_damaged_definition_is_named_when_the_run_is_used(undisturbed: RunFolder, tmp_path: Path, name: str) -> None:
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


def test_two_commands_do_not_render_into_the_same_folder_of_a_run(undisturbed: RunFolder, tmp_path: Path) -> None:
    """The second would delete the frames of the first, which it then could not make a film of."""
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    render_run(copy, orbit=3, threads=1)
    with (
        RunFolder(copy / "renders" / "orbit").locked(),
        pytest.raises(RunError, match="orbit is written by another process; wait for it or choose another --out"),
    ):
        render_run(copy, orbit=2, threads=1)
    assert len(list((copy / "renders" / "orbit").glob("*.png"))) == 3
    render_run(copy, orbit=2, threads=1)
    assert len(list((copy / "renders" / "orbit").glob("*.png"))) == 2


def test_rendering_writes_one_png_for_each_view(undisturbed: RunFolder, tmp_path: Path) -> None:
    assert render_run(undisturbed.path, split="train", out=tmp_path / "train")["images"] == 6
    assert len(list((tmp_path / "train").glob("*.png"))) == 6
    assert render_run(undisturbed.path, orbit=3, out=tmp_path / "orbit")["images"] == 3
    assert sorted(p.name for p in (tmp_path / "orbit").iterdir()) == ["0000.png", "0001.png", "0002.png"]


def test_views_with_long_names_have_short_files_that_differ() -> None:
    def name_of(name: str) -> str:
        return file_name(View.from_arrays(name, ball_cameras(1, 2)[0], np.zeros((2, 2, 3), np.uint8)))

    names = [name_of(f"test/{'é' * 200}{end}.png") for end in "ab"]
    assert all(len(f".{name}.high_error.png.1234567.12345678.tmp".encode()) <= 255 for name in names)
    assert names[0] != names[1]
    assert name_of("test/r_0.png") == "test__r_0"


def test_views_whose_names_differ_in_the_ending_or_the_case_only_have_files_of_their_own() -> None:
    wanted = ["x.png", "x.jpg", "a/b.png", "a__b.png", "Y.png", "y.png", "z.png"]
    views = [View.from_arrays(name, ball_cameras(1, 2)[0], np.zeros((2, 2, 3), np.uint8)) for name in wanted]
    names = file_names(views)
    assert len({name.lower() for name in names}) == len(wanted)
    assert names[-1] == "z"  # nobody else's
    assert names[0].startswith("x-")
    assert file_names(views) == names


def test_an_orbit_looks_at_the_focus_from_a_constant_height() -> None:
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


@pytest.mark.parametrize("command", [export_run, mesh_run, page_run, report_run])
def test_a_command_removes_what_a_killed_one_left_in_the_run(
    undisturbed: RunFolder, tmp_path: Path, command: Callable[..., Any]
) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    for name in (".scene.html.gs2d.tmp", "checkpoints/.2-refine-end.pt.gs2d.tmp"):
        run.file(name).write_bytes(b"half")
    command(run.path, *([tmp_path / "out.spz"] if command is export_run else []))
    assert not list(run.path.rglob("*.tmp"))


def test_strings_are_paths_too(undisturbed: RunFolder, tmp_path: Path) -> None:
    run: Any = str(undisturbed.path)
    result = export_run(run, str(tmp_path / "a.ply"), "3dgs")  # type: ignore[arg-type]
    assert result["file"] == str(tmp_path / "a.ply")
    video, frames = str(tmp_path / "a.webp"), str(tmp_path / "frames")
    assert render_run(run, orbit=2, video=video, out=frames)["images"] == 2  # type: ignore[arg-type]
    assert EvaluateOptions(ground_truth=video).ground_truth == tmp_path / "a.webp"  # type: ignore[arg-type]
    given = TrainOptions(scene="capture", out="run", cache="cache")  # type: ignore[arg-type]
    assert (given.scene, given.out, given.cache) == (Path("capture"), Path("run"), Path("cache"))
    assert given.start_from is None
    with pytest.raises(RecipeError, match="must be a name that `gs2d recipes` lists or a Recipe, got NoneType"):
        train(TrainOptions(scene="capture", out="run", recipe=None))  # type: ignore[arg-type]


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


@pytest.mark.parametrize("name", ["x.obj", "photo.png", "x", "run/run.json", "run/splats.ply"])
def test_a_result_is_not_written_under_a_name_that_it_is_not_nor_over_the_splats_of_the_run(
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


def test_a_mesh_written_over_that_of_the_run_is_the_mesh_of_the_run(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    old = json.loads((copy / "metrics.json").read_text())
    (copy / "metrics.json").write_text(json.dumps({**old, "surface": {"f_score": 1.0}}))
    mesh_run(copy, MeshOptions(voxel=0.1), out=copy / "mesh.ply", threads=1)
    assert json.loads((copy / "metrics.json").read_text())["surface"] is None  # was of the mesh before


def test_a_rendering_is_not_written_over_a_photograph(
    capture: Path, undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def plain(views: Sequence[View]) -> list[str]:
        return [Path(view.name).stem for view in views]  # as in captures without sub-folders

    monkeypatch.setattr("gs2d.pipeline.finish.run_images.file_names", plain)
    image = capture / "test" / "r_0.png"
    before = image.read_bytes()
    with pytest.raises(RunError, match=r"--out would write over the capture's photograph .*r_0\.png"):
        render_run(undisturbed.path, out=capture / "test", threads=1)
    assert image.read_bytes() == before
    assert render_run(undisturbed.path, out=tmp_path / "out", threads=1)["images"] == 2


def test_a_rendering_that_fails_leaves_none_of_its_pictures_and_no_folder(
    undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gs2d.pipeline.finish import run_images as render

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
            render_run(undisturbed.path, orbit=5, out=folder, threads=1)
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["0001.png"]


@pytest.mark.parametrize("frames", [-1, 10**9])
def test_an_orbit_of_a_senseless_number_of_frames_is_refused(undisturbed: RunFolder, frames: int) -> None:
    with pytest.raises(RunError, match="--orbit must be a number of frames from 1 to 100000"):
        render_run(undisturbed.path, orbit=frames, threads=1)


def test_splats_with_nan_are_not_rendered_as_if_they_were_not_there(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    splats = read_splats(copy / "splats.ply")
    splats.means[3, 1], splats.shN[5, 0, 0] = float("nan"), float("inf")
    write_splats(copy / "splats.ply", splats)
    with pytest.raises(RunError, match=r"splats\.ply must hold finite numbers, got NaN or infinity in 2 splats"):
        render_run(copy, threads=1)


def test_no_splats_at_all_are_an_empty_picture(undisturbed: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    splats = read_splats(copy / "splats.ply")
    write_splats(copy / "splats.ply", Splats(**{name: tensor[:0] for name, tensor in splats.items()}))
    assert render_run(copy, out=tmp_path / "out", threads=1)["images"] == 2
    assert (read_image(next((tmp_path / "out").iterdir())) == 255).all()
