"""Gaussians rotated, mirrored and moved, for files with other axes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gs2d.core.sh import harmonics
from gs2d.core.transforms import transform_splats
from gs2d.io.gaussians import Gaussians

_OBLIQUE = (0.36, 0.48, 0.8)  # a direction in which no harmonic is 0


def placed(g: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Apply a similarity transform [4, 4]: rotation, translation, uniform scale.

    Raises ValueError if it is no similarity.
    """
    linear = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        scale = float(np.cbrt(np.linalg.det(linear)))
        rotation = linear / scale if scale > 0 else linear
        turns = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (turns and np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)):
        raise ValueError("expected a rotation, a translation and a uniform scale")
    moved = Gaussians.of(transform_splats(g.disks(), scale, rotation, matrix[:3, 3]))
    thickness = (g.log_scales[:, 2:].astype(np.float64) + math.log(scale)).astype(np.float32)
    return replace(moved, log_scales=np.concatenate([moved.log_scales[:, :2], thickness], axis=1))


def half_turned_about_z(g: Gaussians) -> Gaussians:
    """Rotate by 180 degrees about z; exact, only signs and the order of components change."""
    w, x, y, z = g.quats.T
    return replace(mirrored(g, (-1, -1, 1)), quats=np.stack([-z, -y, x, w], axis=1))


def mirrored(g: Gaussians, signs: tuple[int, int, int]) -> Gaussians:
    """Mirror axes, with one sign (1 or -1) per axis; exact, only signs change.

    A rotation R becomes S R S with S = diag(signs), which is a rotation with the mirrored covariance.
    """
    x, y, z = signs
    a, b, c = _OBLIQUE
    at = np.array(harmonics(a, b, c, g.sh_degree))
    there = np.array(harmonics(x * a, y * b, z * c, g.sh_degree))
    with np.errstate(invalid="ignore"):  # signalling NaN; values are checked later
        return replace(
            g,
            means=g.means * np.array(signs, np.float32),
            quats=g.quats * np.array([1, y * z, x * z, x * y], np.float32),
            shN=g.shN * np.sign(at * there).astype(np.float32).reshape(-1, 1),
        )
