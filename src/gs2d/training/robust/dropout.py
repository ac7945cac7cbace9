"""Dropout of splats, which reduces overfitting with few images."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gs2d.config.recipe import Recipe, Stage
from gs2d.config.robust import FEW_VIEWS
from gs2d.core.splats import Splats

NOT_DRAWN = -30.0  # logit of an opacity far below ``alpha_min``
DRAW = 0xD  # distinguishes these random numbers from others of the same seed and iteration


def dropout_rate(recipe: Recipe, stage: Stage, views: int) -> float:
    """Return the fraction of the splats that an iteration of a stage leaves out, for a number of training views.

    0 in stages that do not train the geometry and opacity of all splats.
    """
    trained = stage.moves_all and stage.train.get("opacity_logits") == "all"
    return recipe.removal.dropout if recipe.removal is not None and trained and views <= FEW_VIEWS else 0.0


def kept_splats(recipe: Recipe, stage: int, iteration: int, count: int, rate: float) -> Tensor:
    """Return which of ``count`` splats an iteration (from 1) of a stage renders, [N] bool in host memory.

    The result depends only on the arguments, so that repeated iterations and all processes agree.
    """
    generator = np.random.default_rng([recipe.seed, stage, iteration, DRAW])
    return torch.from_numpy(generator.random(count, dtype=np.float32) >= rate)


def dropped_out(splats: Splats, kept: Tensor) -> Splats:
    """Return the splats [N], of which only ``kept`` [N] bool are rendered and have gradients.

    The opacity of the kept ones does not change: compensation gave worse results (docs/notebook/floaters.md).
    """
    logits = splats.opacity_logits
    logits = torch.where(kept.to(logits.device), logits, logits.new_full((), NOT_DRAWN))
    return Splats(**{**dict(splats.items()), "opacity_logits": logits})
