"""The losses on known depths and normals of training views, with their data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gs2d.config.loss_registry import register_loss
from gs2d.config.recipe import DepthPrior, NormalPrior, Recipe
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.losses.base import SETTINGS, Loss, LossView
from gs2d.losses.prior_formulas import Depths, NormalTarget, depth_prior, normal_prior
from gs2d.losses.priors import Priors
from gs2d.render.types import RenderOutput


class _PriorLoss(Loss):
    """A loss on depths or normals of the capture, whose settings are a field of the recipe."""

    settings: str
    _priors: Priors
    _prior: DepthPrior | NormalPrior

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Plan how the depths or normals are read; raise DataError if the capture has none of the requested kind."""
        self._prior = getattr(recipe, self.settings)
        others: dict[str, Any] = {name: None for name in SETTINGS if name != self.settings}
        self._priors = Priors(scene, replace(recipe, **others), device=device)

    def targets(self, output: RenderOutput, view: LossView) -> tuple[Depths | None, NormalTarget | None]:
        """Return the known depths and normals of a view."""
        if view.index is None:
            raise RecipeError("losses on known depths and normals need the index of the training view, got none")
        return self._priors.at(view.index, output.color.dtype)


@register_loss("depth_prior")
class DepthPriorLoss(_PriorLoss):
    """Relative error of known depths (docs/math.md, "Priors")."""

    settings = "depth_prior"

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view without known depths."""
        target = self.targets(output, view)[0]
        if target is None:
            return None
        loss = depth_prior(target, output.depth(view.depth_kind), output.alpha, view.mask)
        return self._prior.weight_at(view.run_iteration) * loss


@register_loss("normal_prior")
class NormalPriorLoss(_PriorLoss):
    """1 - cosine of rendered and known normals (docs/math.md, "Priors")."""

    settings = "normal_prior"

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view without known normals."""
        target = self.targets(output, view)[1]
        if target is None:
            return None
        return self._prior.weight_at(view.run_iteration) * normal_prior(target, output.normal, output.alpha, view.mask)
