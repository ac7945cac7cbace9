"""Similarity transforms (rotation, shift, one scale) from corresponding points, and robustly from camera centres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gs2d.core.checks import check_shapes
from gs2d.errors import DataError

_BATCH = 256  # samples fitted at a time


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [P, 3] under a transform [4, 4], float64."""
    return np.asarray(np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3])


def similarity_scale(T: np.ndarray, name: str = "T") -> float:
    """Return the scale of a similarity [4, 4].

    Raises
    ------
    DataError
        It is none: mirrored, sheared, or with another scale on each axis.
    """
    check_shapes({name: (T, "4 4")})
    A = T[:3, :3]
    determinant = float(np.linalg.det(A))
    scale = math.copysign(abs(determinant) ** (1 / 3), determinant)
    if not (scale > 0 and np.allclose(A @ A.T, scale**2 * np.eye(3), rtol=0, atol=1e-4 * scale**2)):
        raise DataError(f"{name} must be a rotation, a shift and one positive scale, got another matrix")
    return scale


def rotation_degrees(T: np.ndarray) -> float:
    """Angle of the rotation in a similarity [4, 4], degrees."""
    cosine = (np.trace(T[:3, :3]) / similarity_scale(T) - 1) / 2
    return math.degrees(math.acos(min(1.0, max(-1.0, float(cosine)))))


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """Return the shortest rotation [3, 3] that takes the unit vector ``up`` to +z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)  # Rodrigues' formula for the axis up x e_z
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def umeyama(source: np.ndarray, target: np.ndarray, *, with_scale: bool = True) -> np.ndarray:
    """Return the similarity [4, 4] with the least sum of |target - T source|^2 over pairs (Umeyama 1991, eq. 39 to 43).

    Parameters
    ----------
    source, target : ndarray [P, 3]
        Row i of one corresponds to row i of the other.
    with_scale : bool
        False: rotation and shift only.

    Raises
    ------
    DataError
        Fewer than three pairs, or points on one line: the rotation is not determined.
    """
    check_shapes({"source": (source, "P 3"), "target": (target, "P 3")})
    if len(source) < 3:
        raise DataError(f"three corresponding points at least were expected for an alignment, got {len(source)}")
    T, determined = _umeyama(source[None].astype(np.float64), target[None].astype(np.float64), with_scale)
    if not determined[0]:
        raise DataError("corresponding points that span a plane were expected for an alignment, got points on a line")
    return np.asarray(T[0])


def _umeyama(source: np.ndarray, target: np.ndarray, with_scale: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return transforms [B, 4, 4] of batches of pairs [B, n, 3], and which of them are determined [B]."""
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
    if not with_scale:
        scale = np.ones_like(scale)
    T = np.zeros((len(source), 4, 4))
    T[:, :3, :3] = scale[:, None, None] * R
    T[:, :3, 3] = mean_t - np.einsum("bij,bj->bi", T[:, :3, :3], mean_s)
    T[:, 3, 3] = 1
    return T, determined


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A similarity that most pairs agree on.

    Attributes
    ----------
    T_target_source : ndarray [4, 4]
    inliers : ndarray [P] bool
        Pairs nearer than the threshold under it.
    rms, worst : float
        Root mean square and largest distance of the inliers, target units.
    """

    T_target_source: np.ndarray
    inliers: np.ndarray
    rms: float
    worst: float

    @property
    def fraction(self) -> float:
        """Part of the pairs that are inliers."""
        return float(self.inliers.mean())


def ransac_similarity(
    source: np.ndarray,
    target: np.ndarray,
    *,
    threshold: float,
    sample: int = 6,
    iterations: int = 10_000,
    confidence: float = 0.9999,
    seed: int = 0,
) -> RobustFit:
    """Find the similarity with most pairs within ``threshold`` among random samples (Fischler and Bolles 1981).

    The best sample is fitted again to all its inliers until they no longer change. Stops early once a better sample
    is less likely than 1 - confidence.

    Parameters
    ----------
    source, target : ndarray [P, 3]
        Corresponding points, as camera centres of two reconstructions of the same photographs.
    threshold : float
        Target units.
    sample : int
        Pairs in each sample; fewer if there are fewer.

    Raises
    ------
    DataError
        Fewer than three pairs, all on one line, or no three that agree.
    """
    check_shapes({"source": (source, "P 3"), "target": (target, "P 3")})
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    count = len(source)
    whole = umeyama(source, target)  # raises for what cannot be aligned at all
    best = _residuals(whole, source, target) < threshold
    sample = min(sample, count)
    rng = np.random.default_rng(seed)
    tried = 0
    while tried < min(iterations, _needed(best.mean(), sample, confidence)):
        rows = np.argsort(rng.random((_BATCH, count)), axis=1)[:, :sample]
        T, determined = _umeyama(source[rows], target[rows], True)
        moved = np.einsum("bij,nj->bni", T[:, :3, :3], source) + T[:, None, :3, 3]
        inside = (np.linalg.norm(moved - target, axis=2) < threshold) & determined[:, None]
        counts = inside.sum(axis=1)
        if counts.max() > best.sum():
            best = inside[int(counts.argmax())]
        tried += _BATCH
    if best.sum() < 3:
        raise DataError(
            f"corresponding points that agree within {threshold:g} were expected, at most {int(best.sum())} of {count} "
            "do; are both lists of the same photographs, in the same order?"
        )
    return _refined(source, target, best, threshold)


def _refined(source: np.ndarray, target: np.ndarray, inliers: np.ndarray, threshold: float) -> RobustFit:
    """Fit to the inliers, find them again, a few times."""
    T = umeyama(source[inliers], target[inliers])
    for _ in range(20):
        again = _residuals(T, source, target) < threshold
        if again.sum() < 3 or (again == inliers).all():
            break
        inliers = again
        T = umeyama(source[inliers], target[inliers])
    distances = _residuals(T, source, target)[inliers]
    return RobustFit(T, inliers, float(np.sqrt(np.square(distances).mean())), float(distances.max()))


def _residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(apply(T, source) - target, axis=1))


def _needed(fraction: float, sample: int, confidence: float) -> float:
    """Return how many samples it takes until one of inliers only was among them with this confidence."""
    good = float(fraction) ** sample
    return math.inf if good <= 0 else 0 if good >= 1 else math.log(1 - confidence) / math.log1p(-good)
