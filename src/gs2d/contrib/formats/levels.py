"""Levels of detail: halve the number of splats repeatedly by merging pairs of neighbours.

Each level is computed from the previous one. The pairs with the least visible change are merged, each into a disk with
the mass-weighted centre, covariance and mean colour of both, which covers as much as both blended; if that would need
more than full opacity, the disk is larger. The cost of a pair is weighted by its mass (opacity times area). Small and
faint splats are therefore merged first, and pairs that differ in colour, position and orientation last.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gs2d.io.gaussians import Gaussians, logit, sigmoid, unit_quats, with_thickness

_NEIGHBOURS = 10
_COLOR = 100.0  # weight of a squared colour difference (in [0, 1]) relative to the logarithm of a volume
_THICK = 0.01  # thickness of disks in logarithms of volumes, as a fraction of the mean squared scale
_OPAQUE = 0.999
_PASSES = 12  # limit on passes that merge disjoint pairs


def halved(g: Gaussians, cells: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Return half as many disks [M] with a similar appearance from a distance, and their cells [M].

    Only splats with the same number in ``cells`` [N] are merged, so that each cell can be shown at its own level. M is
    more than half of N if splats have no neighbours in their cells. The third scale of disks is ignored.
    """
    target = (len(g) + 1) // 2
    for _ in range(_PASSES):
        spare = len(g) - target
        pairs = _cheapest(g, cells, spare) if spare > 0 else np.zeros((0, 2), int)
        if not len(pairs):
            break
        alone = np.ones(len(g), bool)
        alone[pairs] = False
        merged = _merged(g, pairs)
        cells = np.concatenate([cells[alone], cells[pairs[:, 0]]])
        g = Gaussians.joined([g.rows(alone), merged])
    return g, cells


def _mass(g: Gaussians) -> np.ndarray:
    return np.asarray(sigmoid(g.opacity_logits) * np.exp(g.log_scales[:, :2].sum(axis=1, dtype=np.float64)))


def _covariances(g: Gaussians) -> np.ndarray:
    """Return covariances [N, 3, 3] float64."""
    axes = Rotation.from_quat(unit_quats(g.quats)[:, [1, 2, 3, 0]]).as_matrix()[:, :, :2]
    axes *= np.exp(g.log_scales[:, None, :2].astype(np.float64))
    return np.asarray(axes @ axes.transpose(0, 2, 1))


def _log_volume(covariance: np.ndarray) -> np.ndarray:
    thick = _THICK / 2 * np.trace(covariance, axis1=1, axis2=2)
    return np.asarray(np.linalg.slogdet(covariance + thick[:, None, None] * np.eye(3))[1])


