"""Commands: what they print and write, and the exit codes of arguments."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from cli_runs import TINY
from gs2d.cli import run
from gs2d.config.presets import RECIPES
from tiny import write_ball_mesh


def test_recipes_lists_three_or_all_and_shows_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["recipes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["best", "best-fast", "2dgs", str(len(RECIPES) - 3)]
    assert run(["recipes", "--all"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(RECIPES)
    assert max(map(len, lines)) <= 80
    assert run(["recipes", "2dgs-r"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [stage["iterations"] for stage in shown["stages"]] == [30000, 10000, 20000]


def test_doctor_lists_backends_and_why_others_are_unavailable(capsys: pytest.CaptureFixture[str]) -> None:
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


def test_an_export_whose_layout_and_ending_contradict_each_other_is_refused(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(trained), "--out", str(tmp_path / "a.ply"), "--format", "spz"]) == 2
    assert "--out" in capsys.readouterr().err
    assert run(["export", str(trained), "--out", str(tmp_path / "a.spz"), "--format", "3dgs"]) == 2
    assert "--out" in capsys.readouterr().err
    assert run(["export", str(trained), "--out", str(tmp_path / "a.fbx")]) == 2
    endings = ".ply, .spz, .compressed.ply, .splat, .usd, .glb, .sog, lod-meta.json"
    error_output = capsys.readouterr().err
    assert f"--out must end in {endings}, got" in error_output
    assert "meshes are written by `gs2d mesh RUN`" in error_output
    assert list(tmp_path.iterdir()) == []


def test_train_shows_a_table_and_where_the_report_is(
    capture: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    assert run(["train", str(capture), "--out", str(out), "--threads", "1", "--resume", *TINY]) == 0
    text = capsys.readouterr().out
    assert "appearance" in text
    assert str(out / "report.html") in text


def test_evaluate_shows_what_is_missing_and_scores_the_surface(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    write_ball_mesh(copy / "mesh.ply")
    write_ball_mesh(tmp_path / "truth.ply")
    assert run(["evaluate", str(copy), "--ground-truth", str(tmp_path / "truth.ply"), "--set", "thresholds=0.05"]) == 0
    text = capsys.readouterr().out
    assert "no LPIPS weights" in text
    assert "8 bit" in text
    assert "floats" in text
    assert "F-score" in text
    assert "Chamfer distance" in text
