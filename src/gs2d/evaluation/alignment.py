"""Similarity transforms (rotation, shift, one scale) from corresponding points, and robustly from camera centres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gs2d.core.checks import check_shapes
from gs2d.errors import DataError
from gs2d.evaluation.nearest import Cloud

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


# -- iterative closest points ------------------------------------------------------------------------------------------
# Written after the definitions of Open3D (``registration_icp``, ``voxel_down_sample``, ``uniform_down_sample``), which
# the official Tanks and Temples script calls; ``scripts/oracle_open3d.py`` compares the two.
CHUNK = 1 << 22  # points thinned at a time: bounds memory beside the clouds themselves


def voxel_downsample(points: np.ndarray, voxel: float) -> np.ndarray:
    """Return the mean of the points [P, 3] in each occupied cube of side ``voxel`` [Q, 3], float64.

    The grid starts half a voxel before the smallest coordinates. Means are gathered chunk by chunk.
    """
    if not len(points):
        return np.zeros((0, 3))
    low = points.min(axis=0).astype(np.float64) - voxel / 2
    size = np.floor((points.max(axis=0) - low) / voxel).astype(np.int64) + 1
    if math.prod(size.tolist()) >= 1 << 63:  # cells cannot be numbered: finer than anyone scans
        return np.asarray(points, np.float64)
    keys: list[np.ndarray] = []
    sums: list[np.ndarray] = []
    counts: list[np.ndarray] = []
    for start in range(0, len(points), CHUNK):
        part = np.asarray(points[start : start + CHUNK], np.float64)
        cell = np.floor((part - low) / voxel).astype(np.int64)
        key, total, count = _grouped((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], part, None)
        keys.append(key)
        sums.append(total)
        counts.append(count)
    key, total, count = _grouped(np.concatenate(keys), np.concatenate(sums), np.concatenate(counts))
    return np.asarray(total / count[:, None])


def _grouped(
    keys: np.ndarray, values: np.ndarray, counts: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sums [Q, 3] of values [P, 3], and of counts (None: ones), over equal keys; ordered by key."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    weight = np.ones(len(keys)) if counts is None else counts[order]
    return keys[first], np.add.reduceat(values[order], first, axis=0), np.add.reduceat(weight, first)


def uniform_downsample(points: np.ndarray, limit: int) -> np.ndarray:
    """Every k-th point where there are more than ``limit``, k = round(P / limit); else all of them."""
    if len(points) <= limit:
        return points
    return points[:: max(1, round(len(points) / limit))]


@dataclass(frozen=True, eq=False)
class IcpResult:
    """What an alignment found.

    Attributes
    ----------
    T_target_source : ndarray [4, 4]
    fraction_before, share : float
        Part of the source with a target within the threshold, at the start and at the end.
    rms_before, rms : float or None
        Of the distances of those; None where there are none.
    iterations : int
    converged : bool
        Whether it stopped because nothing changed.
    """

    T_target_source: np.ndarray
    fraction_before: float
    fraction: float
    rms_before: float | None
    rms: float | None
    iterations: int
    converged: bool


def icp(
    source: np.ndarray,
    target: np.ndarray,
    *,
    threshold: float,
    iterations: int,
    with_scale: bool = True,
    fraction_change: float = 1e-6,
    rms_change: float = math.inf,
    workers: int | None = None,
) -> IcpResult:
    """Move ``source`` [P, 3] onto ``target`` [Q, 3]: pair with the nearest, fit, repeat (Besl and McKay 1992).

    Parameters
    ----------
    threshold : float
        Pairs farther apart do not count.
    iterations : int
        At most.
    with_scale : bool
        A similarity rather than a rigid motion.
    fraction_change, rms_change : float
        It has converged when the share of paired points and their rms change by less, both. The official Tanks and
        Temples script leaves the rms out in effect (it passes 20).
    """
    cloud = Cloud(target, workers=workers)
    T = np.eye(4)
    moved = np.asarray(source, np.float64)
    fraction, rms, index, paired = _paired(cloud, moved, threshold)
    first, done, converged = (fraction, rms), 0, False
    for done in range(1, iterations + 1):  # noqa: B007
        if paired.sum() < 3:
            break
        step = umeyama(moved[paired], cloud.points[index[paired]], with_scale=with_scale)
        T, moved = step @ T, apply(step, moved)
        before = (fraction, rms)
        fraction, rms, index, paired = _paired(cloud, moved, threshold)
        if abs(before[0] - fraction) < fraction_change and abs(before[1] - rms) < rms_change:
            converged = True
            break
    return IcpResult(T, first[0], fraction, first[1] if first[0] else None, rms if fraction else None, done, converged)


def _paired(cloud: Cloud, points: np.ndarray, threshold: float) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Share and rms of the points with a neighbour within the threshold, the neighbours, and which points those are."""
    if not len(points):
        return 0.0, 0.0, np.zeros(0, np.int64), np.zeros(0, bool)
    distances, index = (found[:, 0] for found in cloud.nearest(points, limit=threshold))
    paired = np.isfinite(distances)
    rms = float(np.sqrt(np.square(distances[paired]).mean())) if paired.any() else 0.0
    return float(paired.mean()), rms, index, paired
