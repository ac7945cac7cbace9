"""Schedules of loss terms: active iterations, skipped work, and restriction to image regions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LossTerm, Recipe, Stage
from gs2d.data.scene import Scene, View
from gs2d.losses import formulas as reference
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training import objective
from gs2d.training.trainer import Trainer
from train_toys import short


def with_terms(recipe: Recipe, **changes: Any) -> Recipe:
    """Change fields of all terms of a kind, in all stages: ``normal_consistency={"start": 2}``."""

    def changed(stage: Stage) -> Stage:
        return replace(stage, losses=tuple(replace(t, **changes.get(t.kind, {})) for t in stage.losses))

    return replace(recipe, stages=tuple(changed(stage) for stage in recipe.stages))


def cut_out(scene: Scene) -> Scene:
    """Return the same images with an alpha channel that is empty where they are black."""

    def with_alpha(view: View) -> View:
        image = view.image()
        alpha = np.where(image.max(axis=2, keepdims=True) > 8, 255, 0).astype(np.uint8)
        return View.from_arrays(view.name, view.camera, np.concatenate([image, alpha], axis=2))

    return replace(scene, train=tuple(map(with_alpha, scene.train)))


def entered(scene: Scene, recipe: Recipe, backend: str) -> Trainer:
    trainer = Trainer(scene, recipe, GENERIC, backend=backend)
    trainer.enter(0)
    return trainer


def test_an_inactive_term_changes_nothing(scene: Scene, backend: str) -> None:
    trainer = entered(scene, short(), backend)
    stage = trainer.recipe.stages[0]
    rare = with_terms(trainer.recipe, normal_consistency={"start": 8}).stages[0]
    without = replace(stage, losses=tuple(t for t in stage.losses if t.kind != "normal_consistency"))
    for iteration, other in ((7, without), (8, without), (9, stage)):
        found, expected = (trainer._whole.evaluate(trainer.state, s, iteration, 0) for s in (rare, other))
        assert found.losses == expected.losses
        assert all(torch.equal(found.gradients[name], expected.gradients[name]) for name in expected.gradients)
    assert set(trainer._whole.evaluate(trainer.state, rare, 9, 0).losses) == {"l1", "ssim", "normal_consistency"}


def test_inputs_of_an_inactive_term_are_not_rendered(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[RasterSettings] = []

    def counted(splats: Any, camera: Any, settings: RasterSettings, **options: Any) -> Any:
        rendered.append(settings)
        return rasterize(splats, camera, settings, **options)

    recipe = short()
    first = replace(recipe.stages[0], losses=(*recipe.stages[0].losses, LossTerm("distortion", 1.0, start=7)))
    recipe = replace(recipe, stages=(first, *recipe.stages[1:]))
    trainer = entered(scene, recipe, "reference")
    monkeypatch.setattr(objective, "rasterize", counted)
    counts = []
    for iteration in (7, 8):
        rendered.clear()
        trainer._whole.evaluate(trainer.state, recipe.stages[0], iteration, 0)
        counts.append((len(rendered), rendered[0].with_distortion))
    assert counts == [(1, False), (1, True)]


@pytest.mark.parametrize("has_alpha", [True, False])
def test_object_weights_use_the_alpha_of_the_image_or_the_rendered_alpha(
    scene: Scene, backend: str, has_alpha: bool
) -> None:
    made = cut_out(scene) if has_alpha else scene
    recipe = with_terms(short(), normal_consistency={"start": 0, "options": {"where": "object"}})
    trainer = entered(made, recipe, backend)
    camera = made.train[0].camera
    with torch.no_grad():
        seen = rasterize(trainer.splats, camera, trainer._whole.settings(recipe.stages[0], 1), backend=backend)
    photographed = made.train[0].alpha()
    weights = seen.alpha if photographed is None else torch.from_numpy(photographed > 0.5).float()
    assert 0.1 < weights.mean() < 0.9
    value = reference.normal_consistency(seen.normal, seen.depth(GENERIC.depth), seen.alpha, camera, weights=weights)
    found = trainer._whole.evaluate(trainer.state, recipe.stages[0], 1, 0).losses["normal_consistency"]
    assert found == pytest.approx(0.05 * value.item(), rel=1e-4)
