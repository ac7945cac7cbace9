"""Training by the depth of continuous transmittance: rendered where a loss asks for it, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.presets import with_depth_prior
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LossTerm, Recipe, validate
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.training.objective import raster_settings
from gs2d.training.trainer import Trainer
from saved_states import reload, saved
from train_toys import compared, same, short


def by_depth(recipe: Recipe, kind: str, *kinds_of_loss: str) -> Recipe:
    """The recipe with losses of these kinds by that depth."""

    def changed(term: LossTerm) -> LossTerm:
        return replace(term, depth=kind) if term.kind in kinds_of_loss else term

    stages = (replace(stage, losses=tuple(map(changed, stage.losses))) for stage in recipe.stages)
    return replace(recipe, stages=tuple(stages))


def test_it_is_rendered_only_while_a_loss_asks_for_it(scene: Scene) -> None:
    trainer = Trainer(scene, by_depth(short(), "transmittance", "normal_consistency"), GENERIC, backend="reference")
    stages = trainer.recipe.stages  # normal consistency begins after 4 iterations, and is not in the second stage
    asked = [trainer._whole.settings(stages[0], iteration).with_transmittance_depth for iteration in (4, 5)]
    assert asked == [False, True]
    assert not trainer._whole.settings(stages[1], 4).with_transmittance_depth
    plain = Trainer(scene, short(), GENERIC, backend="reference")
    assert not plain._whole.settings(plain.recipe.stages[0], 5).with_transmittance_depth


def test_a_protocol_may_ask_for_it(scene: Scene) -> None:
    protocol = replace(GENERIC, depth="transmittance")
    trainer = Trainer(scene, short(), protocol, backend="reference")
    assert trainer._whole.settings(trainer.recipe.stages[0], 5).with_transmittance_depth
    fused = replace(GENERIC, fusion=replace(GENERIC.fusion, depth="transmittance"))
    assert raster_settings(fused, 1.0, 3).with_transmittance_depth
    assert not raster_settings(GENERIC, 1.0, 3).with_transmittance_depth
    trainer = Trainer(scene, short(), fused, backend="reference")
    assert not trainer._whole.settings(trainer.recipe.stages[0], 5).with_transmittance_depth  # fusion is not training


def test_losses_by_it_have_other_gradients_than_by_the_median(scene: Scene, backend: str) -> None:
    found = {}
    for kind in ("median", "transmittance"):
        trainer = Trainer(scene, by_depth(short(), kind, "normal_consistency"), GENERIC, backend=backend)
        trainer.enter(0)
        result = trainer._whole.evaluate(trainer.state, trainer.recipe.stages[0], 5, 0)
        assert np.isfinite(float(result.losses["normal_consistency"]))
        found[kind] = result.gradients
    moved = {kind: (gradients["means"] != 0).any(dim=1) for kind, gradients in found.items()}
    assert torch.equal(found["median"]["sh0"], found["transmittance"]["sh0"])  # colours are not asked
    assert not torch.equal(found["median"]["means"], found["transmittance"]["means"])
    assert bool((moved["transmittance"] >= moved["median"]).all())


def test_both_views_that_are_compared_have_that_depth(scene: Scene, backend: str) -> None:
    recipe = by_depth(compared(), "transmittance", "multiview_photometric", "multiview_geometric")
    trainer = Trainer(scene, recipe, GENERIC, backend=backend)
    trainer.enter(0)
    neighbour = trainer._whole.neighbour_of(trainer.state, recipe.stages[0], 7, 0, trainer.splats)
    plain = Trainer(scene, compared(), GENERIC, backend=backend)
    plain.enter(0)
    other = plain._whole.neighbour_of(plain.state, compared().stages[0], 7, 0, plain.splats)
    assert neighbour is not None
    assert other is not None
    assert not torch.equal(neighbour.depth, other.depth)
    losses = trainer._whole.evaluate(trainer.state, recipe.stages[0], 7, 0).losses
    assert float(losses["multiview_geometric"]) > 0


def test_a_resumed_training_gives_the_same_bytes(scene: Scene, backend: str) -> None:
    recipe = by_depth(short(), "transmittance", "normal_consistency")
    whole = Trainer(scene, recipe, GENERIC, backend=backend)
    whole.enter(0)
    for _ in range(7):
        whole.step()
    again = Trainer(scene, recipe, GENERIC, backend=backend, state=reload(saved(whole)))
    for trainer in (whole, again):
        trainer.run()
    assert same(whole.splats, again.splats)


def test_a_depth_that_nobody_renders_is_refused() -> None:
    recipe = by_depth(with_depth_prior(short()), "mode", "depth_prior")
    with pytest.raises(RecipeError, match="depth of loss 'depth_prior' must be one of mean, median, transmittance"):
        validate(recipe)
