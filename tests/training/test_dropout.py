"""Random splat dropout for captures with few images."""

from __future__ import annotations

from dataclasses import replace

import torch

from gs2d.config.presets import two_dgs_r
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import FEW_VIEWS, Recipe, Removal
from gs2d.render.api import rasterize
from gs2d.training.robust.regularise import dropout_rate, dropped_out, rendered_splats
from gs2d.training.trainer import Trainer
from train_toys import make_scene, short


def dropping(rate: float) -> Recipe:
    return replace(short(), removal=Removal(dropout=rate))


def test_which_stages_use_dropout() -> None:
    recipe = replace(two_dgs_r(), removal=Removal(dropout=0.2))
    assert [dropout_rate(recipe, stage, FEW_VIEWS) for stage in recipe.stages] == [0.2, 0.0, 0.0]
    assert dropout_rate(recipe, recipe.stages[0], FEW_VIEWS + 1) == 0
    assert dropout_rate(two_dgs_r(), recipe.stages[0], 3) == 0


def test_dropout_of_an_iteration_is_reproducible() -> None:
    recipe = dropping(0.25)
    first = rendered_splats(recipe, 0, 7, 40_000, 0.25)
    assert torch.equal(first, rendered_splats(recipe, 0, 7, 40_000, 0.25))
    assert abs(float(first.float().mean()) - 0.75) < 0.01
    for other in ((0, 8), (1, 7)):
        both = (first & rendered_splats(recipe, *other, 40_000, 0.25)).float().mean()
        assert abs(float(both) - 0.75**2) < 0.01  # independent
    assert not torch.equal(first, rendered_splats(replace(recipe, seed=1), 0, 7, 40_000, 0.25))


def test_dropped_splats_are_not_rendered_and_get_no_gradients() -> None:
    trainer = Trainer(make_scene(), short(), GENERIC, backend="cpu")
    splats = trainer.splats
    kept = torch.arange(len(splats)) % 2 == 0
    splats.opacity_logits.requires_grad_()
    drawn = dropped_out(splats, kept)
    assert torch.equal(drawn.opacity_logits[kept], splats.opacity_logits[kept])
    camera = trainer.scene.train[0].camera
    output = rasterize(drawn, camera, trainer.settings, backend="cpu")
    assert not output.radii[~kept].any()
    alone = rasterize(drawn.rows(kept), camera, trainer.settings, backend="cpu")
    assert torch.equal(output.color, alone.color)
    output.color.sum().backward()  # type: ignore[no-untyped-call]
    gradient = splats.opacity_logits.grad
    assert gradient is not None
    assert not gradient[~kept].any()
    assert gradient[kept].any()
