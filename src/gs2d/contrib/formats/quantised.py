"""Order and rounded values of splats in compact files."""

from __future__ import annotations

import numpy as np

from gs2d.io.gaussians import NO_SCALE


def morton_order(means: np.ndarray) -> np.ndarray:
    """Return the Morton order of points, in which neighbours in the list are near in space."""
    if not len(means):
        return np.zeros(0, dtype=int)
    if np.abs(means).max() > 1e38:  # the span may exceed float32
        means = means.astype(np.float64)
    low, high = means.min(axis=0), means.max(axis=0)
    cell = ((means - low) / np.maximum(high - low, 1e-30) * ((1 << 21) - 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(21):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def log_scales_of(scales: np.ndarray) -> np.ndarray:
    """Return the logarithms, float32, of scales >= 0; -80 for 0, NaN for NaN."""
    with np.errstate(divide="ignore"):
        return np.maximum(np.log(scales.astype(np.float64)), NO_SCALE).astype(np.float32)


def logit_of_byte(alpha: np.ndarray) -> np.ndarray:
    """Return the logits, float32, of 8-bit opacities; 0 and 255 are moved inside by half a step."""
    o = np.clip(alpha.astype(np.float64) / 255.0, 0.5 / 255.0, 254.5 / 255.0)
    return np.asarray(np.log(o / (1.0 - o))).astype(np.float32)


def to_byte(x: np.ndarray) -> np.ndarray:
    """Round to the nearest integer in 0 to 255."""
    return np.asarray(np.clip(np.floor(x + 0.5), 0, 255)).astype(np.uint8)
