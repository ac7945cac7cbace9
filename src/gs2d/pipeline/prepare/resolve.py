"""Resolve options and a capture into the recipe, protocol and scene that are trained."""

from __future__ import annotations

import re
from dataclasses import replace

from gs2d.config.presets import (
    get_recipe,
    with_depth_prior,
    with_exposure,
    with_few_views,
    with_intrinsics,
    with_normal_prior,
    with_poses,
    with_robustness,
)
from gs2d.config.protocols import BLACK, Protocol, get_protocol
from gs2d.config.quantities import Quantity
from gs2d.config.recipe import FEW_VIEWS, Recipe, validate
from gs2d.config.schedule import fit_schedule, longer_steps, scale_schedule
from gs2d.config.serialize import apply_overrides
from gs2d.data import Scene
from gs2d.errors import ProtocolError, RecipeError
from gs2d.losses.base import losses_of
from gs2d.pipeline.prepare.open_capture import OpenCapture, without_masked_points
from gs2d.pipeline.prepare.options import Training, TrainOptions, check_choices
from gs2d.training.events import Notice, OnEvent
from gs2d.training.learned.point_gains import point_gains, spread
from gs2d.training.photographs import needs_faces
from gs2d.training.robust.backdrop import find_backdrop
from gs2d.training.robust.robustness import check_free_space

MAX_VIEWS = 1_000_000
DIFFERS = 0.03  # standard deviation of the logarithm of gains; more: the exposures of the photographs differ


def recipe_of(recipe: str | Recipe) -> Recipe:
    """Return the recipe of a name, or the recipe itself."""
    value = get_recipe(recipe) if isinstance(recipe, str) else recipe
    if not isinstance(value, Recipe):
        raise RecipeError(f"recipe must be a name that `gs2d recipes` lists or a Recipe, got {type(value).__name__}")
    return value


def build_recipe(
    training: Training,
    *,
    seed: int = 0,
    schedule_scale: float = 1.0,
    iterations: int | None = None,
    robust: bool = False,
    exposure: bool = False,
) -> Recipe:
    """Return the trained recipe: with the additions of the options, scaled, seeded, overridden and validated.

    ``schedule_scale`` is a fraction of the recipe's iterations; ``iterations``, instead, their number. ``robust`` and
    ``exposure``: whether training is robust, and whether it learns exposures.
    """
    value = recipe_of(training.recipe)
    value = with_exposure(value) if exposure else value
    learned = training.learned
    value = with_poses(value) if "poses" in learned else value
    value = with_intrinsics(value) if "intrinsics" in learned else value
    for name in learned:  # of packages; exposure is decided above
        if name not in ("auto", "exposure") and not value.learns(name):
            value = replace(value.with_learned(Quantity(name)), name=f"{value.name}-{name}")
    value = with_depth_prior(value, training.depth_prior) if training.depth_prior is not None else value
    value = with_normal_prior(value) if training.normal_prior else value
    value = with_robustness(value) if robust else value
    exposures = value.quantities.get("exposure")
    if robust and exposures is not None:
        value = value.with_learned(exposures.with_options(initial="points"))
    if iterations is not None and schedule_scale != 1:
        both = f"{iterations} and {schedule_scale}"
        raise RecipeError(f"iterations and schedule_scale both set the length of training, got {both}; give one")
    full = value.iterations
    value = scale_schedule(value, schedule_scale) if iterations is None else fit_schedule(value, iterations)
    value = longer_steps(value, schedule_scale if iterations is None else iterations / full) if robust else value
    value = apply_overrides(replace(value, seed=seed), training.overrides)
    for option, requested, field in (
        ("--depth-prior", training.depth_prior is not None, "depth_prior"),
        ("--normal-prior", training.normal_prior, "normal_prior"),
    ):
        if requested and getattr(value, field) is None:
            raise RecipeError(f"{option} and --set {field}=null contradict each other, got both; leave one out")
    losses_of(validate(value))  # checks the options of the losses
    return value


def check_options(options: TrainOptions) -> None:
    """Raise for invalid options, before anything is read."""
    check_choices(options)
    scale = 1.0 if options.schedule_scale is None else options.schedule_scale
    robust, exposure = options.robust != "off", "exposure" in options.learned
    build_recipe(options, seed=options.seed, schedule_scale=scale, robust=robust, exposure=exposure)
    if options.downscale is not None and options.downscale < 1:
        raise RecipeError(f"--downscale must be a whole number >= 1, got {options.downscale}")
    checkpoint_interval(options.checkpoint_every)
    if options.test_every is not None and options.test_every not in (0, *range(2, MAX_VIEWS)):
        raise ProtocolError(f"--test-every must be 0 (no test views) or at least 2, got {options.test_every}")
    if isinstance(options.protocol, str) and options.protocol != "auto":
        get_protocol(options.protocol)


