"""Scale the schedule of a recipe to a shorter or longer training.

Scaled: the lengths of stages, the starts of losses, the SH interval, start and stop of densification and of the prune
by size, and the decay of learning rates and of the weights of priors. *Not* scaled: the densification interval, as long
as ten densifications fit, a minimum of iterations without learned quantities, and opacity resets. After a reset, the
opacity of a splat is below the limit of pruning, and it needs dozens of views to recover. Pure Python; never imports
torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from gs2d.config.densify import Densify
from gs2d.config.recipe import DepthPrior, GradDensify, LearningRates, NormalPrior, Recipe, Stage
from gs2d.errors import RecipeError

MIN_DENSIFICATIONS = 10
PRUNE_GRACE = 100  # iterations after a reset in which no splat is pruned by opacity
RESET_MARGIN = 200  # iterations of densification that must follow a reset
MIN_INIT_POINTS = 10_000
LONGER = 0.25  # power of 1 / factor by which rates are larger: docs/notebook/floaters.md
Prior = TypeVar("Prior", DepthPrior, NormalPrior)
MAX_SCALE = 100.0  # six million iterations of 2DGS-R: more is a typing error


def scale_schedule(recipe: Recipe, factor: float) -> Recipe:
    """Return a recipe with a schedule ``factor`` times as long.

    ``factor``: positive. The number of random points to start from shrinks with its square root, to 10 000 at least,
    because a short run cannot place as many splats. Raises RecipeError if the factor is not in (0, ``MAX_SCALE``].
    """
    if not 0 < factor <= MAX_SCALE:
        raise RecipeError(f"--schedule-scale must be a positive number up to {MAX_SCALE:g}, got {factor}")
    return recipe if factor == 1 else _scale(recipe, factor, [factor] * len(recipe.stages))


def fit_schedule(recipe: Recipe, iterations: int) -> Recipe:
    """Return a recipe with a total of ``iterations``, scaled like :func:`scale_schedule`.

    ``iterations``: total of all stages. Each stage keeps its fraction of them, to within one, and at least one. Raises
    RecipeError if there are fewer iterations than stages, or more than ``MAX_SCALE`` times those of the recipe.
    """
    lengths = [stage.iterations for stage in recipe.stages]
    least, most = sum(length > 0 for length in lengths), round(MAX_SCALE * recipe.iterations)
    whole = isinstance(iterations, int) and not isinstance(iterations, bool)
    if not (whole and 0 < least <= iterations <= most):
        raise RecipeError(
            f"iterations must be a whole number from {least} to {most} for recipe {recipe.name!r}, got {iterations!r}"
        )
    factor = iterations / recipe.iterations
    rounded = [max(1, math.floor(length * factor)) if length else 0 for length in lengths]
    while missing := iterations - sum(rounded):  # at most one per stage
        step = 1 if missing > 0 else -1
        open_stages = [i for i, length in enumerate(lengths) if length and rounded[i] + step >= 1]
        rounded[max(open_stages, key=lambda i: step * (lengths[i] * factor - rounded[i]))] += step
    factors = [now / length if length else factor for now, length in zip(rounded, lengths, strict=True)]
    return recipe if factor == 1 else _scale(recipe, factor, factors)


def _scale(recipe: Recipe, factor: float, of_stages: Sequence[float]) -> Recipe:
    """Return the recipe ``factor`` times as long, each stage by its own factor."""
    points = max(MIN_INIT_POINTS, round(recipe.init_points * math.sqrt(factor)))
    return replace(
        recipe,
        stages=tuple(map(_scale_stage, recipe.stages, of_stages)),
        init_points=min(recipe.init_points, points),
        learned=tuple(quantity.scaled(factor) for quantity in recipe.learned),
        depth_prior=None if recipe.depth_prior is None else _scale_prior(recipe.depth_prior, factor),
        normal_prior=None if recipe.normal_prior is None else _scale_prior(recipe.normal_prior, factor),
    )


def longer_steps(recipe: Recipe, factor: float) -> Recipe:
    """Return a recipe with larger rates for a schedule that was scaled by ``factor`` < 1.

    With fewer steps of Adam, each must be longer. All rates of splats are multiplied by ``factor ** -LONGER`` (2.1 at a
    twentieth). Stages with ``LearningRates.stretch`` do not change, because :func:`scale_schedule` has scaled their
    rates.
    """
    if factor >= 1:
        return recipe
    times = factor**-LONGER

    def longer(stage: Stage) -> Stage:
        return stage if stage.lr.stretch else replace(stage, lr=stage.lr.times(times))

    return replace(recipe, stages=tuple(map(longer, recipe.stages)))


def _scale_prior(prior: Prior, factor: float) -> Prior:
    return replace(prior, decay_steps=_scaled(prior.decay_steps, factor))


def _scale_stage(stage: Stage, factor: float) -> Stage:
    return replace(
        stage,
        iterations=_scaled(stage.iterations, factor),
        losses=tuple(replace(term, start=round(term.start * factor)) for term in stage.losses),
        lr=_scale_lr(stage.lr, factor),
        sh_interval=_scaled(stage.sh_interval, factor),
        densify=None if stage.densify is None else _scale_densify(stage.densify, factor),
    )


def _scale_lr(lr: LearningRates, factor: float) -> LearningRates:
    times = factor**-lr.stretch if factor < 1 else 1.0
    return replace(
        lr.times(times) if times != 1 else lr,
        means_decay_steps=_scaled(lr.means_decay_steps, factor),
        settle_start=round(lr.settle_start * factor),
        settle_steps=_scaled(lr.settle_steps, factor),
    )


def _scale_densify(densify: GradDensify | Densify, factor: float) -> GradDensify | Densify:
    if isinstance(densify, Densify):
        return densify.scaled(factor)
    cull, needed = densify.scale_cull_start, min(MIN_DENSIFICATIONS, count_densifications(densify))
    scaled = replace(
        densify,
        start=round(densify.start * factor),
        stop=round(densify.stop * factor),
        scale_cull_start=None if cull is None else round(cull * factor),
    )
    while scaled.every > 1 and count_densifications(scaled) < needed:
        scaled = replace(scaled, every=scaled.every - 1)
    if factor >= 1:
        return scaled
    latest = max(0, scaled.stop - RESET_MARGIN)
    return replace(
        scaled,
        prune_grace=max(densify.prune_grace, PRUNE_GRACE),
        last_reset=latest if densify.last_reset is None else min(latest, densify.last_reset),
    )


def count_densifications(densify: GradDensify) -> int:
    """Return the number of densifications of a stage."""
    return max(0, (densify.stop - 1) // densify.every - densify.start // densify.every)


def _scaled(count: int, factor: float) -> int:
    """Return a scaled number of iterations, at least 1; 0 (off) stays 0."""
    return max(1, round(count * factor)) if count > 0 else 0
