"""Trials: the training images decide which of the proposed splats are floaters.

Depth maps, sizes and colours only propose splats for removal, because each of these signs is sometimes wrong: a
reflection on a table has a depth below the table. Each image is rendered with and without all proposed splats, and the
change of its squared error is distributed over them by their blending weights. A splat stays if more images miss it
than speak against it. A floater that overfits one image is missed by that image alone, and is removed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training.robust.regularise import dropped_out

ENOUGH = 2  # images that keep a splat if they miss it, however many speak against it: wrong depths are correlated


@dataclass(frozen=True, eq=False)
class Witness:
    """A downscaled training image of a trial."""

    camera: Camera
    color: Tensor  # [H, W, 3] in [0, 1]
    usable: Tensor  # [H, W] bool: pixels that count
    shown: Callable[[Tensor], Tensor] = lambda color: color  # colours of a rendering as this image shows them


def missed(
    splats: Splats,
    against: Tensor,
    witnesses: Iterable[Witness],
    raster: RasterSettings,
    backend: Backend,
    *,
    stands_for: float = 1.0,
) -> Tensor:
    """Return which of the proposed splats the training images miss, [N] bool.

    The number of images that miss a splat is the sum of their losses divided by the largest. Ten equal losses count as
    ten images; one large loss among small ones counts as little more than one. ``splats``: N splats. ``against`` [N]
    int: number of images that speak against each splat, of which ``ENOUGH`` count; 0: it is not proposed. ``raster``:
    rasterizer settings of training. ``stands_for``: training images for each witness.
    """
    proposed = against > 0
    parts = {name: tensor.detach() for name, tensor in splats.items()}
    sh0 = parts["sh0"].clone().requires_grad_()
    whole, without = Splats(**{**parts, "sh0": sh0}), dropped_out(Splats(**parts), ~proposed)
    settings = replace(raster, with_distortion=False)
    total = torch.zeros(len(splats), dtype=sh0.dtype, device=sh0.device)
    largest = torch.zeros_like(total)
    for witness in witnesses:
        with torch.enable_grad():
            color = rasterize(whole, witness.camera, settings, backend=backend).color
        with torch.no_grad():
            bare = rasterize(without, witness.camera, settings, backend=backend).color
            loss = _errors(bare, witness) - _errors(color, witness)
        # The derivative with respect to the colour of a splat is the loss summed over pixels by its blending weights.
        (shared,) = torch.autograd.grad(color, sh0, (loss / 3)[..., None].expand_as(color))
        miss = shared.sum(dim=(1, 2)) / C0
        total += miss
        largest = torch.maximum(largest, miss)
    return proposed & (total > largest) & (total * stands_for > against.clamp_max(ENOUGH) * largest)


def _errors(color: Tensor, witness: Witness) -> Tensor:
    """Return squared errors [H, W] of a rendering, 0 at unusable pixels."""
    return (witness.shown(color) - witness.color).square().sum(dim=2) * witness.usable
