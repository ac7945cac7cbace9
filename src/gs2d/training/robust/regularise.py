"""What robust training changes in single iterations: splats are dropped out, and backgrounds change.

Dropout of splats reduces overfitting with few images. Changing backgrounds make the renderings of opaque images opaque:
over a constant background, a hole of its colour has no loss, and decaying opacity makes many holes; over changing ones
it has the wrong colour in most iterations. Training begins over one background, so that floaters can fade while splats
are removed (docs/notebook/floaters.md).
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from torch import Tensor

from gs2d.config.recipe import FEW_VIEWS, Recipe, Stage
from gs2d.core.splats import Splats

NOT_DRAWN = -30.0  # logit of an opacity far below ``alpha_min``
DRAW = 0xD  # distinguishes these random numbers from others of the same seed and iteration
FROM = 0.8  # fraction of a stage before backgrounds change: earlier, floaters fill the holes
# A few colours, so that a GPU keeps its arguments, with the standard deviation of random ones (0.3 in each channel).
# Black and white, which vary more, cost 0.5 to 0.9 dB.
BACKGROUNDS = tuple((r, g, b) for r, g, b in product((0.2, 0.8), repeat=3))


def dropout_rate(recipe: Recipe, stage: Stage, views: int) -> float:
    """Return the fraction of the splats that an iteration of a stage leaves out, for a number of training views.

    0 in stages that do not train the geometry and opacity of all splats.
    """
    return recipe.removal.dropout if recipe.removal is not None and _trains_shape(stage) and views <= FEW_VIEWS else 0.0


def rendered_splats(recipe: Recipe, stage: int, iteration: int, count: int, rate: float) -> Tensor:
    """Return which of ``count`` splats an iteration (from 1) of a stage renders, [N] bool in host memory.

    The result depends only on the arguments, so that repeated iterations and all processes agree.
    """
    generator = np.random.default_rng([recipe.seed, stage, iteration, DRAW])
    return torch.from_numpy(generator.random(count, dtype=np.float32) >= rate)


def dropped_out(splats: Splats, rendered: Tensor) -> Splats:
    """Return the splats [N], of which only ``rendered`` [N] bool are drawn and have gradients.

    Their opacity does not change: compensation gave worse results (docs/notebook/floaters.md).
    """
    logits = splats.opacity_logits
    logits = torch.where(rendered.to(logits.device), logits, logits.new_full((), NOT_DRAWN))
    return Splats(**{**dict(splats.items()), "opacity_logits": logits})


def is_opaque(recipe: Recipe) -> bool:
    """Return whether a recipe treats images without an alpha channel as opaque.

    Robust training does, except in front of an unlit backdrop.
    """
    return recipe.removal is not None and not recipe.removal.backdrop


def another_background(recipe: Recipe, stage: Stage, iteration: int) -> tuple[float, float, float] | None:
    """Return the background of an opaque image at an iteration (1-based) of a stage; None: the protocol's."""
    if not is_opaque(recipe) or not _trains_shape(stage) or iteration <= FROM * stage.iterations:
        return None
    return BACKGROUNDS[iteration % len(BACKGROUNDS)]


def _trains_shape(stage: Stage) -> bool:
    """Return whether a stage trains the geometry and opacity of all splats."""
    return stage.moves_all and stage.train.get("opacity_logits") == "all"
