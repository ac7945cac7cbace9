"""Films: what is in the files, read back by Pillow and by a reader of boxes of our own."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, features

from gs2d.core.images import write_image
from gs2d.errors import BackendError, DataError
from gs2d.io import video
from gs2d.io.mp4 import Film, film_header, read_sequence
from gs2d.io.video import check_video, write_video

avif = pytest.mark.skipif(not features.check("avif"), reason="this Pillow has no AVIF")
WIDTH, HEIGHT = 48, 32


@pytest.fixture
def frames(tmp_path: Path) -> list[Path]:
    """A bar that goes from left to right, over a slope of colours."""
    folder = tmp_path / "frames"
    folder.mkdir()
    paths = []
    for i in range(6):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[..., 0], image[..., 2] = np.linspace(60, 180, WIDTH), 90
        image[:, 8 * i : 8 * i + 8] = (250, 240, 20)
        paths.append(folder / f"{i:04d}.png")
        write_image(paths[-1], image)
    return paths


def boxes(data: bytes, *path: bytes) -> bytes:
    """What is in the box at the end of a path."""
    for kind in path:
        start = 0
        while data[start + 4 : start + 8] != kind:
            size = struct.unpack(">I", data[start : start + 4])[0]
            assert size >= 8, f"no box {kind!r}"
            start += size
        data = data[start + 8 : start + struct.unpack(">I", data[start : start + 4])[0]]
    return data


@avif
def test_an_mp4_film_has_all_frames_at_its_rate(frames: list[Path], tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", frames, fps=12.5)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data[4:12] == b"ftypisom"
    media = boxes(data, b"moov", b"trak", b"mdia")
    assert boxes(media, b"hdlr")[8:12] == b"vide"
    scale, length = struct.unpack(">II", boxes(media, b"mdhd")[12:20])
    assert length / scale == pytest.approx(6 / 12.5)
    table = boxes(media, b"minf", b"stbl")
    assert struct.unpack(">III", boxes(table, b"stts")[4:]) == (1, 6, 1000)
    assert scale == 12500  # 1000 units a frame
    sizes = struct.unpack(">6I", boxes(table, b"stsz")[12:])
    offset = struct.unpack(">I", boxes(table, b"stco")[8:])[0]
    assert offset + sum(sizes) == len(data)
    assert data[offset - 4 : offset] == b"mdat"
    assert data[offset] >> 3 == 1  # the first unit describes the sequence (OBU type 1); none delimits frames (2)
    assert struct.unpack(">HH", boxes(table, b"stsd")[8 + 8 + 24 : 8 + 8 + 28]) == (WIDTH, HEIGHT)


@avif
def test_the_frames_of_an_mp4_film_are_those_of_the_pictures(frames: list[Path], tmp_path: Path) -> None:
    """The film's tables, back into the sequence that Pillow reads: the samples must be whole and in order."""
    write_video(tmp_path / "a.mp4", frames, fps=30, quality=90)
    data = (tmp_path / "a.mp4").read_bytes()
    table = boxes(data, b"moov", b"trak", b"mdia", b"minf", b"stbl")
    sizes = struct.unpack(">6I", boxes(table, b"stsz")[12:])
    offset = struct.unpack(">I", boxes(table, b"stco")[8:])[0]
    samples = [data[offset + sum(sizes[:i]) : offset + sum(sizes[: i + 1])] for i in range(6)]
    # what Pillow writes itself for these pictures, with the film's frames in the place of its own
    buffer = io.BytesIO()
    pictures = [Image.open(path) for path in frames]
    options = {"quality": 90, "speed": video.SPEED, "range": "limited", "max_threads": 1, "duration": 1000}
    pictures[0].save(buffer, "AVIF", save_all=True, append_images=pictures[1:], **options)
    sequence = buffer.getvalue()
    assert read_sequence(sequence).samples == samples
    with Image.open(io.BytesIO(sequence)) as film:
        for i, path in enumerate(frames):
            film.seek(i)
            with Image.open(path) as picture:
                error = np.asarray(film.convert("RGB"), float) - np.asarray(picture, float)
            assert np.sqrt((error**2).mean()) < 12  # colour at half the resolution


def test_a_webp_film_has_all_frames_at_its_rate(frames: list[Path], tmp_path: Path) -> None:
    told: list[int] = []
    write_video(tmp_path / "a.webp", frames, fps=30, on_frame=told.append)
    assert told == [2, 3, 4, 5, 6]  # each is decoded once
    with Image.open(tmp_path / "a.webp") as film:
        assert film.n_frames == 6
        durations = []
        for i, path in enumerate(frames):
            film.seek(i)
            film.load()
            durations.append(film.info["duration"])
            with Image.open(path) as picture:
                error = np.asarray(film.convert("RGB"), float) - np.asarray(picture, float)
            assert np.sqrt((error**2).mean()) < 15
    assert durations == [33, 34, 33, 33, 34, 33]  # ms that add up to 200


@avif
def test_one_frame_is_in_memory_at_a_time_and_whoever_stops_leaves_no_file(frames: list[Path], tmp_path: Path) -> None:
    told: list[int] = []

    def stop(done: int) -> None:
        told.append(done)
        if done == 4:
            raise KeyboardInterrupt

    for name in ("a.mp4", "a.webp"):
        told.clear()
        with pytest.raises(KeyboardInterrupt):
            write_video(tmp_path / name, frames, fps=30, on_frame=stop)
        assert told == [2, 3, 4]
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


def test_what_makes_no_film_is_said_before_anything_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DataError, match=r"\.mp4 or \.webp file, got a\.avi"):
        check_video(Path("a.avi"), 30, 10)
    with pytest.raises(DataError, match=r"--fps must be 0\.1 to 240 frames a second, got nan"):
        check_video(Path("a.webp"), float("nan"), 10)
    with pytest.raises(DataError, match="at least 2 frames, got 1"):
        check_video(Path("a.webp"), 30, 1)
    monkeypatch.setattr(features, "check", lambda name: name != "avif")
    check_video(Path("a.webp"), 30, 2)
    with pytest.raises(BackendError, match=r"pip install 'pillow>=11\.3', or name the other"):
        check_video(Path("a.mp4"), 30, 2)


def test_a_sequence_of_another_layout_is_not_guessed_at() -> None:
    for data in (b"", b"\0\0\0\x08moov", b"\0\0\0\x03moov", b"nonsense of some length"):
        with pytest.raises(BackendError, match=r"name a \.webp file instead"):
            read_sequence(data)


def test_the_header_says_where_the_first_frame_is() -> None:
    film = Film(4, 2, b"", [b"abc", b"de"], [1])
    header = film_header(film, 2.0)
    table = boxes(header[:-8], b"moov", b"trak", b"mdia", b"minf", b"stbl")
    assert struct.unpack(">I", boxes(table, b"stco")[8:])[0] == len(header)
    assert header[-8:] == struct.pack(">I4s", 8 + 5, b"mdat")
    assert struct.unpack(">I", boxes(table, b"stss")[8:])[0] == 1
