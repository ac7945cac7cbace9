"""White sheets: splats of the background's colour that normal consistency rewards, and their prevention."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from gs2d.config.presets import get_recipe
from gs2d.config.protocols import NERF_SYNTHETIC
from gs2d.config.recipe import LossTerm, Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.data.load import load_scene
from gs2d.data.scene import Scene
from gs2d.render.api import rasterize
from gs2d.training.trainer import Trainer
from tiny import RADIUS, write_capture
from train_toys import backends

SCHEDULE, WEIGHT = 0.05, 0.5  # 1500 iterations, NC from 350: enough for sheets at ten times the paper's weight


@dataclass(frozen=True)
class Outcome:
    """Length of the longest splat in world units, mean alpha of the background, PSNR of training views in dB."""

    longest: float
    covered: float
    psnr: float


def recipe_with(where: str) -> Recipe:
    def changed(term: LossTerm) -> LossTerm:
        return replace(term, weight=WEIGHT, options={"where": where}) if term.kind == "normal_consistency" else term

    recipe = scale_schedule(get_recipe("2dgs"), SCHEDULE)
    (stage,) = recipe.stages
    return replace(recipe, stages=(replace(stage, losses=tuple(map(changed, stage.losses))),), init_points=300)


def outcome(scene: Scene, recipe: Recipe) -> Outcome:
    trainer = Trainer(scene, recipe, NERF_SYNTHETIC, backend="cpu")
    splats, covered, errors = trainer.run(), [], []
    with torch.no_grad():
        for view in scene.train:
            seen, alpha = rasterize(splats, view.camera, trainer.settings, backend="cpu"), view.alpha()
            assert alpha is not None
            covered.append(float(seen.alpha[torch.from_numpy(alpha < 0.5)].mean()))
            target = torch.from_numpy(view.target(NERF_SYNTHETIC.background).copy())
            errors.append(float((seen.color - target).square().mean()))
    return Outcome(float(splats.scales.max()), float(np.mean(covered)), float(-10 * np.log10(errors).mean()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return twelve images of a ball before white, with alpha."""
    return load_scene(write_capture(tmp_path_factory.mktemp("ball") / "capture", train=12, test=1, size=32))


@pytest.fixture(scope="module")
def with_sheets(scene: Scene) -> Outcome:
    if "cpu" not in backends():
        pytest.skip("the native library is not built")
    return outcome(scene, recipe_with("image"))


def test_normal_consistency_of_the_whole_image_makes_sheets(with_sheets: Outcome) -> None:
    """Confirms that sheets appear without prevention; otherwise the other tests prove nothing."""
    assert with_sheets.longest > 2 * RADIUS  # longer than the ball's diameter
    assert with_sheets.covered > 0.2


@pytest.mark.parametrize("cure", ["object", "silhouette"])
def test_object_weights_or_a_silhouette_loss_prevent_sheets(scene: Scene, with_sheets: Outcome, cure: str) -> None:
    recipe = recipe_with("object") if cure == "object" else recipe_with("image").with_loss(LossTerm("silhouette", 0.1))
    found = outcome(scene, recipe)
    assert found.longest < RADIUS
    assert found.covered < with_sheets.covered / 2
    assert found.psnr > with_sheets.psnr + 0.5
