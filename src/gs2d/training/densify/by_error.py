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
from gs2d.training.densify.densifier import Surroundings
from gs2d.training.densify.gradient import GradientDensifier
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

    def __init__(self, surroundings: Surroundings, densify: GradDensify | None = None, **options: Any) -> None:
        super().__init__(surroundings, densify, **options)
        self._options = replace(self._options, error_views=self._options.error_views or VIEWS)

    def urgency(self, state: TrainState, iteration: int) -> Tensor:
        """Return (error / median error) ** ``error_power`` of each splat [N]; 0 where none of the views shows it."""
        around, options = self.surroundings, self._options
        views = torch.randperm(len(around.scene.train), generator=state.generator)[: options.error_views].tolist()
        error, seen = torch.zeros(2, len(state.splats), dtype=state.splats.dtype, device=state.splats.device)
        for index in around.processes.part(views):
            weighted, weights = around.blame(state, iteration, index)
            error, seen = error + weighted, seen + (weights > 0)
        error, seen = around.processes.sum(error), around.processes.sum(seen)
        error = error / seen.clamp(min=1)
        positive = error[error > 0]
        return (error / positive.median()) ** options.error_power if len(positive) else torch.ones_like(error)
