"""The frames of a video as photographs: of each stretch of it the sharpest one, taken by the ffmpeg of the machine.

ffmpeg is a program of the user's, not a dependency: its wheels hold code under the GPL. The video is decoded twice,
once small and grey to see how sharp each frame is, once to write those that were chosen.
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
SIDE = 640  # px at which frames are judged, whatever their shape: smear of a pixel or two at full size still shows
QUALITY = 2  # of ffmpeg's JPEG, 1 to 31: its best but one
HDR = {"smpte2084": "PQ", "arib-std-b67": "HLG"}
_RATE = 25  # a made-up one: every frame that is let through is written once, whatever times it had


@dataclass(frozen=True)
class Video:
    """A video that can be read: how many frames it says it has (0: it does not say), and its light curve if HDR."""

    path: Path
    frames: int
    hdr: str | None


def is_video(path: Path) -> bool:
    """Whether a path is called as videos are, and is no folder."""
    return path.suffix.lower() in VIDEOS and not path.is_dir()


def look_into(path: Path) -> Video:
    """Return what a video is.

    Raises
    ------
    DataError
        No such file, no video in it, or no ffmpeg on this machine.
    """
    if not path.is_file():
        raise DataError(f"{path} must be a video or a folder of photographs, got no such file")
    for program in ("ffmpeg", "ffprobe"):
        if shutil.which(program) is None:
            raise DataError(
                f"{path} is a video, whose frames are taken by ffmpeg, and there is no {program} on the PATH; install "
                f"it ({FFMPEG}), or give a folder of photographs"
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
    """How sharp each frame is: the variance of the Laplacian of its grey values, from the first frame to the last.

    Raises
    ------
    DataError
        ffmpeg gave up.
    """
    size = SIDE * SIDE
    scaled = f"scale={SIDE}:{SIDE}:flags=area,format=gray,setpts=N/({_RATE}*TB)"
    with _decoding(video, ["-vf", scaled, "-r", str(_RATE), "-f", "rawvideo", "-"]) as stream:
        while len(frame := stream.read(size)) == size:
            grey = np.frombuffer(frame, np.uint8).reshape(SIDE, SIDE).astype(np.float32)
            laplacian = 4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
            yield float(laplacian.var())


def choose(sharpness: Sequence[float], count: int) -> list[int]:
    """Choose frames by number, from 0, ascending: the sharpest of each of ``count`` stretches of one length.

    All of them where there are no more than ``count``.
    """
    total = len(sharpness)
    if total <= count:
        return list(range(total))
    edges = [total * i // count for i in range(count + 1)]
    return [first + int(np.argmax(sharpness[first:last])) for first, last in itertools.pairwise(edges)]


def take(video: Video, numbers: Sequence[int], folder: Path) -> list[Path]:
    """Write the frames of these numbers as ``frame_NUMBER.jpg`` into a new folder, upright, of the video's own size.

    Raises
    ------
    DataError
        ffmpeg gave up, or wrote fewer.
    """
    folder.mkdir(parents=True)
    wanted = "+".join(f"eq(n,{number})" for number in numbers)
    filters = f"select='{wanted}',setpts=N/({_RATE}*TB)"
    options = ["-vf", filters, "-r", str(_RATE), "-q:v", str(QUALITY), "-start_number", "0", "%06d.jpg"]
    with _decoding(video, options, into=folder) as stream:
        stream.read()
    frames = []
    for i, number in enumerate(numbers):
        frames.append(folder / f"frame_{number:06d}.jpg")
        try:
            os.rename(folder / f"{i:06d}.jpg", frames[-1])
        except FileNotFoundError as error:
            raise DataError(f"ffmpeg took {i} of {len(numbers)} frames of {video.path}; is the file whole?") from error
    return frames


@contextmanager
def _decoding(video: Video, options: Sequence[str], into: Path | None = None) -> Iterator[IO[bytes]]:
    """Run ffmpeg and give what it writes to its standard output; it works in ``into`` and ends with the block.

    Raises
    ------
    DataError
        It failed; with what it said last.
    """
    words = ["ffmpeg", "-nostdin", "-v", "error", "-i", _url(video.path), "-map", "0:V:0", *options]
    with tempfile.TemporaryFile() as said, subprocess.Popen(words, stdout=PIPE, stderr=said, cwd=into) as job:
        try:
            assert job.stdout is not None
            yield job.stdout
            failed = job.wait() != 0
        finally:
            job.kill()
        if failed:
            said.seek(0)
            raise DataError(f"ffmpeg cannot decode {video.path}: {_last_line(said.read().decode(errors='replace'))}")


def _url(path: Path) -> str:
    """Return a path as ffmpeg takes none for an option or a protocol."""
    return f"file:{path.resolve()}"


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip() if lines else ""
