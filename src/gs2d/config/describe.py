"""Describe recipes in words. Pure Python; never imports torch."""

from __future__ import annotations

import math
from collections.abc import Iterator

from gs2d.config.densify import Densify
from gs2d.config.recipe import ALL, GradDensify, LearningRates, Recipe, Stage
from gs2d.config.robust import FEW_VIEWS


def describe_recipe(recipe: Recipe) -> Iterator[str]:
    """Yield lines that describe a recipe."""
    yield f"{recipe.name}: {recipe.iterations:,} iterations, SH degree {recipe.sh_degree}, seed {recipe.seed}"
    yield from _describe_learned(recipe)
    if recipe.multiview is not None:
        m = recipe.multiview
        where = f"one of {m.neighbours} nearby views within {m.max_angle:g} degrees"
        yield f"views compared: {m.patches:,} patches of {m.side}x{m.side} px with {where}"
    yield from _describe_priors(recipe)
    if recipe.dense_start is not None:
        start = recipe.dense_start
        parts = ["fitted splats"] * start.fit + ["a sphere of splats around the scene"] * start.sphere
        optional = "" if start.required else "; optional"
        yield f"dense start: a plane sweep at about {start.side} px{''.join(f', {part}' for part in parts)}{optional}"
    if recipe.removal is not None:
        r = recipe.removal
        yield f"floaters: proposed every {r.every:,} iterations, removed unless the training images miss them"
        yield f"dropout: {r.dropout:g} of the splats each iteration, with at most {FEW_VIEWS} training views"
    if recipe.fused_depth is not None:
        yield f"mesh: from the {recipe.fused_depth} depth"
    for number, stage in enumerate(recipe.stages, start=1):
        yield f"{number}. {stage.name}: {stage.iterations:,} iterations"
        for line in _describe_stage(stage):
            yield f"     {line}"


def _describe_learned(recipe: Recipe) -> Iterator[str]:
    words = {
        "exposure": "a colour transform for each image",
        "poses": "a motion (rad, scene extents) for each training camera, while all splats move",
        "intrinsics": "focal length of each camera, with the poses",
    }
    for name, quantity in recipe.quantities.items():
        options = "".join(f", {key}={value}" for key, value in quantity.options.items())
        yield (
            f"{name}: {words.get(name, 'registered quantity')}{options}; after iteration {quantity.start:,}, rate "
            f"{quantity.rate:g} to {quantity.rate_final:g} over {quantity.decay_steps:,} iterations, "
            f"prior {quantity.prior:g}"
        )


def _describe_priors(recipe: Recipe) -> Iterator[str]:
    falls = "weight decays to {0.final_factor:g} of its value over {0.decay_steps:,} iterations"
    if recipe.depth_prior is not None:
        d = recipe.depth_prior
        fitted = "sparse points" if d.align == "points" else "the rendered depth"
        sources = {
            "auto": "sensor maps, relative maps or sparse points, whichever the capture has first",
            "sparse": f"sparse points in at least {d.min_track} photographs within {d.max_error:g} px",
            "sensor": "maps in units of the capture times a factor",
            "relative": f"maps of unknown scale and shift, fitted to {fitted}",
        }
        yield f"known depths: {sources[d.source]}; {falls.format(d)}"
    if recipe.normal_prior is not None:
        yield f"known normals: maps ({recipe.normal_prior.axes} axes); {falls.format(recipe.normal_prior)}"


def _describe_stage(stage: Stage) -> Iterator[str]:
    for action in stage.on_enter:
        options = ", ".join(f"{name}={value}" for name, value in action.options.items())
        yield f"first: {action.name}{f' ({options})' if options else ''}"
    groups: dict[str, list[str]] = {}
    for attribute, rows in stage.train.items():
        groups.setdefault(rows, []).append(attribute)
    for rows, attributes in groups.items():
        yield f"trains {', '.join(attributes)} of {'all splats' if rows == 'all' else repr(rows)}"
    official = LearningRates()
    times = stage.lr.shN / stage.lr.sh0 / (official.shN / official.sh0) if stage.lr.sh0 else 1.0
    if "shN" in stage.train and not math.isclose(times, 1.0):
        yield f"SH beyond degree 0 at {times:g} times their rate in 2DGS, relative to degree 0"
    if stage.lr.settle_steps:
        falls = f"to {stage.lr.settle_factor:g} of their value over {stage.lr.settle_steps:,} iterations"
        yield f"all rates but that of the means fall after iteration {stage.lr.settle_start:,}, {falls}"
    frozen = [attribute for attribute in ALL if attribute not in stage.train]
    if frozen:
        yield f"frozen: {', '.join(frozen)}"
    for term in stage.losses:
        weight = "the protocol's weight" if term.weight is None else f"{term.weight:g}"
        since = f" after iteration {term.start:,}" if term.start else ""
        every = f", every {term.every} iterations" if term.every > 1 else ""
        options = "".join(f", {name}={value}" for name, value in term.options.items())
        yield f"loss {term.kind}: {weight}{since}{every}{options}"
    if isinstance(stage.densify, Densify):
        given = ", ".join(f"{name}={value}" for name, value in stage.densify.options.items())
        yield f"densifies by {stage.densify.name}{f' ({given})' if given else ''}"
    elif stage.densify is not None:
        yield from _describe_densify(stage.densify)
    else:
        yield "no densification"


def _describe_densify(d: GradDensify) -> Iterator[str]:
    signal = "absolute" if d.absolute else "signed"
    if d.stop > 0:
        resets = f"opacity reset every {d.reset_every:,}" if d.reset_every else "no opacity resets"
        caps = f", opacity capped every {d.cap_every:,}" if d.cap_every else ""
        budget = f", up to {d.max_splats:,} splats" if d.max_splats is not None else ""
        yield (
            f"densifies every {d.every} iterations from {d.start:,} to {d.stop:,}{budget} by {signal} gradients over "
            f"{d.abs_threshold if d.absolute else d.grad_threshold:g}; {resets}{caps}"
        )
