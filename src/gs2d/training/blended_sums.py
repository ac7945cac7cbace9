"""How much of a view's error each splat is drawn on."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.training.objective import ViewResidual


def blended_sums(splats: Splats, found: ViewResidual, backend: Backend) -> tuple[Tensor, Tensor]:
    """Return two sums over the pixels of a view, [N] each: of a splat's blending weight times the error, and of it.

    They are derivatives, by the splat's red and green, of a picture's red times the error plus its green.
    """
    drawn = splats if found.frozen is None else splats.followed_by(found.frozen)
    parts = {name: tensor.detach() for name, tensor in drawn.items()}
    grey = torch.zeros_like(parts["sh0"]).requires_grad_()  # no channel is clipped, none depends on the direction
    bare = replace(found.settings, sh_degree=0, with_distortion=False)
    with torch.enable_grad():
        color = rasterize(Splats(**{**parts, "sh0": grey}), found.camera, bare, backend=backend).color
        wanted = (color[..., 0] * found.error + color[..., 1]).sum()
        (sums,) = torch.autograd.grad(wanted, grey)
    own = sums[: len(splats)]
    return own[:, 0, 0] / C0, own[:, 0, 1] / C0
