"""Seeded weights for LPIPS's networks, under the keys of the published files."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.evaluation.lpips import BLOCKS, WIDTHS


def vgg_state(seed: int = 0) -> dict[str, Tensor]:
    """Return random weights under the keys of torchvision's VGG-16, scaled to keep small layers active."""
    g = torch.Generator().manual_seed(seed)
    state, width_in = {}, 3
    for layers, width in zip(BLOCKS, WIDTHS, strict=True):
        for i in layers:
            scale = (2 / (9 * width_in)) ** 0.5
            state[f"features.{i}.weight"] = scale * torch.randn(width, width_in, 3, 3, generator=g)
            state[f"features.{i}.bias"] = 0.1 * torch.randn(width, generator=g)
            width_in = width
    return state


def head_state(seed: int = 1) -> dict[str, Tensor]:
    """Return random non-negative heads under the keys of the lpips package."""
    g = torch.Generator().manual_seed(seed)
    return {f"lin{b}.model.1.weight": torch.rand(1, width, 1, 1, generator=g) for b, width in enumerate(WIDTHS)}
