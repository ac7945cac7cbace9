"""How a camera turns light into values, beside the exposure of each photograph: vignetting and response.

The numbers are docs/math.md's, "Vignetting and response". A photograph that is taken back through them and its exposure
is in the colours of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gs2d.core.camera import Camera


class CameraPhotometry(NamedTuple):
    """Vignetting and response of one camera; free of the image's size, so that it holds at any downscale.

    Attributes
    ----------
    falloff : three floats
        a, b and c: at a squared radius u the light is exp(-(a u + b u^2 + c u^3)) times that at the principal point.
    reach : float
        Radius 1, in focal lengths: that of the farthest corner.
    shift : float
        s of the camera's response; 0 is that of the scene, the mean of all training photographs.
    """

    falloff: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach: float = 1.0
    shift: float = 0.0

    def corner(self) -> float:
        """Return what is left of the light in the farthest corner."""
        return math.exp(-sum(self.falloff))


def reach_of(cameras: Sequence[Camera]) -> float:
    """Return the radius of the farthest corner of the images of cameras, in focal lengths."""
    corners = [math.hypot(max(c.cx, c.width - c.cx) / c.fx, max(c.cy, c.height - c.cy) / c.fy) for c in cameras]
    return max(corners)


def squared_radii(camera: Camera, reach: float) -> np.ndarray:
    """Return u of each pixel [H, W] float32: squared distances from the principal point, 1 at ``reach``."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / (camera.fx * reach)
    y = (np.arange(camera.height) + 0.5 - camera.cy) / (camera.fy * reach)
    return (x**2 + y[:, None] ** 2).astype(np.float32)
