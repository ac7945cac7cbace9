"""Linear light as what a display shows: sRGB values of 8 bits."""

from __future__ import annotations

import numpy as np


def display_values(light: np.ndarray, alpha: np.ndarray | None, *, associated: bool) -> np.ndarray:
    """Return linear light [H, W, 3] as sRGB values: uint8 [H, W, 3], or [H, W, 4] with straight alpha.

    1 is white: what is brighter is clipped, what is below 0 or no number is black.

    Parameters
    ----------
    alpha : ndarray [H, W] or None
    associated : bool
        The colours are multiplied by alpha.
    """
    light = np.nan_to_num(light, nan=0.0, posinf=1.0, neginf=0.0)
    if alpha is None:
        return _to_bytes(encode_srgb(light))
    alpha = np.clip(np.nan_to_num(alpha, nan=0.0), 0.0, 1.0)[..., None]
    straight = np.divide(light, alpha, out=np.zeros_like(light), where=alpha > 0) if associated else light
    return _to_bytes(np.concatenate([encode_srgb(straight), alpha], axis=-1))


def encode_srgb(light: np.ndarray) -> np.ndarray:
    """Return the display values in [0, 1] of linear light, clipped to [0, 1] (IEC 61966-2-1)."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(255 * values).astype(np.uint8))
