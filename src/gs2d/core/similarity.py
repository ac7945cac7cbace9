"""Similarity transforms (rotation, translation, scale) from corresponding points."""

from __future__ import annotations

import math

import numpy as np

from gs2d.core.checks import check_shapes
from gs2d.errors import DataError


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a transform [4, 4] to points [P, 3], in float64."""
    return np.asarray(np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3])


def similarity_scale(T: np.ndarray, name: str = "T") -> float:
    """Return the scale of a similarity [4, 4]; DataError if it is mirrored, sheared, or scaled anisotropically."""
    check_shapes({name: (T, "4 4")})
    A = T[:3, :3]
    determinant = float(np.linalg.det(A))
    scale = math.copysign(abs(determinant) ** (1 / 3), determinant)
    if not (scale > 0 and np.allclose(A @ A.T, scale**2 * np.eye(3), rtol=0, atol=1e-4 * scale**2)):
        raise DataError(f"{name} must be a rotation, a translation and one positive scale")
    return scale


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """Return the shortest rotation [3, 3] from the unit vector ``up`` to +z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)  # Rodrigues' formula for the axis up x e_z
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def umeyama(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the similarity [4, 4] with the least sum of |target - T source|^2 over pairs (Umeyama 1991, eq. 39 to 43).

    Rows i of ``source`` and ``target`` [P, 3] correspond. Raises DataError if the rotation is not determined: fewer
    than three pairs, or points on one line.
    """
    check_shapes({"source": (source, "P 3"), "target": (target, "P 3")})
    if len(source) < 3:
        raise DataError(f"an alignment needs at least three corresponding points, got {len(source)}")
    T, determined = umeyama_batch(source[None].astype(np.float64), target[None].astype(np.float64))
    if not determined[0]:
        raise DataError("an alignment needs corresponding points that span a plane, got points on a line")
    return np.asarray(T[0])


def umeyama_batch(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return similarities [B, 4, 4] of batches of pairs [B, n, 3], and which of them are determined [B]."""
    mean_s, mean_t = source.mean(axis=1), target.mean(axis=1)
    s, t = source - mean_s[:, None], target - mean_t[:, None]
    U, D, Vt = np.linalg.svd(np.einsum("bni,bnj->bij", t, s) / source.shape[1])
    signs = np.ones_like(D)
    signs[:, 2] = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)  # no mirror image
    R = (U * signs[:, None]) @ Vt
    variance = np.square(s).sum(axis=(1, 2)) / source.shape[1]
    determined = (D[:, 1] > 1e-9 * D[:, 0]) & (D[:, 0] > 0)
    scale = np.where(variance > 0, (D * signs).sum(axis=1) / np.where(variance > 0, variance, 1), 1.0)
    determined &= scale > 0
    T = np.zeros((len(source), 4, 4))
    T[:, :3, :3] = scale[:, None, None] * R
    T[:, :3, 3] = mean_t - np.einsum("bij,bj->bi", T[:, :3, :3], mean_s)
    T[:, 3, 3] = 1
    return T, determined
