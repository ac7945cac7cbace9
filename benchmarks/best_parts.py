"""Ablate the recipe ``best``: variants that leave out one part or add one.

::

    python -m benchmarks.time_to_quality demo ../shared/data/nerf_synthetic_lego:2 --scales 0.1
        --recipes best $(python -m benchmarks.best_parts)

As a program, the module prints the variants in the form that ``gs2d train --recipe`` accepts
(``benchmarks/best_parts.py:median``). Results are in docs/notebook/best.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from gs2d.config.presets import SH_FASTER, SILHOUETTE, SQUARES, SQUARES_START, best, get_recipe
from gs2d.config.recipe import GradDensify, LearningRates, LossTerm, Recipe, Stage


def _stage(change: Callable[[Stage], Stage]) -> Recipe:
    recipe = best()
    return replace(recipe, stages=(change(recipe.stages[0]),))


def _densify(**changes: Any) -> Recipe:
    def changed(stage: Stage) -> Stage:
        assert isinstance(stage.densify, GradDensify)
        return replace(stage, densify=replace(stage.densify, **changes))

    return _stage(changed)


def _rates(stage: Stage) -> Stage:
    """Use the official learning rates, independent of the schedule length."""
    return replace(stage, lr=LearningRates(means_decay_steps=stage.iterations))


def _term(kind: str, **changes: Any) -> Recipe:
    """Replace the settings of a loss."""

    def changed(stage: Stage) -> Stage:
        return replace(stage, losses=tuple(replace(t, **changes) if t.kind == kind else t for t in stage.losses))

    return _stage(changed)


def _without(kind: str) -> Recipe:
    return _stage(lambda stage: replace(stage, losses=tuple(t for t in stage.losses if t.kind != kind)))


def _sh_as_2dgs(stage: Stage) -> Stage:
    return replace(stage, lr=replace(stage.lr, shN=stage.lr.shN / SH_FASTER))


def _without_start() -> Recipe:
    """Use the official initialisation from random or sparse points, with opacity resets."""
    changed = _densify(reset_every=3_000)
    return replace(changed, dense_start=None)


def _squares_in_2dgs() -> Recipe:
    recipe = get_recipe("2dgs")
    stage = recipe.stages[0]
    term = LossTerm("l2", SQUARES, round(SQUARES_START * stage.iterations))
    return replace(recipe, stages=(replace(stage, losses=(*stage.losses, term)),))


def _unfitted() -> Recipe:
    recipe = best()
    assert recipe.dense_start is not None
    return replace(recipe, dense_start=replace(recipe.dense_start, fit=None))


VARIANTS: dict[str, Recipe] = {
    # One part left out.
    "no_dense_start": _without_start(),
    "start_not_fitted": _unfitted(),
    "official_rates": _stage(_rates),
    "sh_as_2dgs": _stage(_sh_as_2dgs),
    "with_resets": _densify(reset_every=3_000, scale_cull_start=0),
    "normals_of_the_image": _term("normal_consistency", options={"where": "image"}),
    "no_normals": _term("normal_consistency", weight=0.0),
    "normals_as_2dgs": _term("normal_consistency", weight=0.05),
    "no_silhouette": _without("silhouette"),
    "no_squares": _without("l2"),
    "median": replace(best(), fused_depth="median"),
    # Parts that were tried and are not in the recipe.
    "squares_twice": _term("l2", weight=2 * SQUARES),
    "squares_always": _term("l2", start=0),
    "silhouette_thrice": _term("silhouette", weight=3 * SILHOUETTE),
    "short_memory": _stage(lambda stage: replace(stage, lr=replace(stage.lr, beta2=0.99))),
    "size_cull": _densify(scale_cull_start=0),
    "normals_of_transmittance": _term("normal_consistency", depth="transmittance"),
    "squares_in_2dgs": _squares_in_2dgs(),
}
globals().update({name: replace(recipe, name=name.replace("_", "-")) for name, recipe in VARIANTS.items()})


if __name__ == "__main__":
    print(*(f"{Path(__file__).relative_to(Path.cwd())}:{name}" for name in VARIANTS))
