"""Splats for file format tests, and the angle between rotations."""

from __future__ import annotations

import numpy as np
import torch

from gs2d.core.splats import Splats
from gs2d.io.gaussians import unit_quats


def a_scene(n: int = 700, degree: int = 3, seed: int = 1) -> Splats:
    """Return splats like those of training: small discs in a box of 4 units."""
    g = torch.Generator().manual_seed(seed)
    k = (degree + 1) ** 2 - 1
    return Splats(
        means=torch.rand((n, 3), generator=g) * 4 - 1,
        quats=torch.randn((n, 4), generator=g),
        log_scales=torch.randn((n, 2), generator=g) * 0.7 - 4.5,
        opacity_logits=torch.randn((n,), generator=g) * 3,
        sh0=torch.randn((n, 1, 3), generator=g) * 0.8,
        shN=torch.randn((n, k, 3), generator=g).clamp(-3, 3) * 0.2,
    )


def turned_by(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle between rotations in degrees."""
    dot = np.abs((unit_quats(a) * unit_quats(b)).sum(axis=1))
    return np.degrees(2 * np.arccos(np.clip(dot, 0, 1)))
