"""Where cameras go that nobody photographed from: what is up, circles, flights along the photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gs2d.camera import Camera

_SPREAD = 0.02  # of the cameras' horizontal axes, mean square, from which they tell what is up


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """What is up [3], unit, for people who hold cameras level: across the cameras' horizontal axes.

    The direction with the least sum of squares of its products with the cameras' x axes; where these are all but
    parallel (everybody looks the same way), the mean of the cameras' own up vectors. Unlike that mean it is not tilted
    where all look down from one side.
    """
    rotations = np.stack([camera.rotation for camera in cameras])  # [V, 3, 3]
    mean_up = -rotations[:, 1].mean(axis=0)
    squares, directions = np.linalg.eigh(rotations[:, 0].T @ rotations[:, 0] / len(cameras))  # ascending
    up = directions[:, 0] if squares[1] > max(_SPREAD, 4 * squares[0]) else mean_up
    if not np.linalg.norm(up) > 1e-9:
        up = -rotations[0, 1]
    up = up / np.linalg.norm(up)
    return np.asarray(up if up @ mean_up >= 0 else -up)
