"""Photographs are opaque, so what training renders becomes opaque: its background changes from iteration to iteration.

Over one background, a hole in its colour costs nothing, and opacity that decays leaves many. Over another background
each time, a hole has the wrong colour in every iteration. Training begins over one background: what only a single image
shows should fade while splats are removed (docs/notebook/floaters.md).
"""

from __future__ import annotations

from itertools import product

from gs2d.config.recipe import Recipe, Stage

FROM = 0.8  # of a stage: earlier, fog fills the holes (docs/notebook/floaters.md)
# Few, so that a GPU keeps its arguments. About as varied as random colours (standard deviation 0.3 in each channel):
# black and white, which vary more, cost 0.5 to 0.9 dB beside those.
BACKGROUNDS = tuple((r, g, b) for r, g, b in product((0.2, 0.8), repeat=3))


def is_opaque(recipe: Recipe) -> bool:
    """Whether a recipe takes photographs without an alpha channel to be opaque.

    Robust training does, but before an unlit backdrop, where nothing is behind the subject.
    """
    return recipe.removal is not None and not recipe.removal.backdrop


def another_background(recipe: Recipe, stage: Stage, iteration: int) -> tuple[float, float, float] | None:
    """Return the background of an opaque photograph at an iteration (1-based) of a stage; None: the protocol's."""
    trains = stage.moves_all and stage.train.get("opacity_logits") == "all"
    if not is_opaque(recipe) or not trains or iteration <= FROM * stage.iterations:
        return None
    return BACKGROUNDS[iteration % len(BACKGROUNDS)]
