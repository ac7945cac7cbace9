"""Images without an alpha channel are opaque, and training on them makes the scene opaque."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.presets import two_dgs_r
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LossTerm, Recipe, Removal
from gs2d.core.sh import rgb_to_sh0
from gs2d.data.scene import View
from gs2d.render.backends import get_backend
from gs2d.training.objective import FullRender
from gs2d.training.robust.regularise import BACKGROUNDS, FROM, another_background
from gs2d.training.targets import Targets
from train_toys import full_state, make_scene

GREY = (128 / 255,) * 3


def robust(**changes: object) -> Recipe:
    return replace(two_dgs_r(), removal=Removal(**changes))  # type: ignore[arg-type]


def test_the_background_changes_at_the_end_of_stages_that_train_opacity() -> None:
    recipe = robust()
    surface, appearance, refine = recipe.stages
    before = int(FROM * surface.iterations)
    assert another_background(recipe, surface, before) is None
    assert {another_background(recipe, surface, before + 1 + i) for i in range(len(BACKGROUNDS))} == set(BACKGROUNDS)
    for stage in (appearance, refine):
        assert another_background(recipe, stage, stage.iterations) is None


def opacity_gradient(iterations: range, *, channels: int) -> float:
    """Return the summed opacity gradient over iterations in which image, splats and background have the same colour."""
    scene, state = make_scene(), full_state(20)
    stage = replace(robust().stages[0], losses=(LossTerm("l2", 1.0),))
    recipe = replace(robust(dropout=0.0), stages=(stage,))
    camera = scene.train[0].camera
    pixels = np.full((camera.height, camera.width, channels), 128, np.uint8)
    pixels[..., 3:] = 255
    scene = replace(scene, train=(View.from_arrays("grey.png", camera, pixels),))
    state.splats.sh0[:], state.splats.shN[:] = rgb_to_sh0(torch.tensor([GREY])), 0
    targets = Targets(scene.train, GREY, use_masks=False, needs={"silhouette"})
    backend = get_backend("reference")
    whole = FullRender(scene, recipe, replace(GENERIC, background=GREY), backend, targets)
    found = [whole.evaluate(state, stage, iteration, 0).gradients["opacity_logits"] for iteration in iterations]
    return float(torch.stack(found).sum())


def test_holes_are_filled_in_opaque_images_only() -> None:
    last = robust().stages[0].iterations
    late = range(last - len(BACKGROUNDS) + 1, last + 1)
    assert opacity_gradient(late, channels=3) < -1e-3  # gradient descent raises opacity
    assert opacity_gradient(late, channels=4) == pytest.approx(0, abs=1e-6)
    assert opacity_gradient(range(1, len(BACKGROUNDS) + 1), channels=3) == pytest.approx(0, abs=1e-6)
