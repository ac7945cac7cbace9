"""Depth maps for fusion, and a temporary file that stores all of them.

Fusion reads the frames several times: to find the blocks, and to integrate. They are stored in a temporary file, so
that they are neither kept in memory nor rendered again.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.spill import SpillFile
from gs2d.errors import ShapeError


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Rendered depth and colour of one view, as arrays or tensors."""

    camera: Camera
    # [H, W] world units along the optical axis at pixel centres. 0, negative values and NaN are invalid. Infinity means
    # that the ray hits no surface, which contradicts any surface on it.
    depth: Any
    color: Any = None  # [H, W, 3] uint8, or float in [0, 1]
    valid: Any = None  # [H, W] bool (False for background, masked pixels, alpha < 0.5), or a weight >= 0


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A frame as numpy arrays with checked values."""

    camera: Camera
    depth: np.ndarray  # [H, W] float32 world units; 0 at invalid pixels, infinite without a surface
    color: np.ndarray | None  # [H, W, 3] uint8
    weight: np.ndarray | None  # [H, W] float32; None means 1 wherever depth > 0


def depth_map(frame: RenderedView) -> DepthMap:
    """Convert a frame to numpy and check it.

    Raises ShapeError if depth, colour or mask do not have the size of the camera, a weight is negative or not finite,
    or the camera has rays.
    """
    camera = frame.camera
    if camera.rays is not None:
        raise ShapeError("meshes need depth maps of pinhole cameras, got a camera with rays; render pinhole views")
    depth = _array(frame.depth)
    color = None if frame.color is None else _array(frame.color)
    valid = None if frame.valid is None else _array(frame.valid)
    check_shapes({"depth": (depth, f"{camera.height} {camera.width}")})
    usable = depth > 0
    weight = None
    if valid is not None:
        check_shapes({"valid": (valid, f"{camera.height} {camera.width}")})
        if valid.dtype != bool:
            weight = valid.astype(np.float32)
            if not (np.isfinite(weight).all() and (weight >= 0).all()):
                raise ShapeError("valid must be bool or finite weights >= 0, got negative or non-finite weights")
        usable &= valid > 0
    if color is not None:
        check_shapes({"color": (color, f"{camera.height} {camera.width} 3")})
        if color.dtype != np.uint8:
            color = np.rint(np.clip(np.nan_to_num(color), 0.0, 1.0) * 255.0).astype(np.uint8)
    return DepthMap(camera, np.where(usable, depth, 0).astype(np.float32), color, weight)


def _array(value: Any) -> np.ndarray:
    """Convert a torch tensor on any device to numpy, without importing torch."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    return np.asarray(value)


class Spool:
    """Depth maps in an unnamed temporary file, for repeated iteration.

    Frames are read once, checked (ShapeError) and written one by one (DiskError).
    """

    def __init__(self, frames: Iterable[RenderedView]) -> None:
        self._file = SpillFile("depth maps", "or set TMPDIR to another folder")
        self._places: list[tuple[int, int]] = []
        self.cameras: list[Camera] = []
        for frame in frames:
            self._places.append(self._file.put(pickle.dumps(depth_map(frame), protocol=pickle.HIGHEST_PROTOCOL)))
            self.cameras.append(frame.camera)

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[DepthMap]:
        return map(self._file.get, self._places)
