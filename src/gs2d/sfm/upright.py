"""Which way is up, from how people hold cameras. Numpy only: the process that runs COLMAP does not load torch."""

from __future__ import annotations

import numpy as np

MIN_AGREEMENT = 0.3  # length of the mean of the cameras' up vectors
_TOWARDS_MEAN = 0.01  # decides where all right-hand vectors are parallel, negligible where they are not


def up_direction(rotations: np.ndarray) -> np.ndarray | None:
    """Return the direction that is up, as a unit vector [3] of the world; None where the cameras do not agree on one.

    Photographers hold the camera level but tilt it up and down: up is what the cameras' x axes r_i are perpendicular
    to, the unit vector u that minimises mean((r_i . u)^2) - 0.01 (m . u)^2 with m the mean of the cameras' up vectors.

    Parameters
    ----------
    rotations : ndarray [V, 3, 3]
        World to camera, OpenCV axes: rows are the camera's right, down and forward in the world.
    """
    right, mean_up = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    if np.linalg.norm(mean_up) < MIN_AGREEMENT:
        return None
    spread = right.T @ right / len(right) - _TOWARDS_MEAN * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(up if up @ mean_up > 0 else -up)
