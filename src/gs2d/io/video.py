"""Pictures as a film: MP4 with AV1, or animated WebP. Pillow compresses; no other package is needed."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, features

from gs2d.core.files import atomic_write
from gs2d.errors import BackendError, DataError
from gs2d.io.mp4 import film_header, read_sequence

SUFFIXES = (".mp4", ".webp")
SPEED = 8  # of the compressor, 0 to 10: the slower ones take minutes for a few per cent


def check_video(path: Path, fps: float, frames: int) -> None:
    """Raise where no film can come out, before anything is rendered.

    Raises
    ------
    DataError
        Another kind of file, a senseless rate, or too few frames.
    BackendError
        This Pillow cannot compress it.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DataError(f"--video must name a .mp4 or .webp file, got {path}")
    if not 0.1 <= fps <= 240:
        raise DataError(f"--fps must be 0.1 to 240 frames a second, got {fps:g}")
    if frames < 2:
        raise DataError(f"--video needs at least 2 frames, got {frames}; ask for more")
    kind = {".mp4": "avif", ".webp": "webp"}[suffix]
    if not features.check(kind):
        raise BackendError(
            f"{suffix} needs Pillow with {kind.upper()}, got Pillow {Image.__version__} without it; "
            "pip install 'pillow>=11.3', or name the other of .mp4 and .webp"
        )


def write_video(
    path: Path,
    frames: Sequence[Path],
    *,
    fps: float,
    quality: int = 75,
    threads: int = 1,
    on_frame: Callable[[int], None] = lambda _done: None,
) -> None:
    """Compress pictures to a film.

    Parameters
    ----------
    path : Path
        Ends in ``.mp4`` or ``.webp``; its folder must exist.
    frames : sequence of Path
        Pictures of one size, at least 2. One at a time is decoded.
    fps : float
        Frames a second.
    quality : int
        0 (smallest) to 100 (best).
    threads : int
    on_frame : callable
        Told how many frames were read; what it raises stops the work, and no file is left.

    Raises
    ------
    DataError, BackendError, DiskError
    """
    check_video(path, fps, len(frames))
    opened: list[Any] = []  # the frame that is decoded now
    pictures = [_Frame(frame, i + 1, opened, on_frame) for i, frame in enumerate(frames)]
    first = _decoded(frames[0])
    if path.suffix.lower() == ".webp":
        ends = [round(1000 * (i + 1) / fps) for i in range(len(frames))]
        durations = [end - start for start, end in zip([0, *ends], ends, strict=False)]  # ms
        with atomic_write(path) as file:
            first.save(
                file, "WEBP", save_all=True, append_images=pictures[1:], duration=durations, quality=quality, loop=0
            )
        return
    buffer = io.BytesIO()
    first.save(
        buffer,
        "AVIF",
        save_all=True,
        append_images=pictures[1:],
        duration=1000,  # of no importance: the film has its own table
        quality=quality,
        speed=SPEED,
        range="limited",  # what players assume
        max_threads=threads,
    )
    film = read_sequence(buffer.getvalue())
    with atomic_write(path) as file:
        file.writelines([film_header(film, fps), *film.samples])


def _decoded(path: Path) -> Image.Image:
    with Image.open(path) as picture:
        return picture.convert("RGB")


class _Frame:
    """A picture that Pillow's writers of sequences decode when they come to it, and that is forgotten after it."""

    mode, n_frames, is_animated = "RGB", 1, False

    def __init__(self, path: Path, number: int, opened: list[Any], on_frame: Callable[[int], None]) -> None:
        self._path, self._number, self._opened, self._on_frame = path, number, opened, on_frame

    def seek(self, index: int) -> None:
        """There is one picture only."""
        if index:
            raise EOFError

    def tell(self) -> int:
        """Number of the picture."""
        return 0

    def __getattr__(self, name: str) -> Any:
        if not (self._opened and self._opened[0] is self):
            self._opened[:] = [self, _decoded(self._path)]
            self._on_frame(self._number)
        return getattr(self._opened[1], name)