def _joint(mass: np.ndarray, means: np.ndarray, covariance: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the mass fraction of the first splat, and the joint mean and covariance, of pairs."""
    i, j = pairs.T
    first = mass[i] / np.maximum(mass[i] + mass[j], 1e-300)
    apart = means[j] - means[i]
    mean = means[i] + (1 - first)[:, None] * apart
    spread = (first * (1 - first))[:, None, None] * apart[:, :, None] * apart[:, None, :]
    shared = first[:, None, None] * covariance[i] + (1 - first)[:, None, None] * covariance[j] + spread
    return first, mean, shared


def _cheapest(g: Gaussians, cells: np.ndarray, most: int) -> np.ndarray:
    """Return at most ``most`` disjoint pairs [P, 2] of near splats, by increasing cost."""
    k = min(_NEIGHBOURS + 1, len(g))
    near = cKDTree(g.means).query(g.means, k=k, workers=-1)[1].reshape(-1)
    own = np.repeat(np.arange(len(g)), k)
    key = np.unique(np.minimum(own, near) * len(g) + np.maximum(own, near))  # distinct pairs
    pairs = np.stack([key // len(g), key % len(g)], axis=1)
    pairs = pairs[(pairs[:, 0] != pairs[:, 1]) & (cells[pairs[:, 0]] == cells[pairs[:, 1]])]
    mass, means, covariance = _mass(g), g.means.astype(np.float64), _covariances(g)
    volume = _log_volume(covariance)
    color = np.concatenate([g.sh0, g.shN.reshape(len(g), -1)], axis=1) / math.sqrt(4 * math.pi)  # over all directions
    cost = np.empty(len(pairs))
    for start in range(0, len(pairs), 1 << 18):
        some = pairs[start : start + (1 << 18)]
        i, j = some.T
        first, _, shared = _joint(mass, means, covariance, some)
        shape = 0.5 * (_log_volume(shared) - first * volume[i] - (1 - first) * volume[j])
        differ = np.square(color[i] - color[j]).sum(axis=1)
        cost[start : start + len(some)] = (mass[i] + mass[j]) * (shape + _COLOR * first * (1 - first) * differ)
    chosen = _matching(pairs, cost, len(g))
    return chosen[:most]


def _matching(pairs: np.ndarray, cost: np.ndarray, count: int) -> np.ndarray:
    """Return the greedy matching: repeatedly the cheapest pair of unmatched splats; by increasing cost."""
    order = np.argsort(cost, kind="stable")
    pairs, matched, parts = pairs[order], np.zeros(count, bool), []
    while len(pairs):
        # A pair that is the cheapest for both of its splats is in the greedy matching.
        best = np.full(count, len(pairs))
        rank = np.arange(len(pairs))
        np.minimum.at(best, pairs[:, 0], rank)
        np.minimum.at(best, pairs[:, 1], rank)
        sure = (best[pairs[:, 0]] == rank) & (best[pairs[:, 1]] == rank)
        parts.append((order[sure], pairs[sure]))
        matched[pairs[sure]] = True
        free = ~(matched[pairs[:, 0]] | matched[pairs[:, 1]])
        pairs, order = pairs[free], order[free]
    if not parts:
        return np.zeros((0, 2), int)
    whole = np.concatenate([some for _, some in parts])
    return whole[np.argsort(cost[np.concatenate([some for some, _ in parts])], kind="stable")]


def _overlap(g: Gaussians, pairs: np.ndarray, mass: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return the mass of pairs that blending removes: the integral of both opacities over a plane [P, 3, 2]."""
    i, j = pairs.T
    covariance = _covariances(g)
    both = plane.transpose(0, 2, 1) @ (covariance[i] + covariance[j]) @ plane
    determinant = np.maximum(both[:, 0, 0] * both[:, 1, 1] - both[:, 0, 1] ** 2, 1e-60)
    x, y = ((g.means[j] - g.means[i]).astype(np.float64)[:, None, :] @ plane)[:, 0].T
    distance = (both[:, 1, 1] * x * x - 2 * both[:, 0, 1] * x * y + both[:, 0, 0] * y * y) / determinant
    # For opacities o exp(-d^2 / 2) with areas 2 pi s_u s_v, in units of 2 pi.
    both_areas = mass[i] * mass[j] * np.exp(-0.5 * distance) / np.sqrt(determinant)
    return np.asarray(np.minimum(both_areas, np.minimum(mass[i], mass[j])))


def _merged(g: Gaussians, pairs: np.ndarray) -> Gaussians:
    """Merge each pair into one disk."""
    i, j = pairs.T
    mass = _mass(g)
    first, mean, shared = _joint(mass, g.means.astype(np.float64), _covariances(g), pairs)
    values, axes = np.linalg.eigh(shared)  # ascending: the normal, then the axes of the disk
    axes = axes[:, :, ::-1].copy()
    axes[:, :, 2] = np.cross(axes[:, :, 0], axes[:, :, 1])
    scales = np.sqrt(np.maximum(values[:, :0:-1], 1e-36))
    covered = mass[i] + mass[j] - _overlap(g, pairs, mass, axes[:, :, :2])
    opacity = covered / scales.prod(axis=1)
    scales *= np.sqrt(np.maximum(opacity / _OPAQUE, 1.0))[:, None]  # larger if opacity would exceed 1
    opacity = np.minimum(opacity, _OPAQUE)
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    share = first.astype(np.float32)[:, None]
    return Gaussians(
        mean.astype(np.float32),
        quats.astype(np.float32),
        with_thickness(np.log(scales)),
        logit(opacity.astype(np.float32)),
        share * g.sh0[i] + (1 - share) * g.sh0[j],
        share[:, :, None] * g.shN[i] + (1 - share[:, :, None]) * g.shN[j],
    )