def checkpoint_interval(every: str | int) -> tuple[int | None, float | None]:
    """Return the iterations and the seconds between checkpoints, one of them None, of ``--checkpoint-every``.

    Raises RecipeError if it is neither a whole number of iterations nor a time such as 90s or 10m.
    """
    text = str(every)
    number = int(text[:-1] if text[-1:] in ("s", "m") else text) if re.fullmatch(r"[0-9]{1,12}[sm]?", text) else 0
    if number < 1:
        raise RecipeError(f"--checkpoint-every must be iterations (500) or a time (90s, 10m), got {text}")
    return (number, None) if text.isdecimal() else (None, number * (60.0 if text.endswith("m") else 1.0))


def schedule_scale_of(options: TrainOptions, capture: OpenCapture) -> float:
    """Return the trained fraction of the recipe: that of the options, else by quality."""
    if options.schedule_scale is not None:
        return options.schedule_scale
    iterations = capture.quality.iterations
    return 1.0 if iterations is None else min(1.0, iterations / max(1, recipe_of(options.recipe).iterations))


def resolve(
    training: Training,
    capture: OpenCapture,
    on_event: OnEvent,
    *,
    seed: int = 0,
    schedule_scale: float = 1.0,
    iterations: int | None = None,
) -> tuple[Recipe, OpenCapture]:
    """Return the recipe and the capture that are trained; the same for all commands.

    Seed and length are as for :func:`build_recipe`.
    """
    scene = without_masked_points(capture.scene, capture.protocol, on_event)
    robust, exposure = robust_and_exposure(training, scene, capture.protocol, on_event)
    recipe = build_recipe(
        training, seed=seed, schedule_scale=schedule_scale, iterations=iterations, robust=robust, exposure=exposure
    )
    check_free_space(scene, recipe)
    recipe, protocol = with_backdrop(recipe, capture.protocol, scene, on_event)
    if len(scene.train) <= FEW_VIEWS and (slower := with_few_views(recipe)) != recipe:
        recipe = slower
        on_event(Notice(f"{len(scene.train)} training photographs: settings against overfitting", detail=True))
    if any(view.whole is not None for view in scene.train):
        why = needs_faces(recipe, protocol, capture.backend)
        on_event(Notice(f"training uses {f'faces: {why}' if why else 'whole photographs'}", detail=True))
    return recipe, replace(capture, scene=scene, protocol=with_fused_depth(protocol, recipe))


def robust_and_exposure(training: Training, scene: Scene, protocol: Protocol, on_event: OnEvent) -> tuple[bool, bool]:
    """Return whether this capture is trained robustly, and whether exposures are learned.

    ``training.robust`` "auto" is robust if the protocol is and the capture has sparse points with the views that
    observe them. "auto" in ``training.learn`` learns exposures if the colours of those points vary.
    """
    robust = training.robust == "on" or (training.robust == "auto" and protocol.robust)
    missing = scene.unobserved() if robust else ""
    if missing and scene.observed() is not None:
        on_event(Notice(f"sparse points are projected into the images: {missing}", detail=True))
    elif missing and training.robust == "auto":
        robust = False
        on_event(Notice(f"training is not robust: {missing}"))
    learned = training.learned
    exposure = "exposure" in learned
    if robust and not exposure and "auto" in learned and (gains := point_gains(scene)) is not None:
        exposure = spread(gains) >= DIFFERS
        least, most = gains.mean(axis=1).min(), gains.mean(axis=1).max()
        decision = "learned for each photograph" if exposure else "treated as equal (--learn exposure learns them)"
        on_event(
            Notice(f"exposures of the photographs: {least:.2f} to {most:.2f} times the mean; {decision}", detail=True)
        )
    return robust, exposure


def with_backdrop(recipe: Recipe, protocol: Protocol, scene: Scene, on_event: OnEvent) -> tuple[Recipe, Protocol]:
    """Use the colour of sky and bare walls as background, if the recipe removes floaters.

    On a uniform, unlit backdrop, splats of its colour are proposed for removal.
    """
    backdrop = find_backdrop(scene) if recipe.removal is not None and protocol.background == BLACK else None
    if backdrop is None or recipe.removal is None:
        return recipe, protocol
    if backdrop.is_unlit:
        recipe = replace(recipe, removal=replace(recipe.removal, backdrop=True))
    color = ", ".join(f"{value:.2f}" for value in backdrop.color)
    on_event(Notice(f"background: ({color}), the colour of regions without sparse points", detail=True))
    return recipe, replace(protocol, background=backdrop.color)


def with_fused_depth(protocol: Protocol, recipe: Recipe) -> Protocol:
    """Return the protocol with the fused depth of the recipe, if the recipe sets one."""
    depth = recipe.fused_depth
    return protocol if depth is None else replace(protocol, fusion=replace(protocol.fusion, depth=depth))
