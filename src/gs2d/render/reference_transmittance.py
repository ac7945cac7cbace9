"""Depth by transmittance (rule 22; docs/math.md, "Depth by transmittance"): search and gradient."""

from __future__ import annotations

import torch
from torch import Tensor

STEPS = 64  # of bisection: as exact as a double
MIN_SLOPE = 0.05  # of alpha per half width; bounds the gradient of pixels between two surfaces


def fraction_before(x: Tensor) -> Tensor:
    """Return F(x), the fraction of a splat's opacity up to ``x`` half widths behind its depth.

    The integral of the Epanechnikov kernel: 0 up to -1, 1 from 1 on, with a continuous slope.
    """
    x = x.clamp(-1, 1)
    return (2 + x * (3 - x * x)) / 4


def transmittance_at(z: Tensor, alpha: Tensor, inverse_depth: Tensor, width: float) -> Tensor:
    """Return T(z) = prod (1 - alpha_i F((z / z_i - 1) / width)) [P] at depths z [P], world units.

    ``alpha`` [n, P] is 0 for pairs that are not blended; ``inverse_depth`` is [n, P]. ``width`` is half the width of
    the interval as a fraction of the depth.
    """
    return (1 - alpha * fraction_before((z * inverse_depth - 1) / width)).prod(dim=0)


def depth_at_half(alpha: Tensor, inverse_depth: Tensor, total: Tensor, width: float) -> Tensor:
    """Return the depth [P] at which T has fallen by half of ``total``; 0 where nothing was blended.

    Bisection gives the value. The gradient is that of the implicit function, -(dT - dlevel) / (dT/dz), from one Newton
    step that does not change the value.
    """
    hit = total.detach() > 0
    with torch.no_grad():
        level = 1 - total / 2
        far = torch.where(alpha > 0, 1 / inverse_depth, 0.0).amax(dim=0) * (1 + width)
        near = torch.where(alpha > 0, 1 / inverse_depth, torch.inf).amin(dim=0) * (1 - width)
        near, far = torch.where(hit, near, 0.0), torch.where(hit, far, 1.0)
        for _ in range(STEPS):
            middle = (near + far) / 2
            behind = transmittance_at(middle, alpha, inverse_depth, width) <= level
            near, far = torch.where(behind, near, middle), torch.where(behind, middle, far)
        z = far
        x = ((z * inverse_depth - 1) / width).clamp(-1, 1)
        density = alpha * 0.75 * (1 - x * x) * inverse_depth / width / (1 - alpha * fraction_before(x))
        slope = transmittance_at(z, alpha, inverse_depth, width) * density.sum(dim=0)  # -dT/dz
        least = MIN_SLOPE * total / (width * z)
        slope = torch.where(hit, torch.maximum(slope, least), 1.0)
    change = transmittance_at(z, alpha, inverse_depth, width) - (1 - total / 2)
    return torch.where(hit, z + (change - change.detach()) / slope, 0.0)
