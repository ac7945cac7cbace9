"""Recipes for controlled experiments: each changes one setting of a registered recipe.

::

    gs2d train CAPTURE --out RUN --recipe benchmarks/controls.py:restart_2dgs_r
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gs2d.config.presets import DENSE_START, PHOTOMETRIC, get_recipe
from gs2d.config.recipe import GradDensify, LearningRates, LossTerm, Recipe

#: Table name of a control -> its function.
CONTROLS = {
    "2dgs-60k-restart": "restart_2dgs_60k",
    "2dgs-r-restart": "restart_2dgs_r",
    "2dgs-r-no-clone": "no_clone",
    "2dgs-60k-no-nc-late": "no_nc_late",
    "2dgs-60k-edges-camera": "edges_camera",
}


def spec(name: str) -> str:
    """Return the ``--recipe`` argument of a control or a registered recipe."""
    return f"{__file__}:{CONTROLS[name]}" if name in CONTROLS else name


def _last_stage(name: str, title: str, **changes: Any) -> Recipe:
    recipe = get_recipe(name)
    return replace(recipe, name=title, stages=(*recipe.stages[:-1], replace(recipe.stages[-1], **changes)))


def restart_2dgs_60k() -> Recipe:
    """2dgs-60k with the means' learning rate restarted: 1.6e-4 to 1.6e-6 again over the last 30,000 iterations."""
    return _last_stage("2dgs-60k", "2dgs-60k-restart", lr=LearningRates(means_decay_steps=30_000))


def restart_2dgs_r() -> Recipe:
    """2dgs-r with the means' learning rate restarted: 1.6e-4 to 1.6e-6 again in stage 3."""
    return _last_stage("2dgs-r", "2dgs-r-restart", lr=LearningRates(means_decay_steps=20_000))


def no_clone() -> Recipe:
    """2dgs-r without cloning in stage 3."""
    return _last_stage("2dgs-r", "2dgs-r-no-clone", on_enter=())


def no_nc_late() -> Recipe:
    """2dgs-60k without normal consistency in the last 30,000 iterations: module row III without stages."""
    return _last_stage("2dgs-60k", "2dgs-60k-no-nc-late", losses=PHOTOMETRIC)


def edges_camera() -> Recipe:
    """2dgs-60k with the official code's treatment of normals next to empty pixels."""

    def changed(term: LossTerm) -> LossTerm:
        return replace(term, options={"edges": "camera"}) if term.kind == "normal_consistency" else term

    recipe = get_recipe("2dgs-60k")
    stages = (replace(stage, losses=tuple(map(changed, stage.losses))) for stage in recipe.stages)
    return replace(recipe, name="2dgs-60k-edges-camera", stages=tuple(stages))


def dense() -> Recipe:
    """2dgs from a dense initialisation fitted to the photographs, without opacity resets."""
    return _dense("2dgs-dense", GradDensify(reset_every=0))


def dense_still() -> Recipe:
    """2dgs from a dense initialisation fitted to the photographs, without densification."""
    return _dense("2dgs-dense-still", None)


def _dense(title: str, densify: GradDensify | None) -> Recipe:
    return replace(_last_stage("2dgs", title, densify=densify), dense_start=DENSE_START)
