"""Extract frames of a video: the sharpest one of each interval, by the installed ffmpeg.

ffmpeg is not a dependency, because its wheels contain GPL code. The video is decoded twice: once at low resolution to
measure sharpness, and once to write the chosen frames.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from subprocess import PIPE
from typing import IO, Any

import numpy as np

from gs2d.core.extras import FFMPEG
from gs2d.errors import DataError

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp", ".wmv")
MAX_FRAMES = 2000
SIDE = 640  # px; width and height at which sharpness is measured: blur of two pixels at full size still counts
QUALITY = 2  # of ffmpeg's JPEG encoder, 1 (best) to 31
HDR = {"smpte2084": "PQ", "arib-std-b67": "HLG"}
_RATE = 25  # arbitrary: with new time stamps, every selected frame is written exactly once


@dataclass(frozen=True)
class Video:
    """A readable video: its number of frames (0 if unknown), and its transfer function if it is HDR."""

    path: Path
    frames: int
    hdr: str | None


def is_video(path: Path) -> bool:
    """Whether a path has the suffix of a video and is no folder."""
    return path.suffix.lower() in VIDEOS and not path.is_dir()


def look_into(path: Path) -> Video:
    """Inspect a video.

    Raises DataError if there is no such file, no video in it, or no ffmpeg on the PATH.
    """
    if not path.is_file():
        raise DataError(f"{path} must be a video or a folder of photographs, got no such file")
    for program in ("ffmpeg", "ffprobe"):
        if shutil.which(program) is None:
            raise DataError(
                f"{path} is a video, which needs ffmpeg, but there is no {program} on the PATH; install it ({FFMPEG}), "
                "or use a folder of photographs"
            )
    entries = "stream=nb_read_packets,color_transfer"
    words = ["ffprobe", "-v", "error", "-select_streams", "V:0", "-count_packets", "-show_entries", entries]
    done = subprocess.run([*words, "-of", "json", _url(path)], capture_output=True, text=True, errors="replace")
    streams = _streams(done.stdout) if done.returncode == 0 else []
    if not streams:
        raise DataError(f"{path} must be a video that ffmpeg reads, got {_last_line(done.stderr) or 'no video in it'}")
    number = str(streams[0].get("nb_read_packets", ""))
    return Video(path, int(number) if number.isdigit() else 0, HDR.get(str(streams[0].get("color_transfer"))))


def _streams(text: str) -> list[dict[str, Any]]:
    try:
        return list(json.loads(text).get("streams", []))
    except ValueError:
        return []


def sharpness_of(video: Video) -> Generator[float, None, None]:
    """Yield the sharpness of each frame: the variance of the Laplacian of its grey values.

    Raises DataError if ffmpeg fails.
    """
    size = SIDE * SIDE
    scaled = f"scale={SIDE}:{SIDE}:flags=area,format=gray,setpts=N/({_RATE}*TB)"
    with _decoding(video, ["-vf", scaled, "-r", str(_RATE), "-f", "rawvideo", "-"]) as stream:
        while len(frame := stream.read(size)) == size:
            grey = np.frombuffer(frame, np.uint8).reshape(SIDE, SIDE).astype(np.float32)
            laplacian = 4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
            yield float(laplacian.var())


def choose(sharpness: Sequence[float], count: int) -> list[int]:
    """Return the frame numbers, from 0, of the sharpest frame in each of ``count`` equal intervals.

    Returns all frames if there are at most ``count``.
    """
    total = len(sharpness)
    if total <= count:
        return list(range(total))
    edges = [total * i // count for i in range(count + 1)]
    return [first + int(np.argmax(sharpness[first:last])) for first, last in itertools.pairwise(edges)]


def take(video: Video, numbers: Sequence[int], folder: Path) -> list[Path]:
    """Write frames as ``frame_NUMBER.jpg`` to a new folder, upright and at full size.

    Raises DataError if ffmpeg fails or writes fewer frames.
    """
    folder.mkdir(parents=True)
    selection = "+".join(f"eq(n,{number})" for number in numbers)
    filters = f"select='{selection}',setpts=N/({_RATE}*TB)"
    options = ["-vf", filters, "-r", str(_RATE), "-q:v", str(QUALITY), "-start_number", "0", "%06d.jpg"]
    with _decoding(video, options, into=folder) as stream:
        stream.read()
    frames = []
    for i, number in enumerate(numbers):
        frames.append(folder / f"frame_{number:06d}.jpg")
        try:
            os.rename(folder / f"{i:06d}.jpg", frames[-1])
        except FileNotFoundError as error:
            raise DataError(f"ffmpeg wrote {i} of {len(numbers)} frames of {video.path}; is the file cut?") from error
    return frames


@contextmanager
def _decoding(video: Video, options: Sequence[str], into: Path | None = None) -> Iterator[IO[bytes]]:
    """Run ffmpeg in the folder ``into`` and yield its standard output; it is stopped at the end of the block.

    Raises DataError if it fails; with the last line of its output.
    """
    words = ["ffmpeg", "-nostdin", "-v", "error", "-i", _url(video.path), "-map", "0:V:0", *options]
    with tempfile.TemporaryFile() as errors, subprocess.Popen(words, stdout=PIPE, stderr=errors, cwd=into) as job:
        try:
            assert job.stdout is not None
            yield job.stdout
            failed = job.wait() != 0
        finally:
            job.kill()
        if failed:
            errors.seek(0)
            raise DataError(f"ffmpeg cannot decode {video.path}: {_last_line(errors.read().decode(errors='replace'))}")


def _url(path: Path) -> str:
    """Return a path in a form that ffmpeg cannot mistake for an option or a protocol."""
    return f"file:{path.resolve()}"


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip() if lines else ""
