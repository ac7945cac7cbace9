"""Short runs that still behave: a recipe scaled by a factor.

Scaled: stage lengths, loss starts, the SH interval, where ``downscale`` halves, start and stop of densification and of
the prune by size, the horizons of the rates of means, exposures, poses and cameras (so that rates end where they
should) and of the weights of priors, and resets of white backgrounds alone (``reset_at_on_white``), which go with the
start.
*Not* scaled: the densification interval, as long as ten densifications fit, the first iterations without exposures and
poses, and opacity resets. A reset puts opacity at 0.01, below the 0.05 at which splats are pruned; Adam moves a logit
by about its rate, 0.05, a step, and 1.65 are missing, so a splat needs dozens of views to come back.
Pure Python; never imports torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from gs2d.config.densify import Densify
from gs2d.config.priors import DepthPrior, NormalPrior
from gs2d.config.quantities import Learning
from gs2d.config.recipe import GradDensify, LearningRates, Recipe, Stage
from gs2d.errors import RecipeError

MIN_DENSIFICATIONS = 10
PRUNE_GRACE = 100  # iterations after a reset in which nothing is pruned for opacity
RESET_MARGIN = 200  # iterations of densification that a reset must leave
MIN_INIT_POINTS = 10_000
LONGER = 0.25  # power of 1 / factor by which steps are longer: docs/notebook/floaters.md
VIEWS_WAIT = 200  # iterations before exposures and poses are learned, where the schedule has them
Learned = TypeVar("Learned", bound=Learning)
Prior = TypeVar("Prior", DepthPrior, NormalPrior)
MAX_SCALE = 100.0  # six million iterations of 2DGS-R: more is a slip of the keyboard


def scale_schedule(recipe: Recipe, factor: float) -> Recipe:
    """Return the same recipe, ``factor`` times as long; at factor 1 the recipe itself.

    Parameters
    ----------
    recipe : Recipe
    factor : float
        Positive. The random start shrinks with its square root (never below 10 000 points, nor above what it was): a
        short run cannot place as many splats.

    Raises
    ------
    RecipeError
        A factor that is not in (0, ``MAX_SCALE``].
    """
    if not 0 < factor <= MAX_SCALE:
        raise RecipeError(f"--schedule-scale must be a positive number up to {MAX_SCALE:g}, got {factor}")
    return recipe if factor == 1 else _scale(recipe, factor, [factor] * len(recipe.stages))


def fit_schedule(recipe: Recipe, iterations: int) -> Recipe:
    """Return the same recipe with a total of ``iterations``, scaled like :func:`scale_schedule`.

    Parameters
    ----------
    recipe : Recipe
    iterations : int
        Total of all stages. Each stage has its share of them, to within one, and at least one.

    Raises
    ------
    RecipeError
        If there are fewer iterations than stages, or more than ``MAX_SCALE`` times those of the recipe.
    """
    lengths = [stage.iterations for stage in recipe.stages]
    least, most = sum(length > 0 for length in lengths), round(MAX_SCALE * recipe.iterations)
    whole = isinstance(iterations, int) and not isinstance(iterations, bool)
    if not (whole and 0 < least <= iterations <= most):
        raise RecipeError(
            f"iterations must be a whole number from {least} to {most} for recipe {recipe.name!r}, got {iterations!r}"
        )
    factor = iterations / recipe.iterations
    found = [max(1, math.floor(length * factor)) if length else 0 for length in lengths]
    while missing := iterations - sum(found):  # at most one a stage: the stage that is farthest from its share
        step = 1 if missing > 0 else -1
        open_stages = [i for i, length in enumerate(lengths) if length and found[i] + step >= 1]
        found[max(open_stages, key=lambda i: step * (lengths[i] * factor - found[i]))] += step
    factors = [now / length if length else factor for now, length in zip(found, lengths, strict=True)]
    return recipe if factor == 1 else _scale(recipe, factor, factors)


def _scale(recipe: Recipe, factor: float, of_stages: Sequence[float]) -> Recipe:
    """Return the recipe ``factor`` times as long, each stage by its own factor."""
    points = max(MIN_INIT_POINTS, round(recipe.init_points * math.sqrt(factor)))
    return replace(
        recipe,
        stages=tuple(map(_scale_stage, recipe.stages, of_stages)),
        init_points=min(recipe.init_points, points),
        exposure=None if recipe.exposure is None else _scale_views(recipe.exposure, factor),
        poses=None if recipe.poses is None else _scale_poses(recipe.poses, factor),
        intrinsics=None if recipe.intrinsics is None else _scale_poses(recipe.intrinsics, factor),
        photometry=None if recipe.photometry is None else _scale_poses(recipe.photometry, factor),
        learned=tuple(_scale_poses(quantity, factor) for quantity in recipe.learned),
        depth_prior=None if recipe.depth_prior is None else _scale_prior(recipe.depth_prior, factor),
        normal_prior=None if recipe.normal_prior is None else _scale_prior(recipe.normal_prior, factor),
    )


def longer_steps(recipe: Recipe, factor: float) -> Recipe:
    """Return the recipe with rates for a schedule ``factor`` times as long as they were chosen for.

    Adam's steps do not grow with gradients: in fewer of them a splat gets as far only if each is longer. All rates of
    splats are multiplied by ``factor ** -LONGER`` (2.1 at a twentieth); at factor 1 and above nothing changes. Stages
    whose own rates say how they grow (``LearningRates.stretch``) are left as they are.
    """
    if factor >= 1:
        return recipe
    times = factor**-LONGER

    def longer(stage: Stage) -> Stage:
        return stage if stage.lr.stretch else replace(stage, lr=stage.lr.times(times))

    return replace(recipe, stages=tuple(map(longer, recipe.stages)))


def _scale_prior(prior: Prior, factor: float) -> Prior:
    return replace(prior, decay_steps=_scaled(prior.decay_steps, factor))


def _scale_views(learned: Learned, factor: float) -> Learned:
    """Splats become a scene, and leave the grey they start from, by the count of iterations, not by its share."""
    decay_steps = _scaled(learned.decay_steps, factor)
    least = min(learned.start, VIEWS_WAIT, decay_steps // 6)
    return replace(learned, decay_steps=decay_steps, start=max(least, round(learned.start * factor)))


def _scale_poses(learned: Learned, factor: float) -> Learned:
    """Scale the steps of cameras: one moves when its image has its turn, and takes longer steps with fewer."""
    longer = 1 / math.sqrt(factor)
    return replace(_scale_views(learned, factor), rate=learned.rate * longer, rate_final=learned.rate_final * longer)


def _scale_stage(stage: Stage, factor: float) -> Stage:
    return replace(
        stage,
        iterations=_scaled(stage.iterations, factor),
        losses=tuple(replace(term, start=round(term.start * factor)) for term in stage.losses),
        lr=_scale_lr(stage.lr, factor),
        sh_interval=_scaled(stage.sh_interval, factor),
        halve_at=tuple(round(at * factor) for at in stage.halve_at),
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
    start, stop = round(densify.start * factor), round(densify.stop * factor)
    cull = densify.scale_cull_start
    densify = replace(
        densify,
        scale_cull_start=None if cull is None else round(cull * factor),
        prune_until=round(densify.prune_until * factor),
        reset_at_on_white=tuple(_scaled(at, factor) for at in densify.reset_at_on_white),
    )
    wanted = min(MIN_DENSIFICATIONS, count_densifications(densify))
    every = densify.every
    while every > 1 and count_densifications(replace(densify, start=start, stop=stop, every=every)) < wanted:
        every -= 1
    if factor >= 1:
        return replace(densify, start=start, stop=stop, every=every)
    latest = max(0, stop - RESET_MARGIN)
    return replace(
        densify,
        start=start,
        stop=stop,
        every=every,
        prune_grace=max(densify.prune_grace, PRUNE_GRACE),
        last_reset=latest if densify.last_reset is None else min(latest, densify.last_reset),
    )


def count_densifications(densify: GradDensify) -> int:
    """How many multiples of ``every`` lie strictly between ``start`` and ``stop``."""
    return max(0, (densify.stop - 1) // densify.every - densify.start // densify.every)


def _scaled(count: int, factor: float) -> int:
    """Return a count of iterations, scaled; something stays something, and 0 (off) stays 0."""
    return max(1, round(count * factor)) if count > 0 else 0
