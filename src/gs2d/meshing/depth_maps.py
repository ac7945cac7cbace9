"""Depth maps for fusion, and a temporary file that stores all of them.

Fusion reads the frames several times: to find the blocks, and to integrate. They are stored in a temporary file, so
that they are neither kept in memory nor rendered again.
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
    """Rendered depth and colour of one view.

    Attributes
    ----------
    camera : Camera
    depth : ndarray or Tensor [H, W] world units
        Depth along the optical axis at pixel centres. 0, negative values and NaN are invalid. Infinity means that the
        ray hits no surface, which contradicts any surface on it.
    color : ndarray or Tensor [H, W, 3] or None
        uint8, or float in [0, 1].
    valid : ndarray or Tensor [H, W] or None
        bool (False for background, masked pixels, alpha < 0.5), or a weight >= 0 for each pixel.
    """

    camera: Camera
    depth: Any
    color: Any = None
    valid: Any = None


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A frame as numpy arrays with checked values."""

    camera: Camera
    depth: np.ndarray  # [H, W] float32 world units; 0 at invalid pixels, infinite without a surface
    color: np.ndarray | None  # [H, W, 3] uint8
    weight: np.ndarray | None  # [H, W] float32; None means 1 wherever depth > 0


def depth_map(frame: RenderedView) -> DepthMap:
    """Convert a frame to numpy and check it.

    Raises
    ------
    ShapeError
        If depth, colour or mask do not have the size of the camera, or a weight is negative or not finite.
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
    """Convert a torch tensor on any device to numpy, without importing torch."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    return np.asarray(value)


@dataclass(frozen=True)
class _Slot:
    """Position of one depth map in the file."""

    camera: Camera
    offset: int
    has_color: bool
    has_weight: bool


class Spool:
    """Depth maps in an unnamed temporary file, for repeated iteration.

    Raises
    ------
    DiskError
        If the file cannot be created.
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
                f"cannot write depth map {len(self._slots) + 1} to a temporary file ({error.strerror}); free some disk "
                "space, or set TMPDIR to another folder"
            ) from error
        has = (part is not None for part in (item.color, item.weight))
        self._slots.append(_Slot(item.camera, offset, *has))

    @classmethod
    @contextmanager
    def of(cls, frames: Iterable[RenderedView] | Spool) -> Iterator[Spool]:
        """Yield a spool of the frames, which is closed at the end. A spool is passed through and stays open."""
        if isinstance(frames, Spool):
            yield frames
            return
        with cls() as spool:
            spool.extend(frames)
            yield spool

    def extend(self, frames: Iterable[RenderedView]) -> None:
        """Check and write frames one by one."""
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
        """Close and delete the file."""
        self._file.close()

    def __enter__(self) -> Spool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
