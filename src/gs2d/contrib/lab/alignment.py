"""Thin point clouds and align them by iterative closest points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gs2d.contrib.lab.nearest import Cloud
from gs2d.core.checks import check_shapes
from gs2d.core.similarity import apply, similarity_scale, umeyama, umeyama_batch
from gs2d.errors import DataError

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
    """Return every k-th point, k = round(P / limit), if there are more than ``limit`` points; else all of them."""
    if len(points) <= limit:
        return points
    return points[:: max(1, round(len(points) / limit))]


@dataclass(frozen=True, eq=False)
class IcpResult:
    """The result of an alignment."""

    T_target_source: np.ndarray  # [4, 4]
    fraction_before: float  # fraction of the source with a target within the threshold, at the start
    fraction: float  # the same at the end
    rms_before: float | None  # rms distance of these pairs at the start; None without pairs
    rms: float | None  # the same at the end
    iterations: int


def icp(
    source: np.ndarray,
    target: np.ndarray,
    *,
    threshold: float,
    iterations: int,
    fraction_change: float = 1e-6,
    rms_change: float = math.inf,
) -> IcpResult:
    """Move ``source`` [P, 3] onto ``target`` [Q, 3]: pair with the nearest, fit, repeat (Besl and McKay 1992).

    Pairs farther apart than ``threshold`` do not count. Stops when the share of paired points changes by less than
    ``fraction_change`` and their rms by less than ``rms_change``. The official Tanks and Temples script passes an
    ``rms_change`` of 20, which is always met.
    """
    cloud = Cloud(target)
    T = np.eye(4)
    moved = np.asarray(source, np.float64)
    fraction, rms, index, paired = _paired(cloud, moved, threshold)
    first, done = (fraction, rms), 0
    for done in range(1, iterations + 1):  # noqa: B007
        if paired.sum() < 3:
            break
        step = umeyama(moved[paired], cloud.points[index[paired]])
        T, moved = step @ T, apply(step, moved)
        before = (fraction, rms)
        fraction, rms, index, paired = _paired(cloud, moved, threshold)
        if abs(before[0] - fraction) < fraction_change and abs(before[1] - rms) < rms_change:
            break
    return IcpResult(T, first[0], fraction, first[1] if first[0] else None, rms if fraction else None, done)


def _paired(cloud: Cloud, points: np.ndarray, threshold: float) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Return share and rms of points with a neighbour within the threshold, the neighbours [P], and a mask [P]."""
    if not len(points):
        return 0.0, 0.0, np.zeros(0, np.int64), np.zeros(0, bool)
    distances, index = (column[:, 0] for column in cloud.nearest(points, limit=threshold))
    paired = np.isfinite(distances)
    rms = float(np.sqrt(np.square(distances[paired]).mean())) if paired.any() else 0.0
    return float(paired.mean()), rms, index, paired


# -- camera centres ----------------------------------------------------------------------------------------------------
_BATCH = 256  # samples fitted at a time
CONFIDENCE = 0.9999  # that a sample of inliers only was tried


def rotation_degrees(T: np.ndarray) -> float:
    """Return the rotation angle of a similarity [4, 4], degrees."""
    cosine = (np.trace(T[:3, :3]) / similarity_scale(T) - 1) / 2
    return math.degrees(math.acos(min(1.0, max(-1.0, float(cosine)))))


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A similarity that most pairs agree with."""

    T_target_source: np.ndarray  # [4, 4]
    inliers: np.ndarray  # [P] bool: pairs closer than the threshold
    rms: float  # rms distance of the inliers, target units
    worst: float  # largest of these distances

    @property
    def fraction(self) -> float:
        """Fraction of inliers."""
        return float(self.inliers.mean())


def ransac_similarity(
    source: np.ndarray,
    target: np.ndarray,
    *,
    threshold: float,
    sample: int = 6,
    iterations: int = 10_000,
    seed: int = 0,
) -> RobustFit:
    """Find the similarity with most pairs within ``threshold`` by random sampling (Fischler and Bolles 1981).

    ``source`` and ``target`` [P, 3] are corresponding points, such as the camera centres of two reconstructions; the
    threshold is in target units. A sample has ``sample`` pairs, if there are as many. The best sample is refined on its
    inliers until they no longer change. Stops early when a better sample is less likely than 1 - CONFIDENCE. Raises
    DataError if there are fewer than three pairs, all are on one line, or no three agree.
    """
    check_shapes({"source": (source, "P 3"), "target": (target, "P 3")})
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    count = len(source)
    whole = umeyama(source, target)  # raises if no alignment is possible
    best = _pair_distances(whole, source, target) < threshold
    sample = min(sample, count)
    rng = np.random.default_rng(seed)
    tried = 0
    while tried < min(iterations, _needed(best.mean(), sample)):
        rows = np.argsort(rng.random((_BATCH, count)), axis=1)[:, :sample]
        T, determined = umeyama_batch(source[rows], target[rows])
        moved = np.einsum("bij,nj->bni", T[:, :3, :3], source) + T[:, None, :3, 3]
        inside = (np.linalg.norm(moved - target, axis=2) < threshold) & determined[:, None]
        counts = inside.sum(axis=1)
        if counts.max() > best.sum():
            best = inside[int(counts.argmax())]
        tried += _BATCH
    if best.sum() < 3:
        raise DataError(
            f"only {int(best.sum())} of {count} corresponding points agree within {threshold:g}; are both lists of the "
            "same images, in the same order?"
        )
    return _refined(source, target, best, threshold)


def _refined(source: np.ndarray, target: np.ndarray, inliers: np.ndarray, threshold: float) -> RobustFit:
    """Fit to the inliers and update them, until they no longer change."""
    T = umeyama(source[inliers], target[inliers])
    for _ in range(20):
        again = _pair_distances(T, source, target) < threshold
        if again.sum() < 3 or (again == inliers).all():
            break
        inliers = again
        T = umeyama(source[inliers], target[inliers])
    distances = _pair_distances(T, source, target)[inliers]
    return RobustFit(T, inliers, float(np.sqrt(np.square(distances).mean())), float(distances.max()))


def _pair_distances(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(apply(T, source) - target, axis=1))


def _needed(fraction: float, sample: int) -> float:
    """Return the number of samples that contain one of inliers only, with the confidence."""
    good = float(fraction) ** sample
    return math.inf if good <= 0 else 0 if good >= 1 else math.log(1 - CONFIDENCE) / math.log1p(-good)
