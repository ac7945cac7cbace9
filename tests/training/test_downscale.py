"""Stages that train on smaller photographs: the same as a smaller capture, and nothing else gets smaller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LossTerm, Recipe
from gs2d.data.scene import Scene, View
from gs2d.errors import RecipeError
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from train_toys import SIZE, compared, same, short, train


def at_half(recipe: Recipe, *stages: int) -> Recipe:
    """The recipe with some of its stages at half of the size."""
    changed = (replace(s, downscale=2) if i in stages else s for i, s in enumerate(recipe.stages))
    return replace(recipe, stages=tuple(changed))


def first_stage(recipe: Recipe) -> Recipe:
    return replace(recipe, stages=recipe.stages[:1])


def cut_out(scene: Scene) -> Scene:
    """The scene with an alpha channel, and a mask, in each of its photographs."""
    views = []
    for view in scene.train:
        alpha = np.full((SIZE, SIZE, 1), 255, np.uint8)
        alpha[:, : SIZE // 3] = 0
        mask = np.ones((SIZE, SIZE), dtype=bool)
        mask[: SIZE // 4] = False
        views.append(View.from_arrays(view.name, view.camera, np.concatenate([view.image(), alpha], axis=2), mask))
    return replace(scene, train=tuple(views))


def with_silhouettes(recipe: Recipe) -> Recipe:
    stages = (replace(stage, losses=(*stage.losses, LossTerm("silhouette", 0.1))) for stage in recipe.stages)
    return replace(recipe, stages=tuple(stages))


@pytest.mark.parametrize("recipe", [short(), compared(), with_silhouettes(short())], ids=["plain", "views", "alpha"])
def test_a_stage_at_half_the_size_trains_what_a_capture_of_half_the_size_does(
    scene: Scene, backend: str, recipe: Recipe
) -> None:
    scene, recipe = cut_out(scene), first_stage(recipe)
    small, _ = train(scene.downscaled(2), recipe, backend=backend)
    stage, _ = train(scene, at_half(recipe, 0), backend=backend)
    full, _ = train(scene, recipe, backend=backend)
    assert same(small.splats, stage.splats)
    assert not same(full.splats, stage.splats)


def test_stages_look_at_the_size_that_they_say_and_scores_at_the_full_one(scene: Scene, backend: str) -> None:
    trainer = Trainer(scene, at_half(short(), 0, 2), GENERIC, backend=backend)
    seen = []
    for index in range(3):
        trainer.enter(index)
        target = trainer._targets[0]
        seen.append((trainer._whole.camera(trainer.state, 0).width, *target.image.shape[:2]))
        while trainer.state.step < trainer.recipe.stages[index].iterations:
            trainer.step()
        trainer._finish(trainer.recipe.stages[index])
    assert seen == [(12, 12, 12), (24, 24, 24), (12, 12, 12)]
    assert trainer.scene.train[0].camera.width == 24


def test_a_run_of_several_sizes_resumes_to_the_same_bytes(scene: Scene, backend: str) -> None:
    recipe = at_half(short(), 0, 2)
    recipe = replace(recipe, stages=(replace(recipe.stages[0], halve_at=(5,)), *recipe.stages[1:]))
    resumed_everywhere(scene, recipe, backend)


def test_photographs_that_would_be_too_small_are_refused_before_training(scene: Scene) -> None:
    recipe = short()
    recipe = replace(recipe, stages=(replace(recipe.stages[0], downscale=3), *recipe.stages[1:]))
    message = (
        "stage 'surface': downscale must leave 11 px of photographs whose shortest side is 24 px, got 3; "
        "--set surface.downscale=2"
    )
    with pytest.raises(RecipeError) as caught:
        Trainer(scene, recipe, GENERIC, backend="reference")
    assert str(caught.value) == message
