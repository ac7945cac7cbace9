"""Video frames as images: frame selection, ffmpeg's output, and messages if there are none."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from cli_runs import one_line
from gs2d.cli import run
from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.sfm.video_frames import choose, look_into, sharpness_of, take
from gs2d.training.events import Event, Notice
from room_photos import write_room

real = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="there is no ffmpeg on this machine")


def write_video(path: Path, images: list[Image.Image], *options: str) -> Path:
    """Write a video with irregular timestamps: phones have no fixed frame rate."""
    folder = path.with_suffix(".pictures")
    folder.mkdir(parents=True)
    for i, image in enumerate(images):
        image.save(folder / f"{i}.png")
    times = "setpts='(N+0.4*mod(N,3))/(10*TB)'"
    words = ["ffmpeg", "-v", "error", "-r", "10", "-start_number", "0", "-i", "%d.png", "-vf", times]
    subprocess.run([*words, "-vsync", "0", "-c:v", "mpeg4", "-q:v", "2", *options, str(path)], check=True, cwd=folder)
    return path


def pattern(number: int, size: tuple[int, int] = (96, 64)) -> Image.Image:
    """Return noise around a grey level that encodes the number."""
    noise = np.random.default_rng(number).integers(-20, 20, (size[1], size[0], 1))
    return Image.fromarray(np.clip(20 + 9 * number + noise, 0, 255).astype(np.uint8).repeat(3, axis=2))


@real
def test_the_sharpest_frames_are_written(tmp_path: Path) -> None:
    sharp = {1, 5, 6, 11}
    images = [pattern(i) if i in sharp else pattern(i).filter(ImageFilter.GaussianBlur(2)) for i in range(12)]
    video = look_into(write_video(tmp_path / "50 % of -it.mp4", images))
    assert (video.frames, video.hdr) == (12, None)
    numbers = choose(list(sharpness_of(video)), 4)
    assert numbers == sorted(sharp)
    taken = take(video, numbers, tmp_path / "100 %d" / "frames")
    assert [path.name for path in taken] == [f"frame_{number:06d}.jpg" for number in numbers]
    for path, number in zip(taken, numbers, strict=True):
        with Image.open(path) as file:
            assert (file.format, file.size) == ("JPEG", (96, 64))
            assert np.asarray(file).mean() == pytest.approx(np.asarray(images[number]).mean(), abs=3)


@real
def test_a_portrait_video_gives_upright_frames(tmp_path: Path) -> None:
    flat = write_video(tmp_path / "flat.mp4", [pattern(i) for i in range(4)])
    turned = tmp_path / "turned.mp4"
    words = ["ffmpeg", "-v", "error", "-i", str(flat), "-c", "copy", "-metadata:s:v:0", "rotate=90", str(turned)]
    subprocess.run(words, check=True)
    probe = ["ffprobe", "-v", "error", "-show_entries", "stream_side_data=rotation", "-of", "csv=p=0", str(turned)]
    if "90" not in subprocess.run(probe, capture_output=True, text=True).stdout:
        pytest.skip("this ffmpeg writes no rotation")
    with Image.open(take(look_into(turned), [0], tmp_path / "frames")[0]) as file:
        assert file.size == (64, 96)


@real
def test_broken_videos_are_one_line_errors(tmp_path: Path) -> None:
    noise = tmp_path / "noise.mp4"
    noise.write_bytes(np.random.default_rng(0).bytes(4096))
    with pytest.raises(DataError, match="Invalid") as caught:
        look_into(noise)
    assert "\n" not in str(caught.value)
    whole = write_video(tmp_path / "whole.mp4", [pattern(i) for i in range(2)])
    with pytest.raises(DataError, match="frames"):
        find_poses(PosesOptions(photos=whole, out=tmp_path / "capture"))
    assert not (tmp_path / "capture").exists()
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(DataError, match="ffmpeg"):
        take(look_into(whole), [0, 1, 2], tmp_path / "frames")


def test_without_ffmpeg_the_error_names_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap")
    (tmp_path / "walk.MOV").write_bytes(b"?")
    monkeypatch.setenv("PATH", str(tmp_path))
    for command, folder in (("poses", "capture"), ("reconstruct", "run")):
        assert run([command, str(tmp_path / "walk.MOV"), "--out", str(tmp_path / folder)]) == 2
        assert "install" in one_line(capsys.readouterr().err)
        assert not (tmp_path / folder).exists()
    with pytest.raises(DataError, match="photographs"):
        look_into(tmp_path / "gone.mp4")


@real
def test_a_video_becomes_a_capture_with_its_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    write_room(tmp_path / "room", 10)
    photos = [Image.open(path).convert("RGB") for path in sorted((tmp_path / "room").rglob("*.jpg"))]
    blurred = [photo.filter(ImageFilter.GaussianBlur(4)) for photo in photos]
    video = write_video(tmp_path / "room.mp4", [image for pair in zip(blurred, photos, strict=True) for image in pair])
    events: list[Event] = []
    options = PosesOptions(photos=video, out=tmp_path / "capture", frames=len(photos), threads=2)
    result = find_poses(replace(options, camera_model="SIMPLE_PINHOLE"), events.append)
    assert (result["count"], result["requested"]["frames"]) == (len(photos), len(photos))
    assert result["placed"] == len(photos)
    assert len(result["cameras"]) == 1
    names = [row["name"] for row in result["photographs"]]
    assert names == [f"frame_{2 * i + 1:06d}.jpg" for i in range(len(photos))]
    assert sorted(path.name for path in (tmp_path / "capture/images").iterdir()) == names
    notices = "".join(event.text for event in events if isinstance(event, Notice))
    assert f"using {len(photos)} of {2 * len(photos)} frames" in notices
    assert read_json(tmp_path / "capture/poses.json")["photos"] == str(video.resolve())
    assert not list(tmp_path.glob(".*"))
