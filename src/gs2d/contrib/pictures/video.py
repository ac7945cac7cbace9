"""Write images as a video: MP4 with H.264 by the installed ffmpeg, or an animated WebP by Pillow.

ffmpeg is not a dependency, because its wheels contain GPL code.
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
QUALITY = 18  # constant rate factor of x264, 0 (best) to 51: no visible loss
WEBP_QUALITY = 75  # Pillow's quality, 0 to 100
# yuv420p with 8 bits is supported by every player. It requires even sides. The transfer function of sRGB is close to
# BT.709; the matrix is stated, because players assume another one for small videos.
_FILTERS = "crop=trunc(iw/2)*2:trunc(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"
_TAGS = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv")


def check_video(path: Path, fps: float, frames: int) -> None:
    """Check early that a video can be written.

    Raises DataError for another suffix, an invalid frame rate, or too few frames. Raises BackendError for ``.mp4``
    without an ffmpeg that supports H.264.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DataError(f"--video must name a .mp4 or .webp file, got {path}")
    if not 0.1 <= fps <= 240:
        raise DataError(f"fps must be 0.1 to 240 frames a second, got {fps:g}")
    if frames < 2:
        raise DataError(f"--video needs at least 2 frames, got {frames}; render more")
    if suffix == ".mp4" and (missing := _missing()):
        raise BackendError(f"{path.name} needs ffmpeg, but {missing}; install it ({FFMPEG}), or use a .webp file")


def _missing() -> str:
    """Return why no MP4 can be written; empty if it can."""
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
    """Encode images as a video.

    ``path``: ends in ``.mp4`` or ``.webp``; its folder must exist. ``frames``: at least 2 images of equal size. For
    ``.mp4`` they are decoded one at a time, and odd sides lose their last row or column. For ``.webp`` all are in
    memory. ``on_frame``: called with the number of finished frames. An exception it raises stops the encoding without
    leaving a file.
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
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-framerate", f"{fps:g}", "-i", "-", "-vf", _FILTERS]
    codec = ["-c:v", "libx264", "-crf", str(QUALITY), *_TAGS, "-threads", str(threads), "-movflags", "+faststart"]
    try:
        with temporary_beside(path) as (temporary, _):
            target = ["-f", "mp4", "-y", f"file:{temporary}"]
            _run(["ffmpeg", "-v", "error", *source, *codec, *target], _decoded(frames, on_frame), path)
    except OSError as error:
        raise disk_error(path, error) from error


def _run(words: list[str], images: Iterator[Image.Image], path: Path) -> None:
    """Run ffmpeg on the pixels of images; raises BackendError or OSError with its last message if it fails."""
    with tempfile.TemporaryFile() as errors, subprocess.Popen(words, stdin=subprocess.PIPE, stderr=errors) as job:
        assert job.stdin is not None
        try:
            for image in images:
                job.stdin.write(image.tobytes())
            job.stdin.close()
        except BrokenPipeError:  # ffmpeg failed; the reason is in its output
            pass
        except BaseException:
            job.kill()
            job.wait()  # after Ctrl-C, leaving the block waits for a quarter of a second only
            raise
        if job.wait() != 0:
            errors.seek(0)
            last = errors.read().decode(errors="replace").strip().rpartition("\n")[2]
            if os.strerror(errno.ENOSPC) in last:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise BackendError(f"ffmpeg failed to write {path}: {last or f'exit status {job.returncode}'}")


def _decoded(frames: Sequence[Path], on_frame: Callable[[int], None]) -> Iterator[Image.Image]:
    """Yield the frames as RGB images.

    Raises DataError if their sizes differ.
    """
    size = None
    for done, path in enumerate(frames, 1):
        with Image.open(path) as image:
            frame = image.convert("RGB")
        size = size or frame.size
        if frame.size != size:
            raise DataError(f"expected frames of equal size, got {size} and {frame.size} ({path})")
        yield frame
        on_frame(done)
