"""The losses on known depths and normals of training views, with their data."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gs2d.config.loss_registry import register_loss
from gs2d.config.prior_settings import DepthPrior, NormalPrior
from gs2d.config.recipe import Recipe
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.losses.base import Loss, LossView
from gs2d.losses.known_maps import Priors
from gs2d.losses.prior_formulas import depth_prior, normal_prior
from gs2d.render.types import RenderOutput


def _index(view: LossView) -> int:
    if view.index is None:
        raise RecipeError("losses on known depths and normals need the index of the training view, got none")
    return view.index


@register_loss("depth_prior")
class DepthPriorLoss(Loss):
    """Relative error of known depths (docs/math.md, "Priors")."""

    settings = "depth_prior"
    _priors: Priors
    _prior: DepthPrior

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Plan how known depths are read; raise DataError if the capture has none of the requested kind."""
        assert recipe.depth_prior is not None
        self._prior = recipe.depth_prior
        self._priors = Priors(scene, replace(recipe, normal_prior=None), device=device)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view without known depths."""
        known = self._priors.at(_index(view), output.color.dtype)[0]
        if known is None:
            return None
        loss = depth_prior(known, output.depth(view.depth_kind), output.alpha, view.mask)
        return self._prior.weight_at(view.run_iteration) * loss


@register_loss("normal_prior")
class NormalPriorLoss(Loss):
    """1 - cosine of rendered and known normals (docs/math.md, "Priors")."""

    settings = "normal_prior"
    _priors: Priors
    _prior: NormalPrior

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Plan how known normals are read; raise DataError if the capture has none."""
        assert recipe.normal_prior is not None
        self._prior = recipe.normal_prior
        self._priors = Priors(scene, replace(recipe, depth_prior=None), device=device)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view without known normals."""
        known = self._priors.at(_index(view), output.color.dtype)[1]
        if known is None:
            return None
        return self._prior.weight_at(view.run_iteration) * normal_prior(known, output.normal, output.alpha, view.mask)
