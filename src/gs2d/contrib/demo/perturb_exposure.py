"""Random exposure gains, for captures with known exposure."""

from __future__ import annotations

import numpy as np

GAINS = "exposure_gt.json"  # view name -> gains of red, green and blue
GAIN, BALANCE = 1.35, 1.08  # largest gain and largest ratio between channels; their inverses are the smallest


def random_gains(count: int, seed: int, *, gain: float = GAIN, balance: float = BALANCE) -> np.ndarray:
    """Return gains of the three channels of ``count`` images [count, 3]; the mean of each channel is 1.

    The logarithms of gain and balance are uniform. Gains apply to sRGB values, which is exact for a power-law camera
    response.
    """
    rng = np.random.default_rng([seed, 2])
    logs = np.log(gain) * rng.uniform(-1, 1, (count, 1)) + np.log(balance) * rng.uniform(-1, 1, (count, 3))
    gains = np.exp(logs)
    return np.asarray(gains / gains.mean(axis=0))


def with_gains(image: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Multiply an image uint8 [H, W, 3 or 4] by gains [3], clipped at 255; alpha is unchanged."""
    changed = image.copy()
    changed[..., :3] = np.rint(np.minimum(image[..., :3] * gains, 255))
    return changed
