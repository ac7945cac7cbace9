"""Depth maps on their way into the volume: one frame, and a file that holds all of them.

Fusion reads the frames twice (once to find the blocks, once to integrate). Frames come from rendering, so they are
kept in a temporary file, not in memory, and not rendered again.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import DiskError, ShapeError


@dataclass(frozen=True, eq=False)
class RenderedView:
    """What one camera saw.

    Attributes
    ----------
    camera : Camera
    depth : ndarray or Tensor [H, W] world units
        Depth along the optical axis at pixel centres; 0, negative and NaN carry nothing. Infinity makes no surface,
        but says that the view sees past everything along this ray.
    color : ndarray or Tensor [H, W, 3] or None
        uint8, or float in [0, 1].
    valid : ndarray or Tensor [H, W] or None
        bool (False carries nothing: background, masked out, alpha < 0.5), or a weight >= 0 of each pixel.
    """

    camera: Camera
    depth: Any
    color: Any = None
    valid: Any = None


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A frame as fusion reads it: numpy, cleaned."""

    camera: Camera
    depth: np.ndarray  # [H, W] float32 world units, 0 where nothing was seen, infinite where no surface is
    color: np.ndarray | None  # [H, W, 3] uint8
    weight: np.ndarray | None  # [H, W] float32, None: 1 wherever depth > 0


def depth_map(frame: RenderedView) -> DepthMap:
    """Clean a frame.

    Raises
    ------
    ShapeError
        If depth, colour or mask are not of the camera's size, or a weight is negative or not finite.
    """
    camera = frame.camera
    depth = _array(frame.depth)
    color = None if frame.color is None else _array(frame.color)
    valid = None if frame.valid is None else _array(frame.valid)
    check_shapes({"depth": (depth, f"{camera.height} {camera.width}")})
    seen = depth > 0
    weight = None
    if valid is not None:
        check_shapes({"valid": (valid, f"{camera.height} {camera.width}")})
        if valid.dtype != bool:
            weight = valid.astype(np.float32)
            if not (np.isfinite(weight).all() and (weight >= 0).all()):
                raise ShapeError("valid must be bool or finite weights >= 0, got negative or non-finite weights")
        seen &= valid > 0
    if color is not None:
        check_shapes({"color": (color, f"{camera.height} {camera.width} 3")})
        if color.dtype != np.uint8:
            color = np.rint(np.clip(np.nan_to_num(color), 0.0, 1.0) * 255.0).astype(np.uint8)
    return DepthMap(camera, np.where(seen, depth, 0).astype(np.float32), color, weight)


def _array(value: Any) -> np.ndarray:
    """numpy, from numpy or a torch tensor on any device (no import of torch needed)."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    return np.asarray(value)


@dataclass(frozen=True)
class _Slot:
    """Where one depth map lies in the file."""

    camera: Camera
    offset: int
    has_color: bool
    has_weight: bool


class Spool:
    """Depth maps in a temporary file without a name, to be iterated over any number of times.

    Raises
    ------
    DiskError
        If the file cannot be written.
    """

    def __init__(self) -> None:
        try:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise DiskError(f"Cannot create a temporary file for depth maps: {error.strerror}. Set TMPDIR.") from error
        self._slots: list[_Slot] = []

    def append(self, item: DepthMap) -> None:
        """Write one depth map."""
        try:
            offset = self._file.seek(0, os.SEEK_END)
            self._file.write(np.ascontiguousarray(item.depth, np.float32).tobytes())
            if item.color is not None:
                self._file.write(np.ascontiguousarray(item.color, np.uint8).tobytes())
            if item.weight is not None:
                self._file.write(np.ascontiguousarray(item.weight, np.float32).tobytes())
            self._file.flush()
        except OSError as error:
            raise DiskError(
                f"depth maps need a temporary file, writing number {len(self._slots) + 1} failed "
                f"({error.strerror}); free some space or set TMPDIR to another folder"
            ) from error
        has = (part is not None for part in (item.color, item.weight))
        self._slots.append(_Slot(item.camera, offset, *has))

    @classmethod
    @contextmanager
    def of(cls, frames: Iterable[RenderedView] | Spool) -> Iterator[Spool]:
        """Give the frames in a file of their own, cleaned one by one, that is closed at the end; a spool as it is.

        A spool stays open: whoever made it may read it again, in larger voxels.
        """
        if isinstance(frames, Spool):
            yield frames
            return
        with cls() as spool:
            spool.extend(frames)
            yield spool

    def extend(self, frames: Iterable[RenderedView]) -> None:
        """Clean and write frames one by one."""
        for frame in frames:
            self.append(depth_map(frame))

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the depth maps, in order."""
        return [slot.camera for slot in self._slots]

    def __len__(self) -> int:
        return len(self._slots)

    def __iter__(self) -> Iterator[DepthMap]:
        for slot in self._slots:
            self._file.seek(slot.offset)
            shape = (slot.camera.height, slot.camera.width)
            depth = self._read(np.float32, shape)
            color = self._read(np.uint8, (*shape, 3)) if slot.has_color else None
            weight = self._read(np.float32, shape) if slot.has_weight else None
            yield DepthMap(slot.camera, depth, color, weight)

    def _read(self, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        count = int(np.prod(shape))
        return np.frombuffer(self._file.read(count * np.dtype(dtype).itemsize), dtype, count).reshape(shape)

    def close(self) -> None:
        """Give the file back."""
        self._file.close()

    def __enter__(self) -> Spool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
