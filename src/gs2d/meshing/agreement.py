"""Estimate exposures, consensus colours and outliers of images from common surface points.

Sample points on the surface are looked up in every image that sees them. Each image gets a gain per channel, each point
the colour that most images agree on, and each pair a weight, which is near 0 if the image shows something else there:
an obstacle, a moving object, a highlight. Images are then corrected by a smooth weight and a smooth colour offset. See
docs/math.md and docs/notebook/meshing.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

VOTE = 255  # largest vote, in the fourth channel of the samples: the image faces the surface; 0: point not visible
MIN_SCALE, MAX_SCALE = 6.0, 16.0  # of 255: bounds of the spread between images that agree
CUT = 2.0  # spreads at which the weight of an image falls to exp(-1/2)
REJECTED, ACCEPTED = 0.35, 0.75  # mean weights at which a neighbourhood is rejected or fully used
LEAST = 1e-3  # weight of a rejected neighbourhood: used only if no other image sees the surface
MAX_GAIN = 4.0
LEVEL_CELLS = 8.0  # standard deviation of the smoothing of colour offsets, cells
_GAIN_POINTS = 20_000
_CHUNK = 1 << 21  # samples per chunk
_WIDE = 6.0  # cells; smoothing that fills gaps between points


def agree(samples: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the consensus of images: colours [P, 3] float32 in [0, 255], and gains [V, 3] float32.

    An image shows gain * consensus. Each of ``samples`` [P, 4] uint8 has the colours of the points in an image and its
    votes, which are replaced in place: afterwards the fourth channel is 0 if the image does not see the point, else the
    inlier weight scaled to 1 to 255.
    """
    count = len(samples[0])
    gains = _gains(np.stack([table[:: -(-count // _GAIN_POINTS)] for table in samples]))
    colors = np.zeros((count, 3), np.float32)
    step = max(1, _CHUNK // len(samples))
    for start in range(0, count, step):
        part = slice(start, start + step)
        table = np.stack([table[part] for table in samples])
        votes = table[..., 3].astype(np.float32)
        colors[part], weights = _consensus(table[..., :3] / gains[:, None], votes)
        scaled = np.where(votes > 0, np.ceil(1 + 254 * weights), 0).astype(np.uint8)
        for k, image in enumerate(samples):
            image[part, 3] = scaled[k]
    return colors, gains


def _gains(table: np.ndarray) -> np.ndarray:
    """Estimate gains [V, 3] with a mean logarithm of 0 from the samples [V, p, 4] that are neither dark nor saturated.

    Minimises sum_vp w_vp (log c_vp - g_v - m_p)^2 over g and m by iteratively reweighted least squares.
    """
    colors = table[..., :3].astype(np.float32)
    clear = (table[..., :3].min(axis=2) > 8) & (table[..., :3].max(axis=2) < 247)
    votes = table[..., 3] * clear / np.float32(VOTE)
    shown = (votes > 0).sum(axis=0) > 1
    votes, logs = votes[:, shown], np.log(np.maximum(colors[:, shown], 1.0))
    gains, count = np.zeros((len(table), 3), np.float32), votes.shape[1]
    if count == 0:
        return np.exp(gains)
    residual = logs - _weighted_median(logs, np.broadcast_to(votes[..., None], logs.shape))
    for _ in range(6):
        distance = np.sqrt((residual**2).mean(axis=2))
        scale = max(1.5 * float(np.median(distance[votes > 0])), 0.03)
        weights = votes / (1 + (distance / (2 * scale)) ** 2) ** 2
        total = np.maximum(weights.sum(axis=0), 1e-6)
        mean = (weights[..., None] * logs).sum(axis=0) / total[:, None]
        system = np.diag(weights.sum(axis=1) + 1e-3) - weights @ (weights / total).T
        right = (weights[..., None] * (logs - mean)).sum(axis=1)
        gains = np.linalg.solve(system.astype(np.float64), right).astype(np.float32)
        gains -= gains.mean(axis=0)
        level = logs - gains[:, None]
        residual = level - (weights[..., None] * level).sum(axis=0) / total[:, None]
    return np.exp(np.clip(gains, -np.log(MAX_GAIN), np.log(MAX_GAIN)))


def _consensus(colors: np.ndarray, votes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return consensus colours [p, 3] of samples [V, p, 3] with votes [V, p], and inlier weights [V, p].

    A redescending estimator (Welsch weights), initialised with the weighted median.
    """
    middle = _weighted_median(colors, np.broadcast_to(votes[..., None], colors.shape))
    distance = np.sqrt(((colors - middle) ** 2).mean(axis=2))
    scale = np.clip(1.5 * _weighted_median(distance, votes), MIN_SCALE, MAX_SCALE)
    for _ in range(4):
        weights = np.exp(-0.5 * (distance / (CUT * scale)) ** 2)
        shares = votes * np.maximum(weights, 1e-6)
        shares /= np.maximum(shares.sum(axis=0), 1e-12)
        middle = (shares[..., None] * colors).sum(axis=0)
        distance = np.sqrt(((colors - middle) ** 2).mean(axis=2))
    return middle, np.exp(-0.5 * (distance / (CUT * scale)) ** 2)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted lower median over the first axis."""
    order = np.argsort(values, axis=0)
    reached = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    first = (reached < 0.5 * reached[-1:]).sum(axis=0, keepdims=True)
    return np.take_along_axis(values, np.take_along_axis(order, np.minimum(first, len(values) - 1), 0), 0)[0]


def corrected(
    image: np.ndarray,
    pixels: np.ndarray,
    samples: np.ndarray,
    colors: np.ndarray,
    gain: np.ndarray,
    cell: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Correct an image [H, W, 3 or 4] uint8 to the consensus colours, and return weights [H, W] of its pixels.

    ``pixels`` [n, 2] px are positions of points in the image, ``samples`` [n, 4] uint8 those of ``agree``, ``colors``
    [n, 3] the consensus, ``gain`` [3]. ``cell`` (px) is the side of the cells in which weights and offsets are
    smoothed.
    """
    height, width = image.shape[:2]
    shape = -(-height // cell), -(-width // cell)
    index = (pixels[:, 1] / cell).astype(np.int64) * shape[1] + (pixels[:, 0] / cell).astype(np.int64)
    weights = (samples[:, 3] - 1.0) / 254
    offsets = (colors - samples[:, :3] / gain) * weights[:, None]

    def cells(values: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(index, values, shape[0] * shape[1]).reshape(shape).astype(np.float32)

    def smooth(values: np.ndarray, sigma: float) -> np.ndarray:
        return np.asarray(gaussian_filter(values, sigma, mode="constant"))

    def enlarged(values: np.ndarray) -> np.ndarray:
        whole = Image.fromarray(values)
        box = (0.0, 0.0, width / cell, height / cell)
        return np.asarray(whole.resize((width, height), Image.Resampling.BILINEAR, box=box))

    number, accepted = cells(), cells(weights)
    near, below = (smooth(values, 1.0) + 1e-3 * smooth(values, _WIDE) for values in (accepted, number))
    usual = np.where(below > 1e-9, near / np.maximum(below, 1e-9), 1.0)
    usable = np.clip((usual - REJECTED) / (ACCEPTED - REJECTED), LEAST, 1).astype(np.float32)
    below = smooth(accepted, LEVEL_CELLS) + np.float32(0.02)
    result = image.copy()
    for channel in range(3):
        offset = smooth(cells(offsets[:, channel]), LEVEL_CELLS) / below
        level = image[..., channel] / gain[channel] + enlarged(offset)
        result[..., channel] = np.rint(np.clip(level, 0, 255))
    return result, enlarged(usable)
