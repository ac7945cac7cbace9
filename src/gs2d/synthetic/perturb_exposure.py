"""Photographs as by a camera on automatic: gains of their own, for captures whose exposures are known."""

from __future__ import annotations

import numpy as np

GAINS = "exposure_gt.json"  # view name -> gains of red, green and blue
GAIN, BALANCE = 1.35, 1.08  # largest gain (its inverse is the smallest), and what a channel has more or less than that


def random_gains(count: int, seed: int, *, gain: float = GAIN, balance: float = BALANCE) -> np.ndarray:
    """Gains of the three channels of ``count`` photographs [count, 3]; the mean of each channel is 1.

    log gain is uniform within ``gain``, log balance within ``balance``. A photograph's values are sRGB: where the curve
    of a camera is a power of the light, a longer exposure is a gain there too.
    """
    rng = np.random.default_rng([seed, 2])
    logs = np.log(gain) * rng.uniform(-1, 1, (count, 1)) + np.log(balance) * rng.uniform(-1, 1, (count, 3))
    gains = np.exp(logs)
    return np.asarray(gains / gains.mean(axis=0))


def with_gains(image: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return a picture uint8 [H, W, 3 or 4] times the gains [3] of its channels, clipped at 255; alpha stays."""
    changed = image.copy()
    changed[..., :3] = np.rint(np.minimum(image[..., :3] * gains, 255))
    return changed
