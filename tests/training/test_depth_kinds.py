"""Training with continuous-transmittance depth: rendered only where a loss requests it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LossTerm, Recipe
from gs2d.data.scene import Scene
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from train_toys import short


def by_depth(recipe: Recipe, kind: str, *kinds_of_loss: str) -> Recipe:
    """Return the recipe in which losses of these kinds use that depth."""

    def changed(term: LossTerm) -> LossTerm:
        return replace(term, depth=kind) if term.kind in kinds_of_loss else term

    stages = (replace(stage, losses=tuple(map(changed, stage.losses))) for stage in recipe.stages)
    return replace(recipe, stages=tuple(stages))


def test_transmittance_depth_is_rendered_only_if_a_loss_uses_it(scene: Scene) -> None:
    trainer = Trainer(scene, by_depth(short(), "transmittance", "normal_consistency"), GENERIC, backend="reference")
    stages = trainer.recipe.stages  # normal consistency starts after 4 iterations, and is not in the second stage
    asked = [trainer._whole.settings(stages[0], iteration).with_transmittance_depth for iteration in (4, 5)]
    assert asked == [False, True]
    assert not trainer._whole.settings(stages[1], 4).with_transmittance_depth
    plain = Trainer(scene, short(), GENERIC, backend="reference")
    assert not plain._whole.settings(plain.recipe.stages[0], 5).with_transmittance_depth


def test_transmittance_and_median_depth_have_different_gradients(scene: Scene, backend: str) -> None:
    found = {}
    for kind in ("median", "transmittance"):
        trainer = Trainer(scene, by_depth(short(), kind, "normal_consistency"), GENERIC, backend=backend)
        trainer.enter(0)
        result = trainer._whole.evaluate(trainer.state, trainer.recipe.stages[0], 5, 0)
        assert np.isfinite(float(result.losses["normal_consistency"]))
        found[kind] = result.gradients
    moved = {kind: (gradients["means"] != 0).any(dim=1) for kind, gradients in found.items()}
    assert torch.equal(found["median"]["sh0"], found["transmittance"]["sh0"])  # colours do not depend on depth
    assert not torch.equal(found["median"]["means"], found["transmittance"]["means"])
    assert bool((moved["transmittance"] >= moved["median"]).all())


def test_a_resumed_training_gives_the_same_bytes(scene: Scene, backend: str) -> None:
    resumed_everywhere(scene, by_depth(short(), "transmittance", "normal_consistency"), backend, every=12)
