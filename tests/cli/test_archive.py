"""`gs2d train` and `gs2d info` on a capture that is a ZIP file."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from cli_runs import TINY, one_line
from gs2d.cli import run
from tiny import write_capture


def packed(folder: Path, path: Path, prefix: str = "") -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for source in sorted(folder.rglob("*")):
            if source.is_file():
                file.write(source, prefix + source.relative_to(folder).as_posix())
    return path


def train(path: Path, out: Path, *more: str) -> int:
    return run(["train", str(path), "--out", str(out), "--quiet", "--threads", "1", *TINY, *more])


def test_a_zip_trains_like_its_folder_and_later_commands_find_it(
    capture: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = packed(capture, tmp_path / "my ball.zip"), tmp_path / "run"
    assert train(path, out) == 0
    assert (out / "splats.ply").read_bytes() == (trained / "splats.ply").read_bytes()
    definition = json.loads((out / "run.json").read_text())
    same = json.loads((trained / "run.json").read_text())
    assert definition["scene"]["digest"] == same["scene"]["digest"]
    assert (definition["scene"]["name"], definition["title"]) == ("my ball", "my ball")
    path.rename(tmp_path / "moved.zip")
    assert run(["render", str(out), "--split", "train", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["images"] == 3
    assert train(tmp_path / "moved.zip", out, "--resume") == 0
    capsys.readouterr()
    assert train(tmp_path / "moved.zip", out) == 2
    assert "already holds a run" in one_line(capsys.readouterr().err)


def test_another_archive_cannot_resume_a_run_but_replaces_it_with_overwrite(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(packed(capture, tmp_path / "a.zip"), out) == 0
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    other = write_capture(tmp_path / "other", train=4, test=1, size=20)
    b = packed(other, tmp_path / "b.zip")
    assert train(b, out, "--resume") == 2
    assert "another" in one_line(capsys.readouterr().err)
    (other / "train" / "r_1.png").write_bytes(b"no picture")
    assert train(packed(other, tmp_path / "c.zip"), out, "--overwrite") == 2
    assert "r_1.png must be an image" in one_line(capsys.readouterr().err)
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before
    assert train(b, out, "--overwrite") == 0
    assert len(list((out / "unpacked").iterdir())) == 1
    assert json.loads((out / "run.json").read_text())["scene"]["train"] == 4


def test_an_archive_that_cannot_train_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr("readme.txt", b"hello")
    assert train(tmp_path / "a.zip", tmp_path / "deep" / "run") == 2
    assert "transforms_train.json" in one_line(capsys.readouterr().err)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.zip"]
