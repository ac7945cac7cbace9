"""Depth maps of a wavy wall, for fusion tests on every device."""

from __future__ import annotations

import numpy as np

from gs2d.core.camera import look_at
from gs2d.meshing.depth_maps import DepthMap, RenderedView, depth_map


def waves(count: int, *, colored: bool) -> list[DepthMap]:
    """Return depth maps of a wavy wall with holes; every other view has weights, every third has no colours."""
    rng = np.random.default_rng(0)
    found = []
    for k in range(count):
        eye = np.array([0.3 * k - 0.4, -2.0, 0.1 * k])
        camera = look_at(eye, np.zeros(3), np.array([0.0, 0.1, 1.0]), width=20, height=16, fx=24.0)
        depth = 2.0 + 0.1 * np.sin(np.arange(20.0)) + 0.02 * rng.standard_normal((16, 20))
        valid = rng.random((16, 20)) > 0.1
        color = rng.random((16, 20, 3)) if colored and k != 2 else None
        found.append(depth_map(RenderedView(camera, depth, color, valid * rng.random((16, 20)) if k % 2 else valid)))
    return found
