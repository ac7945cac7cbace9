"""Commands: what they print and write, and the exit codes of arguments."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from cli_runs import TINY, one_line, spawn
from gs2d.cli import run
from gs2d.config.presets import RECIPES
from gs2d.data.image_files import read_image
from gs2d.pipeline.prepare.job import prepare_job
from gs2d.pipeline.prepare.options import TrainOptions
from tiny import write_ball_mesh, write_capture


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


def test_info_and_training_name_each_piece_that_a_scene_of_a_data_set_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_capture(tmp_path / "lego", train=8, test=2, size=8)
    gone = [scene / "train" / f"r_{i}.png" for i in range(5)]
    for path in gone:
        path.unlink()
    assert run(["info", str(scene)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("missing: ")]
    assert [line.split(" is missing (for training): get it from nerf_synthetic.zip")[0] for line in lines] == [
        f"missing: {path}" for path in gone
    ]
    notices: list[str] = []
    prepare_job(TrainOptions(scene=scene, out=tmp_path / "run"), lambda e: notices.append(getattr(e, "text", "")))
    told = [text for text in notices if " is missing (for training): get it from" in text]
    assert [text.split(" is missing")[0] for text in told] == [str(path) for path in gone[:3]]
    assert "... and 2 more pieces are missing; `gs2d info` lists them" in notices


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


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("a.ply", "3dgs (three"),
        ("a.compressed.ply", "compressed PLY"),
        ("a.spz", "SPZ version 3"),
        ("a.splat", ".splat"),
        ("a.usd", "OpenUSD, surflets"),
        ("a.glb", "glTF"),
        ("a.sog", "SOG"),
    ],
)
def test_the_ending_of_an_export_is_its_format_and_info_reads_it(
    trained: Path, tmp_path: Path, name: str, layout: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(trained), "--out", str(tmp_path / name), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert run(["info", str(tmp_path / name), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["splats"], facts["bytes"]) == (result["splats"], result["bytes"])
    assert facts["layout"].startswith(layout)
    assert facts["shape"] == "flat"


def test_a_file_of_splats_is_exported_too(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spz, back = tmp_path / "a.spz", tmp_path / "b.ply"
    assert run(["export", str(trained / "splats.ply"), "--out", str(spz), "--quiet"]) == 0
    assert run(["export", str(trained), "--out", str(tmp_path / "c.spz"), "--quiet"]) == 0
    assert spz.read_bytes() == (tmp_path / "c.spz").read_bytes()
    assert run(["export", str(spz), "--out", str(back), "--layout", "2dgs", "--quiet"]) == 0
    assert run(["info", str(back), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["layout"] == "2dgs"
    assert run(["export", str(spz), "--out", str(spz)]) == 2
    assert "is the file that is read" in capsys.readouterr().err
    assert run(["info", str(trained / "run.json")]) == 2
    assert f"got another file; give the run folder {trained}" in capsys.readouterr().err


def test_the_splats_of_a_file_are_drawn_and_meshed_with_the_cameras_of_a_run(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    glb, folders = tmp_path / "a.glb", [tmp_path / "own", tmp_path / "of_file"]
    assert run(["export", str(trained), "--out", str(glb), "--quiet"]) == 0
    words = ["--split", "train", "--threads", "1", "--quiet"]
    assert run(["render", str(trained), "--out", str(folders[0]), *words]) == 0
    assert run(["render", str(trained), "--out", str(folders[1]), "--splats", str(glb), *words]) == 0
    own, of_file = ([read_image(path) for path in sorted(folder.iterdir())] for folder in folders)
    assert len(own) == len(of_file) > 0
    assert max(int(np.abs(a.astype(int) - b).max()) for a, b in zip(own, of_file, strict=True)) <= 1
    mesh = ["mesh", str(trained), "--threads", "1", "--splats", str(glb)]
    assert run([*mesh, "--out", str(tmp_path / "m.ply"), "--quiet"]) == 0
    assert (tmp_path / "m.ply").stat().st_size > 100
    for words, told in (
        (mesh, "--splats needs --out: what is in the run is made of its own splats"),
        ([*mesh, "--out", str(trained / "mesh.ply")], "is the mesh of the run, which is that of its own splats"),
        ([*mesh, "--texture"], "--splats has no texture"),
        (["render", str(trained), "--splats", str(glb)], "--splats needs --out"),
        (["render", str(trained), "--splats", str(trained), "--out", str(tmp_path / "x")], "got the folder"),
    ):
        assert run(words) == 2
        assert told in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_an_export_whose_layout_and_ending_contradict_each_other_is_refused(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(trained), "--out", str(tmp_path / "a.ply"), "--layout", "spz"]) == 2
    assert "--out must name a .spz file, which is what layout spz is, got" in capsys.readouterr().err
    assert run(["export", str(trained), "--out", str(tmp_path / "a.spz"), "--layout", "3dgs"]) == 2
    assert "--out must name a .ply file, which is what layout 3dgs is, got" in capsys.readouterr().err
    assert run(["export", str(trained), "--out", str(tmp_path / "a.fbx")]) == 2
    endings = ".compressed.ply, .ply, .spz, .splat, .usd, .glb, .sog, lod-meta.json"
    told = capsys.readouterr().err
    assert f"splats are written as {endings} files, got --out" in told
    assert "meshes are written by `gs2d mesh RUN`" in told
    assert list(tmp_path.iterdir()) == []


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
    assert "8 bit" in text
    assert "floats" in text
    assert "F-score" in text
    assert "Chamfer distance" in text


def test_a_name_that_the_terminal_cannot_show_is_shown_as_its_numbers(trained: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(trained, tmp_path / "r\u00fcn"))
    done = spawn(["info", str(copy)], env={**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"})
    assert done.returncode == 0
    assert f"{tmp_path}/r\\xfcn/mesh.ply" in done.stdout
