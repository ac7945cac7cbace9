"""Diverging training stops with a message that names the location and the cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from fake_backends import altered
from gs2d.config.presets import surface
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import ALL, LearningRates, Recipe
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene
from gs2d.errors import DataError, DivergedError, RecipeError
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from train_toys import random_splats, short, train


def test_bad_recipes_and_empty_scenes_are_refused_before_training(scene: Scene) -> None:
    with pytest.raises(RecipeError, match="at least one stage"):
        Trainer(scene, Recipe("r", ()), GENERIC, backend="reference")
    with pytest.raises(DataError, match="no training views"):
        Trainer(replace(scene, train=()), short(), GENERIC, backend="reference")


def spoiled(spoil: Callable[[Splats, RenderOutput], RenderOutput], calls: int) -> Backend:
    """Return the reference backend with the output of one render call replaced."""
    count = [0]

    def rasterize(
        splats: Splats, camera: Camera, settings: RasterSettings, probe: torch.Tensor | None = None
    ) -> RenderOutput:
        count[0] += 1
        output = PLAIN.rasterize(splats, camera, settings, probe)
        return spoil(splats, output) if count[0] == calls else output

    return altered(PLAIN, rasterize=rasterize)


def test_nan_in_the_loss_stops_with_stage_and_iteration(scene: Scene) -> None:
    bad = spoiled(lambda _, out: replace(out, color=out.color * float("nan")), 4)
    with pytest.raises(DivergedError, match="iteration"):
        train(scene, short(), backend=bad)


@pytest.mark.parametrize("name", ALL)
def test_nan_in_a_gradient_names_the_attribute(scene: Scene, name: str) -> None:
    def spoil(splats: Splats, output: RenderOutput) -> RenderOutput:
        def hook(gradient: torch.Tensor) -> torch.Tensor:
            spoiled_gradient = gradient.clone()
            spoiled_gradient.view(-1)[-1] = float("inf")
            return spoiled_gradient

        getattr(splats, name).register_hook(hook)
        return output

    with pytest.raises(DivergedError, match=f"iteration 2 of stage 'surface': the gradient of {name} is NaN"):
        train(scene, short(), backend=spoiled(spoil, 2))


def test_nan_in_a_parameter_stops_training(scene: Scene) -> None:
    splats = random_splats(5)
    splats.log_scales[3, 1] = float("nan")
    state = TrainState(splats, torch.Generator())
    with pytest.raises(DivergedError, match="log_scales is NaN"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state).run()


def test_an_update_to_infinity_stops_training(scene: Scene) -> None:
    wild = replace(surface(), iterations=3, densify=None, lr=LearningRates(sh0=1e39))
    with pytest.raises(DivergedError, match="iteration"):
        train(scene, Recipe("r", (wild,)))
