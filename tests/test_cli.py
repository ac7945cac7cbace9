"""The command line: exit codes, one-line errors that leave nothing behind, JSON that is only JSON."""

from __future__ import annotations

import json
import os
import resource
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import gs2d
from gs2d.cli import app as app_module
from gs2d.cli import run
from gs2d.recipes import RECIPES
from tiny import ball_cameras, ball_picture, write_ball_mesh, write_capture

TINY = ["--schedule-scale", "0.0005", "--set", "init_points=100", "--set", "surface.densify.max_splats=150"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("data") / "ball", train=3, test=1, size=20)


@pytest.fixture(scope="module")
def trained(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert run(["train", str(capture), "--out", str(out), "--quiet", "--threads", "1", *TINY]) == 0
    return out


def one_line(text: str) -> str:
    """The only line of a stderr, which must be an error."""
    lines = text.splitlines()
    assert len(lines) == 1, text
    assert lines[0].startswith("error: ")
    return lines[0]


# -- arguments ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["train"], "--out RUN"),
        (["train", "here", "--out", "there", "--downscale", "two"], "--downscale"),
        (["train", "here", "--out", "there", "--nonsense"], "--nonsense"),
        (["train", "here", "--out", "there", "--backend", "gpu"], "--backend"),
        (["paint"], "paint"),
        (["paint"], "see `gs2d --help`"),
        (["mesh", "here", "--bbox", "1", "2", "3"], "input length 3 did not match expected argument count 6 of `FLOAT"),
        (["train", "here", "--out", "there", "--resume", "--overwrite"], "exclude each other"),
    ],
)
def test_arguments_that_do_not_parse_give_one_line_and_exit_code_2(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert named in one_line(err)


def test_help_is_instant_because_it_does_not_import_torch() -> None:
    code = "import sys; from gs2d.cli import run; run(['--help']); run(['train', '--help']); run(['recipes']); "
    code += "assert 'torch' not in sys.modules; assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("words", [["--help"], [], ["train", "--help"]])
def test_help_exits_with_0(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words) == 0
    assert "usage: gs2d" in capsys.readouterr().out


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"gs2d {gs2d.__version__}\n"


# -- recipes, doctor, info ------------------------------------------------------------------------------
def test_recipes_lists_every_recipe_and_shows_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["recipes"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in RECIPES)
    assert run(["recipes", "show", "2dgs-r", "--schedule-scale", "0.1"]) == 0
    shown = capsys.readouterr().out
    assert "2dgs-r: 6,000 iterations" in shown
    assert "2. appearance: 1,000 iterations" in shown


def test_recipes_show_json_is_the_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["recipes", "show", "2dgs-r", "--set", "refine.iterations=7", "--json"]) == 0
    recipe = json.loads(capsys.readouterr().out)
    assert [stage["iterations"] for stage in recipe["stages"]] == [30_000, 10_000, 7]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["recipes", "show", "2dgs-s"], "no recipe '2dgs-s'; there is 2dgs-r"),
        (["recipes", "show"], "needs the name"),
        (["recipes", "show", "2dgs", "--set", "surface.iteration=3"], "iteration"),
        (["recipes", "show", "2dgs", "--set", "nonsense"], "stage.field=value"),
        (["recipes", "show", "2dgs-r", "--set", "refine.train.means=nobody"], "row group 'nobody'"),
    ],
)
def test_a_recipe_that_cannot_be_trained_is_one_line(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 2
    assert named in one_line(capsys.readouterr().err)


def test_doctor_says_what_runs_and_why_the_rest_does_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "yes  reference" in text
    if "yes  cuda" not in text:
        assert "no   cuda: " in text
        assert "to get it: " in text.partition("no   cuda")[2]
    assert run(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [backend["name"] for backend in report["backends"]] == ["cuda", "cpu", "reference"]
    assert report["auto"] in ("cuda", "cpu", "reference")


def test_doctor_without_the_native_library_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.kernels import library

    monkeypatch.setattr(library, "FOLDER", tmp_path)
    assert run(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "no   cpu" in text
    assert "C++" in text
    assert "compiler" in text
    assert "pip install --force-reinstall" in text
    assert "--backend auto takes: " in text
    assert "--backend auto takes: cpu" not in text


def test_asking_for_a_backend_that_is_not_here_is_one_line(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["train", str(capture), "--out", str(tmp_path / "run"), "--backend", "cuda"]) == 2
    assert "cuda" in one_line(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_info_describes_a_run_a_capture_and_a_ply(
    trained: Path, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = {}
    viewer = tmp_path / "viewer.ply"
    assert run(["export", str(trained), "--out", str(viewer), "--quiet"]) == 0
    paths = {"run": trained, "capture": capture, "ply": trained / "splats.ply", "viewer": viewer}
    for name, path in paths.items():
        assert run(["info", str(path), "--json"]) == 0
        facts[name] = json.loads(capsys.readouterr().out)
    assert facts["capture"]["format"] == "blender"
    assert facts["capture"]["training views"] == 3
    assert facts["run"]["stages"][-1]["splats"] == facts["ply"]["splats"]
    assert (facts["ply"]["layout"], facts["viewer"]["layout"][:4]) == ("2dgs", "3dgs")
    assert facts["viewer"]["splats"] == facts["ply"]["splats"]
    assert facts["run"]["definition"]["recipe"]["name"] == "2dgs-r"


# -- results --------------------------------------------------------------------------------------------
def test_quiet_prints_nothing_and_json_prints_only_json(
    capture: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    words = ["train", str(capture), "--out", str(out), "--threads", "1", "--resume", *TINY]
    assert run([*words, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert run([*words, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [stage["name"] for stage in result["stages"]] == ["surface", "appearance", "refine"]


def test_train_shows_a_table_and_where_the_report_is(
    capture: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    assert run(["train", str(capture), "--out", str(out), "--threads", "1", "--resume", *TINY]) == 0
    text = capsys.readouterr().out
    assert "appearance" in text
    assert str(out / "report.html") in text


def test_mesh_render_export_and_report_work_on_a_run(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = str(trained)
    assert run(["mesh", name, "--out", str(tmp_path / "m.ply"), "--voxel", "0.1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["voxel"] == pytest.approx(0.1)
    assert run(["render", name, "--split", "train", "--out", str(tmp_path / "views"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["images"] == 3
    assert run(["export", name, "--layout", "3dgs", "--out", str(tmp_path / "s.ply"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == (tmp_path / "s.ply").stat().st_size
    assert run(["report", name]) == 0
    assert "report.html" in capsys.readouterr().out


def test_evaluate_shows_what_is_missing_and_scores_the_surface(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    write_ball_mesh(copy / "mesh.ply")
    write_ball_mesh(tmp_path / "truth.ply")
    assert run(["evaluate", str(copy), "--ground-truth", str(tmp_path / "truth.ply"), "--thresholds", "0.05"]) == 0
    text = capsys.readouterr().out
    assert "no LPIPS weights" in text
    assert "F-score" in text
    assert "Chamfer distance" in text


# -- bad input ------------------------------------------------------------------------------------------
def missing(folder: Path) -> None:
    """Nothing there."""


def empty(folder: Path) -> None:
    folder.mkdir()


def colmap(folder: Path, model: int = 1) -> None:
    """A COLMAP capture of the ball: PINHOLE (1) or another camera model."""
    cameras = ball_cameras(3)
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    c = cameras[0]
    params = [c.fx, c.fy, c.cx, c.cy] + [0.0] * (8 if model == 10 else 0)
    head = struct.pack("<QiiQQ", 1, 1, model, c.width, c.height)
    (folder / "sparse/0/cameras.bin").write_bytes(head + struct.pack(f"<{len(params)}d", *params))
    from PIL import Image
    from scipy.spatial.transform import Rotation

    body = struct.pack("<Q", len(cameras))
    for i, camera in enumerate(cameras):
        Image.fromarray(ball_picture(camera)[..., :3]).save(folder / "images" / f"{i}.png")
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        body += struct.pack("<i7di", i + 1, w, x, y, z, *camera.T_cam_world[:3, 3], 1)
        body += f"{i}.png".encode() + b"\0" + struct.pack("<Q", 0)
    (folder / "sparse/0/images.bin").write_bytes(body)
    points = struct.pack("<Q", 20)
    for i, xyz in enumerate(np.random.default_rng(0).normal(size=(20, 3)) * 0.4):
        points += struct.pack("<Q3d3BdQ", i + 1, *xyz, 200, 100, 50, 0.5, 0)
    (folder / "sparse/0/points3D.bin").write_bytes(points)


def truncated_images_bin(folder: Path) -> None:
    colmap(folder)
    path = folder / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:-20])


def unsupported_camera(folder: Path) -> None:
    colmap(folder, model=10)  # THIN_PRISM_FISHEYE


def wrong_json_key(folder: Path) -> None:
    write_capture(folder, train=2, test=1)
    path = folder / "transforms_train.json"
    path.write_text(path.read_text().replace("transform_matrix", "transfrom_matrix"))


def broken_json(folder: Path) -> None:
    write_capture(folder, train=2, test=1)
    path = folder / "transforms_train.json"
    path.write_text(path.read_text()[:-40])


def image_that_does_not_decode(folder: Path) -> None:
    write_capture(folder, train=3, test=1)
    path = folder / "train" / "r_2.png"
    path.write_bytes(path.read_bytes()[:100])


def text_for_image(folder: Path) -> None:
    write_capture(folder, train=3, test=1)
    (folder / "train" / "r_1.png").write_text("not a picture")


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (missing, "capture"),
        (empty, "capture"),
        (truncated_images_bin, "images.bin"),
        (unsupported_camera, "THIN_PRISM_FISHEYE"),
        (wrong_json_key, "transform_matrix"),
        (broken_json, "transforms_train.json"),
        (image_that_does_not_decode, "r_2.png"),
        (text_for_image, "r_1.png"),
    ],
)
def test_a_capture_that_cannot_be_read_gives_one_line_and_exit_code_2_and_leaves_nothing(
    make: Callable[[Path], None], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path / "capture")
    before = sorted(tmp_path.rglob("*"))
    words = ["train", str(tmp_path / "capture"), "--out", str(tmp_path / "deep" / "run"), "--quiet", *TINY]
    assert run(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert named in one_line(err)
    assert sorted(tmp_path.rglob("*")) == before


def test_the_colmap_capture_of_these_tests_is_good_when_nothing_is_broken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    colmap(tmp_path / "capture")
    assert run(["info", str(tmp_path / "capture"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 20


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--recipe", "3dgs"], "no recipe '3dgs'"),
        (["--set", "appearance.train.sh0=nobody"], "row group 'nobody'"),
        (["--protocol", "tanks"], "no protocol 'tanks'"),
        (["--downscale", "0"], "--downscale"),
        (["--downscale", "1000"], "1000"),
        (["--schedule-scale", "-1"], "schedule scale"),
        (["--from", "nowhere"], "expected a run folder"),
        (["--format", "colmap"], "colmap"),
    ],
)
def test_options_that_make_no_sense_give_one_line_and_leave_nothing(
    capture: Path, more: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", *TINY, *more]) == 2
    assert named.lower() in one_line(capsys.readouterr().err).lower()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_a_run_or_something_else_is_kept(
    capture: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (trained / "splats.ply").read_bytes()
    assert run(["train", str(capture), "--out", str(trained)]) == 2
    assert "--resume" in one_line(capsys.readouterr().err)
    assert (trained / "splats.ply").read_bytes() == before
    (tmp_path / "mine.txt").write_text("mine")
    assert run(["train", str(capture), "--out", str(tmp_path), "--overwrite"]) == 2
    assert "mine.txt" in one_line(capsys.readouterr().err)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_a_failing_overwrite_keeps_the_old_run(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    image_that_does_not_decode(tmp_path / "capture")
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    assert run(["train", str(tmp_path / "capture"), "--out", str(copy), "--overwrite", "--quiet"]) == 2
    one_line(capsys.readouterr().err)
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("command", ["mesh", "render", "evaluate", "report"])
def test_a_command_on_what_is_no_run_says_what_it_found(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([command, str(tmp_path)]) == 2
    assert "found a folder without run.json" in one_line(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_a_ply_of_another_kind_is_named(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    write_ball_mesh(tmp_path / "mesh.ply")
    shutil.copy(tmp_path / "mesh.ply", copy / "splats.ply")
    assert run(["export", str(copy), "--out", str(tmp_path / "x.ply")]) == 2
    assert "mesh" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "x.ply").exists()
    (tmp_path / "text.ply").write_text("hello")
    assert run(["evaluate", str(trained), "--ground-truth", str(tmp_path / "text.ply"), "--quiet"]) == 2
    assert "text.ply" in one_line(capsys.readouterr().err)


def test_exporting_into_a_folder_that_does_not_exist_is_one_line(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(trained), "--out", str(tmp_path / "no" / "x.ply")]) == 2
    assert "the folder does not exist" in one_line(capsys.readouterr().err)


def spawn(words: list[str], **kwargs: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "gs2d", *words],
        capture_output=True,
        text=True,
        timeout=200,
        **kwargs,  # type: ignore[call-overload]
    )


def test_a_file_size_limit_stops_training_with_one_line_and_leaves_nothing(capture: Path, tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", "--threads", "1", *TINY]
    done = spawn(words, preexec_fn=limit)
    assert done.returncode == 2
    assert "file-size limit" in one_line(done.stderr)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_stops_training_with_one_line_and_leaves_nothing(capture: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    if mount is None or os.geteuid() != 0:
        pytest.skip("only root may mount a small disk")
    made = subprocess.run([mount, "-t", "tmpfs", "-o", "size=48k", "none", str(disk)], capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {made.stderr.strip()}")
    try:
        done = spawn(["train", str(capture), "--out", str(disk / "run"), "--quiet", "--threads", "1", *TINY])
        assert done.returncode == 2
        assert "No space left on device" in one_line(done.stderr)
        assert list(disk.iterdir()) == []
    finally:
        subprocess.run(["umount", str(disk)], check=True)


# -- faults of ours -------------------------------------------------------------------------------------
def test_a_fault_of_ours_is_exit_code_1_with_a_traceback_only_for_debug(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline import jobs

    def broken(_path: Path) -> Path:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(jobs, "report_run", broken)
    assert run(["report", str(trained)]) == 1
    err = capsys.readouterr().err
    assert err.splitlines() == [
        "fault in gs2d: ZeroDivisionError: a bug; run again with --debug and report it with the traceback"
    ]
    assert run(["report", str(trained), "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_ctrl_c_exits_with_130_and_says_how_to_go_on(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline import recorder

    put = recorder.Recorder._score_stage

    def interrupted(self: recorder.Recorder, index: int) -> None:
        put(self, index)
        raise KeyboardInterrupt

    monkeypatch.setattr(recorder.Recorder, "_score_stage", interrupted)
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", "--threads", "1", *TINY]
    assert run(words) == 130
    line = capsys.readouterr().err.strip()
    assert line.startswith(f"interrupted; resume with: gs2d train {capture} --out {tmp_path / 'run'}")
    assert line.endswith("--resume")


def test_ctrl_c_before_the_first_checkpoint_leaves_nothing(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.train.loop import Trainer

    def interrupted(_self: Trainer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "step", interrupted)
    assert run(["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", *TINY]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert list(tmp_path.iterdir()) == []


def test_out_of_memory_names_the_remedy(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline import jobs

    def hungry(_path: Path) -> Path:
        raise MemoryError

    monkeypatch.setattr(jobs, "report_run", hungry)
    assert run(["report", str(trained)]) == 2
    assert "--downscale" in one_line(capsys.readouterr().err)


def test_an_os_error_that_the_user_can_mend_is_one_line(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline import jobs

    def denied(path: Path) -> Path:
        raise PermissionError(13, "Permission denied", str(path / "report.html"))

    monkeypatch.setattr(jobs, "report_run", denied)
    assert run(["report", str(trained)]) == 2
    assert "Permission denied" in one_line(capsys.readouterr().err)
    assert app_module.OURS == 1
