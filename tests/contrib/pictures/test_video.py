"""Videos: what is in the files, read back by ffmpeg and by Pillow."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gs2d.contrib.pictures.video import write_video
from gs2d.data.image_files import write_image
from gs2d.errors import BackendError, DiskError

real = pytest.mark.skipif(shutil.which("ffprobe") is None, reason="no ffmpeg here")
WIDTH, HEIGHT = 48, 32


@pytest.fixture
def frames(tmp_path: Path) -> list[Path]:
    """A bar that goes from left to right, over a slope of colours."""
    return write_frames(tmp_path / "frames", WIDTH, HEIGHT)


def write_frames(folder: Path, width: int, height: int) -> list[Path]:
    folder.mkdir()
    paths = []
    for i in range(6):
        image = np.zeros((height, width, 3), np.uint8)
        image[..., 0], image[..., 2] = np.linspace(60, 180, width), 90
        image[:, 8 * i : 8 * i + 8] = (250, 240, 20)
        paths.append(folder / f"{i:04d}.png")
        write_image(paths[-1], image)
    return paths


def probed(path: Path) -> dict[str, Any]:
    """Return the first stream that ffprobe reports."""
    words = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(path)]
    (stream,) = json.loads(subprocess.run(words, capture_output=True, check=True).stdout)["streams"]
    return dict(stream)


def decoded(path: Path, width: int, height: int) -> np.ndarray:
    """Frames [n, H, W, 3] uint8, by ffmpeg."""
    words = ["ffmpeg", "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    data = subprocess.run(words, capture_output=True, check=True).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3)


@real
def test_an_mp4_video_has_all_frames_at_its_rate_in_a_common_pixel_format(frames: list[Path], tmp_path: Path) -> None:
    reported: list[int] = []
    write_video(tmp_path / "a.mp4", frames, fps=12.5, on_frame=reported.append)
    assert reported == [1, 2, 3, 4, 5, 6]
    stream = probed(tmp_path / "a.mp4")
    assert (stream["codec_name"], stream["pix_fmt"], stream["color_space"]) == ("h264", "yuv420p", "bt709")
    assert (stream["width"], stream["height"], stream["nb_read_frames"]) == (WIDTH, HEIGHT, "6")
    assert stream["r_frame_rate"] == "25/2"
    assert float(stream["duration"]) == pytest.approx(6 / 12.5)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # it plays while it loads
    for image, path in zip(decoded(tmp_path / "a.mp4", WIDTH, HEIGHT), frames, strict=True):
        error = image.astype(float) - np.asarray(Image.open(path), float)
        assert np.sqrt((error**2).mean()) < 14  # colour at half the resolution
        assert abs(error.mean()) < 2  # no other matrix of colours, no other range


def test_a_webp_video_has_all_frames_at_its_rate(frames: list[Path], tmp_path: Path) -> None:
    reported: list[int] = []
    write_video(tmp_path / "a.webp", frames, fps=30, on_frame=reported.append)
    assert reported == [1, 2, 3, 4, 5, 6]
    with Image.open(tmp_path / "a.webp") as video:
        assert video.n_frames == 6  # type: ignore[attr-defined]
        durations = []
        for i, path in enumerate(frames):
            video.seek(i)
            video.load()
            durations.append(video.info["duration"])
            with Image.open(path) as image:
                error = np.asarray(video.convert("RGB"), float) - np.asarray(image, float)
            assert np.sqrt((error**2).mean()) < 15
    assert durations == [33, 34, 33, 33, 34, 33]  # ms that add up to 200


@pytest.mark.parametrize("name", [pytest.param("a.mp4", marks=real), "a.webp"])
def test_an_interrupted_writer_keeps_an_older_file(frames: list[Path], tmp_path: Path, name: str) -> None:
    def stop(done: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    (tmp_path / name).write_text("older")
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / name, frames, fps=30, on_frame=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, "frames"]
    assert (tmp_path / name).read_text() == "older"


def a_program(folder: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put an ffmpeg on the PATH that runs the shell script ``text``."""
    folder.mkdir()
    (folder / "ffmpeg").write_text(f"#!/bin/sh\n{text}\n")
    (folder / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:/bin:/usr/bin")


KNOWS = 'for word; do [ "$word" = -encoders ] && echo " V libx264 x" && exit 0; done'


@pytest.mark.parametrize(
    ("script", "error", "message"),
    [
        ("echo a >&2; echo no such luck >&2; exit 7", BackendError, r"a\.mp4"),
        ("exit 7", BackendError, r"a\.mp4"),
        ("echo x: No space left on device >&2; exit 1", DiskError, "free some space"),
    ],
)
def test_the_last_line_of_ffmpeg_is_in_the_error(
    frames: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    script: str,
    error: type[Exception],
    message: str,
) -> None:
    a_program(tmp_path / "bin", f"{KNOWS}\n{script}", monkeypatch)
    with pytest.raises(error, match=message):
        write_video(tmp_path / "a.mp4", frames, fps=30)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bin", "frames"]
