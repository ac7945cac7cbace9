"""Estimate the up direction from camera rotations. Uses numpy only, because the worker does not load torch."""

from __future__ import annotations

import numpy as np

MIN_AGREEMENT = 0.3  # smallest length of the mean of the cameras' up vectors
_TOWARDS_MEAN = 0.01  # decides if all right vectors are parallel, negligible otherwise


def up_direction(rotations: np.ndarray) -> np.ndarray | None:
    """Return the up direction as a unit vector [3] in the world; None if the cameras do not agree.

    Photographers hold the camera level but tilt it up and down, so up is perpendicular to the cameras' x axes r_i: the
    unit vector u that minimises mean((r_i . u)^2) - 0.01 (m . u)^2, where m is the mean of the cameras' up vectors.
    ``rotations`` [V, 3, 3]: world to camera, OpenCV axes: rows are the camera's right, down and forward in the world.
    """
    right, mean_up = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    if np.linalg.norm(mean_up) < MIN_AGREEMENT:
        return None
    spread = right.T @ right / len(right) - _TOWARDS_MEAN * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(up if up @ mean_up > 0 else -up)
