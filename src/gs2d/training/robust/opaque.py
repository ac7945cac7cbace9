"""Changing backgrounds, which make the renderings of opaque images opaque.

Over a constant background, a hole of its colour has no loss, and decaying opacity makes many holes. Over changing
backgrounds, a hole has the wrong colour in most iterations. Training begins over one background, so that floaters can
fade while splats are removed (docs/notebook/floaters.md).
"""

from __future__ import annotations

from itertools import product

from gs2d.config.recipe import Recipe, Stage

FROM = 0.8  # fraction of a stage before backgrounds change: earlier, floaters fill the holes
# A few colours, so that a GPU keeps its arguments, with the standard deviation of random ones (0.3 in each channel).
# Black and white, which vary more, cost 0.5 to 0.9 dB.
BACKGROUNDS = tuple((r, g, b) for r, g, b in product((0.2, 0.8), repeat=3))


def is_opaque(recipe: Recipe) -> bool:
    """Return whether a recipe treats images without an alpha channel as opaque.

    Robust training does, except in front of an unlit backdrop.
    """
    return recipe.removal is not None and not recipe.removal.backdrop


def another_background(recipe: Recipe, stage: Stage, iteration: int) -> tuple[float, float, float] | None:
    """Return the background of an opaque image at an iteration (1-based) of a stage; None: the protocol's."""
    trains = stage.moves_all and stage.train.get("opacity_logits") == "all"
    if not is_opaque(recipe) or not trains or iteration <= FROM * stage.iterations:
        return None
    return BACKGROUNDS[iteration % len(BACKGROUNDS)]
