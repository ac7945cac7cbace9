"""Densification by the error of several views: who is drawn where pictures are wrong grows first (an idea of FastGS).

Screen gradients say that a splat wants to move, not whether the picture is wrong there. So at each densification some
training views are rendered, and each splat is asked how much of their residuals it is drawn on: the sum over pixels of
its blending weight times the residual, per view that shows it. What one view alone finds wrong (a highlight, a passer
by) counts little beside what all of them do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gs2d.config.densify import register_densifier
from gs2d.config.recipe import GradDensify
from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.training.densify.densifier import Surroundings
from gs2d.training.densify.gradient import GradientDensifier
from gs2d.training.objective import ViewResidual
from gs2d.training.state import TrainState

VIEWS = 10  # where a recipe names the densifier and not their number


@register_densifier("multi-view-error")
class MultiViewErrorDensifier(GradientDensifier):
    """Screen gradients are multiplied by a power of the error that a splat is drawn on, in units of the median.

    Parameters
    ----------
    surroundings : Surroundings
    densify : GradDensify, optional
    **options
        Fields of GradDensify, instead; ``error_views`` is 10 where it is not given.
    """

    absolute = None  # as the options say
    splits_rows = False  # it renders views by itself

    def __init__(self, surroundings: Surroundings, densify: GradDensify | None = None, **options: Any) -> None:
        super().__init__(surroundings, densify, **options)
        self._options = replace(self._options, error_views=self._options.error_views or VIEWS)

    def urgency(self, state: TrainState, iteration: int) -> Tensor:
        """Return (error / median error) ** ``error_power`` of each splat [N]; 0 where none of the views shows it."""
        around, options = self.surroundings, self._options
        views = torch.randperm(len(around.scene.train), generator=state.generator)[: options.error_views].tolist()
        error, seen = torch.zeros(2, len(state.splats), dtype=state.splats.dtype, device=state.splats.device)
        for index in around.processes.part(views):
            found = around.compare(state, iteration, index)
            weighted, weights = blended_sums(state.splats, found, around.backend)
            error, seen = error + weighted, seen + (weights > 0)
        error, seen = around.processes.sum(error), around.processes.sum(seen)
        error = error / seen.clamp(min=1)
        positive = error[error > 0]
        return (error / positive.median()) ** options.error_power if len(positive) else torch.ones_like(error)


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
