"""Images as a video: MP4 with H.264 by the ffmpeg of the machine, or an animated WebP by Pillow.

ffmpeg is a program of the user's, not a dependency: its wheels hold code under the GPL.
"""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from PIL import Image

from gs2d.core.atomic_files import atomic_write, disk_error, temporary_beside
from gs2d.core.extras import FFMPEG
from gs2d.errors import BackendError, DataError

SUFFIXES = (".mp4", ".webp")
QUALITY = 18  # x264's constant rate factor, 0 to 51, small is good: no loss that one sees
WEBP_QUALITY = 75  # Pillow's, 0 to 100
# yuv420p, 8 bits, halves both sides of colour: with H.264 what every player has. It needs even sides; sRGB is near
# enough to BT.709's curve that players show it so, and the matrix is said, since they guess another for small videos.
_FILTERS = "crop=trunc(iw/2)*2:trunc(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"
_TAGS = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv")


def check_video(path: Path, fps: float, frames: int) -> Path:
    """Return the name of the video, or raise where none can come out, before anything is rendered.

    A name without an ending gets ``.mp4`` where ffmpeg is on the PATH, else ``.webp``.

    Raises
    ------
    DataError
        Another kind of file, a senseless rate, or too few frames.
    BackendError
        ``.mp4`` without an ffmpeg that makes H.264.
    """
    if not path.suffix:
        path = path.with_name(path.name + (".webp" if _missing() else ".mp4"))
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DataError(f"--video must name a .mp4 or .webp file, got {path}")
    if not 0.1 <= fps <= 240:
        raise DataError(f"fps must be 0.1 to 240 frames a second, got {fps:g}")
    if frames < 2:
        raise DataError(f"--video needs at least 2 frames, got {frames}; ask for more")
    if suffix == ".mp4" and (missing := _missing()):
        raise BackendError(f"{path.name} needs ffmpeg, and {missing}; install it ({FFMPEG}), or name a .webp file")
    return path


def _missing() -> str:
    """Return why no MP4 can be made here; nothing where it can."""
    if shutil.which("ffmpeg") is None:
        return "there is none on the PATH"
    encoders = subprocess.run(["ffmpeg", "-v", "error", "-encoders"], capture_output=True, text=True, errors="replace")
    return "" if " libx264 " in encoders.stdout else f"{shutil.which('ffmpeg')} was built without libx264"


def write_video(
    path: Path,
    frames: Sequence[Path],
    *,
    fps: float,
    threads: int = 1,
    on_frame: Callable[[int], None] = lambda _done: None,
) -> None:
    """Compress images to a video.

    Parameters
    ----------
    path : Path
        Ends in ``.mp4`` or ``.webp``; its folder must exist.
    frames : sequence of Path
        Images of one size, at least 2. For ``.mp4`` one at a time is decoded; of an odd side the last row or column
        is left out. For ``.webp`` all are in memory.
    fps : float
        Frames a second.
    threads : int
        Of ffmpeg.
    on_frame : callable
        Told how many frames were read; what it raises stops the work, and no file is left.
    """
    check_video(path, fps, len(frames))
    if path.suffix.lower() == ".mp4":
        _write_mp4(path, frames, fps, threads, on_frame)
        return
    images = list(_decoded(frames, on_frame))
    ends = [round(1000 * (i + 1) / fps) for i in range(len(frames))]
    durations = [end - start for start, end in zip([0, *ends], ends, strict=False)]  # ms
    with atomic_write(path) as file:
        rest = {"save_all": True, "append_images": images[1:], "duration": durations, "loop": 0}
        images[0].save(file, "WEBP", quality=WEBP_QUALITY, **rest)


def _write_mp4(path: Path, frames: Sequence[Path], fps: float, threads: int, on_frame: Callable[[int], None]) -> None:
    with Image.open(frames[0]) as first:
        size = f"{first.width}x{first.height}"
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-framerate", f"{fps:g}", "-i", "-", "-vf", _FILTERS]
    coded = ["-c:v", "libx264", "-crf", str(QUALITY), *_TAGS, "-threads", str(threads), "-movflags", "+faststart"]
    try:
        with temporary_beside(path) as (temporary, _):
            whole = ["-f", "mp4", "-y", f"file:{temporary}"]
            _run(["ffmpeg", "-v", "error", *given, *coded, *whole], _decoded(frames, on_frame), path)
    except OSError as error:
        raise disk_error(path, error) from error


def _run(words: list[str], images: Iterator[Image.Image], path: Path) -> None:
    """Run ffmpeg on the pixels of images; BackendError or OSError with what it said last where it fails."""
    with tempfile.TemporaryFile() as said, subprocess.Popen(words, stdin=subprocess.PIPE, stderr=said) as job:
        assert job.stdin is not None
        try:
            for image in images:
                job.stdin.write(image.tobytes())
            job.stdin.close()
        except BrokenPipeError:  # it gave up, and says why
            pass
        except BaseException:
            job.kill()
            job.wait()  # leaving the block waits a quarter of a second only after Ctrl-C
            raise
        if job.wait() != 0:
            said.seek(0)
            last = said.read().decode(errors="replace").strip().rpartition("\n")[2]
            if os.strerror(errno.ENOSPC) in last:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise BackendError(f"ffmpeg did not make {path}: {last or f'exit status {job.returncode}'}")


def _decoded(frames: Sequence[Path], on_frame: Callable[[int], None]) -> Iterator[Image.Image]:
    """Yield the frames, all of the first one's size.

    Raises
    ------
    DataError
        One has another size.
    """
    size = None
    for done, path in enumerate(frames, 1):
        with Image.open(path) as image:
            frame = image.convert("RGB")
        size = size or frame.size
        if frame.size != size:
            raise DataError(f"frames of one size were expected, got {size} and {frame.size} ({path})")
        yield frame
        on_frame(done)
