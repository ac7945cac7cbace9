"""``gs2d render --orbit N --video FILE``."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from cli_runs import one_line
from gs2d.cli import run


def test_an_orbit_becomes_images_and_a_video(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy, video = tmp_path / "run", tmp_path / "video.webp"
    shutil.copytree(trained, copy)
    words = ["--orbit", "5", "--video", str(video), "--threads", "1"]
    assert run(["render", str(copy), *words]) == 0
    out, err = capsys.readouterr()
    assert "5 images in" in out
    assert f"{video}: 0.2 s, 0.0 MB" in out
    assert "compressing the video (5)" in err
    assert len(list((copy / "renders" / "orbit").glob("*.png"))) == 5
    with Image.open(video) as images:
        assert images.size == (20, 20)
        assert images.n_frames > 1  # type: ignore[attr-defined]  # equal neighbours become one longer frame
    assert run(["render", str(copy), "--orbit", "2", "--video", str(video), "--json", "--threads", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == {
        "folder": str(copy / "renders" / "orbit"),
        "images": 2,
        "video": str(video),
        "seconds": pytest.approx(2 / 30),
        "video_bytes": video.stat().st_size,
    }


def test_mp4_needs_ffmpeg(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    words = ["render", str(trained), "--orbit", "2", "--out", str(tmp_path / "frames"), "--threads", "1"]
    assert run([*words, "--video", str(tmp_path / "round.mp4")]) == 2
    assert "round.mp4" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "round.mp4").exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--video", "a.webp"], "--orbit"),
        (["--orbit", "0", "--video", "a.webp"], "N >= 2"),
        (["--orbit", "-1"], "number"),
        (["--orbit", "9", "--video", "a.mov"], "name"),
        (["--orbit", "9", "--video", "a"], "name"),
        (["--orbit", "1", "--video", "a.webp"], "frames"),
        (["--orbit", "9", "--video", "no/such/folder/a.webp"], "the folder does not exist"),
        (["--orbit", "9", "--video", f"{'a' * 300}.webp"], "choose a shorter name"),
    ],
)
def test_invalid_video_options_are_one_line_errors(
    trained: Path, words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["render", str(trained), *words]) == 2
    assert named in one_line(capsys.readouterr().err)
