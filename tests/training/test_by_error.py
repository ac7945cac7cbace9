"""Growth by the error of several views: what a splat is drawn on, who is asked, resume to the same bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import GradDensify, Recipe
from gs2d.data.scene import Scene, View
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training.blended_sums import blended_sums
from gs2d.training.densify.by_error import MultiViewErrorDensifier
from gs2d.training.objective import ViewResidual
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from train_toys import SIZE, VIEWS, random_splats, short


def by_error(views: int = 3, power: float = 1.0) -> Recipe:
    recipe = short()
    given = recipe.stages[0].densify
    assert isinstance(given, GradDensify)
    first = replace(recipe.stages[0], densify=replace(given, error_views=views, error_power=power))
    return replace(recipe, stages=(first, *recipe.stages[1:]))


def entered(scene: Scene, recipe: Recipe, backend: str) -> tuple[Trainer, MultiViewErrorDensifier]:
    trainer = Trainer(scene, recipe, GENERIC, backend=backend)
    trainer.enter(0)
    densifier = trainer._densifiers[0]
    assert isinstance(densifier, MultiViewErrorDensifier)
    return trainer, densifier


def test_weights_of_all_splats_add_up_to_alpha_and_weighted_errors_to_that_of_the_picture(
    scene: Scene, backend: str
) -> None:
    trainer, _ = entered(scene, by_error(), backend)
    splats, camera = random_splats(30, seed=5), scene.train[0].camera
    alpha = rasterize(splats, camera, RasterSettings(), backend=backend).alpha.detach()
    error = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    found = ViewResidual(error, camera, RasterSettings(background=(0.3, 0.9, 0.1)))
    weighted, weights = blended_sums(splats, found, trainer.backend)
    assert weights.sum().item() == pytest.approx(alpha.sum().item(), rel=1e-5)
    assert weighted.sum().item() == pytest.approx((alpha * error).sum().item(), rel=1e-5)
    # of one splat alone by hand: its alpha in each pixel
    one = splats.rows(torch.tensor([4]))
    alpha = rasterize(one, camera, RasterSettings(), backend=backend).alpha.detach()
    weighted, weights = blended_sums(one, found, trainer.backend)
    assert weighted.item() == pytest.approx((alpha * error).sum().item(), rel=1e-5)
    assert weights.item() == pytest.approx(alpha.sum().item(), rel=1e-5)


def spoiled(scene: Scene, *, masked: bool = False) -> Scene:
    """The scene with photographs that are wrong in their left third, which a mask may leave out."""
    views = []
    for view in scene.train:
        image = view.image().copy()
        image[:, : SIZE // 3] = 255 - image[:, : SIZE // 3]
        mask = np.ones((SIZE, SIZE), dtype=bool)
        mask[:, : SIZE // 3] = not masked
        views.append(View.from_arrays(view.name, view.camera, image, mask))
    return replace(scene, train=tuple(views))


def test_who_is_drawn_where_pictures_are_wrong_is_asked_first(scene: Scene, backend: str) -> None:
    trainer, densifier = entered(scene, by_error(views=VIEWS), backend)
    trainer.state.splats = random_splats(80, seed=3)  # what the photographs are of
    fair = densifier.urgency(trainer.state, 3)
    trainer.scene = spoiled(scene)
    trainer._downscale = 0
    trainer._look_at(1)
    wrong = densifier.urgency(trainer.state, 3)
    seen = [densifier.surroundings.blame(trainer.state, 3, i) for i in range(VIEWS)]
    drawn_on_it = torch.stack([weighted / weights.clamp(min=1e-6) for weighted, weights in seen]).mean(dim=0)
    order = drawn_on_it.argsort()
    assert wrong[order[-20:]].mean() > 3 * wrong[order[:20]].mean()
    assert not torch.equal(fair, wrong)
    # in units of the median, to a power
    assert wrong[wrong > 0].median().item() == pytest.approx(1.0, rel=0.02)
    densifier._options = replace(densifier._options, error_power=0.5)
    torch.testing.assert_close(densifier.urgency(trainer.state, 3), wrong.sqrt(), rtol=1e-4, atol=1e-5)


def test_a_run_that_grows_by_error_resumes_to_the_same_bytes(scene: Scene, backend: str) -> None:
    resumed_everywhere(scene, by_error(views=2), backend)
