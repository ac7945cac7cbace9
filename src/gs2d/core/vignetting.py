"""Distances from the principal point, the coordinates of vignetting (docs/math.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gs2d.core.camera import Camera


def reach_of(cameras: Sequence[Camera]) -> float:
    """Return the largest distance of an image corner from the principal point, in focal lengths."""
    corners = [math.hypot(max(c.cx, c.width - c.cx) / c.fx, max(c.cy, c.height - c.cy) / c.fy) for c in cameras]
    return max(corners)


def squared_radii(camera: Camera, reach: float) -> np.ndarray:
    """Return u of each pixel [H, W] float32: squared distances from the principal point, 1 at ``reach``."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / (camera.fx * reach)
    y = (np.arange(camera.height) + 0.5 - camera.cy) / (camera.fy * reach)
    return (x**2 + y[:, None] ** 2).astype(np.float32)
