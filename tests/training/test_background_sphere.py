"""Splats around everything at the start: where they stand, in what colour, and what training makes of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.config.presets import get_recipe, two_dgs
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe, validate
from gs2d.config.robust import BackgroundSphere, DenseStart, Removal, StartFit
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.data.scene import Scene, View
from gs2d.errors import RecipeError
from gs2d.evaluation.images import psnr_float
from gs2d.render.api import rasterize
from gs2d.training.background_sphere import evenly_on_sphere, sphere_points
from gs2d.training.plane_sweep import start_points, sweep_views
from gs2d.training.trainer import Trainer
from wall_scene import WALL, WIDTH, wall

SMALL = DenseStart(side=48, planes=32, min_angle=1.0, cell=3.0)
SPHERE = BackgroundSphere(splats=4_000, radius=2.0, size=0.5)


def test_directions_share_the_sphere_evenly() -> None:
    directions = evenly_on_sphere(500)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert np.abs(directions.mean(axis=0)).max() < 0.01
    cosines = directions @ directions.T - 2 * np.eye(500)
    nearest = np.arccos(cosines.max(axis=1))
    spacing = np.sqrt(4 * np.pi / 500)
    assert nearest.min() > 0.7 * spacing
    assert nearest.max() < 1.3 * spacing


def test_they_stand_where_photographs_show_what_no_depth_is_known_of() -> None:
    scene = wall()
    places, colors, normals, sizes = sphere_points(scene, sweep_views(scene, SMALL), SPHERE)
    center = np.mean([view.camera.center for view in scene.train], axis=0)
    assert scene.points is not None
    reach = np.linalg.norm(scene.points.points - center, axis=1).max()  # swept places lie beside the points
    radius = np.linalg.norm(places - center, axis=1)
    np.testing.assert_allclose(radius, radius[0])
    assert 1.9 * reach < radius[0] < 2.3 * reach
    np.testing.assert_allclose(normals, -(places - center) / radius[:, None])
    np.testing.assert_allclose(sizes, 0.5 * np.sqrt(4 * np.pi / 4_000) * radius)
    inside = np.zeros(len(places), dtype=bool)
    for view in scene.train:
        x, z = view.camera.project(places)
        inside |= (z > 0) & (x[:, 0] >= 0) & (x[:, 0] < WIDTH)
    assert inside.all()
    bare = np.abs(colors - 0.5).max(axis=1) < 0.02  # the bare third of the wall is grey
    assert bare.mean() > 0.5
    to_the_left = places[:, 0] / places[:, 2] * WALL < -1.2
    assert bare[to_the_left].mean() > 0.9


def test_there_are_none_where_an_alpha_channel_says_what_is_empty() -> None:
    scene = wall()

    def with_alpha(view: View) -> View:
        color = np.rint(view.target((0.0, 0.0, 0.0)) * 255).astype(np.uint8)
        alpha = np.full((*color.shape[:2], 1), 255, dtype=np.uint8)
        return View.from_arrays(view.name, view.camera, np.concatenate([color, alpha], axis=2))

    cut = replace(scene, train=tuple(map(with_alpha, scene.train)))
    found = sphere_points(cut, sweep_views(scene, SMALL), SPHERE)
    assert [len(array) for array in found] == [0, 0, 0, 0]


def test_what_a_mask_leaves_out_gives_no_colour() -> None:
    scene = wall()
    sweep = sweep_views(scene, SMALL)
    masked = replace(sweep, views=[replace(view, usable=np.zeros_like(view.usable)) for view in sweep.views])
    assert len(sphere_points(scene, masked, SPHERE)[0]) == 0


@pytest.mark.parametrize("fit", [None, StartFit()])
def test_only_they_have_a_size_of_their_own_in_a_start_that_is_not_fitted(fit: StartFit | None) -> None:
    scene, settings = wall(), replace(SMALL, fit=fit)
    sweep = sweep_views(scene, settings)
    around = sphere_points(scene, sweep, SPHERE)
    plain, more = start_points(scene, sweep, settings), start_points(scene, sweep, settings, around)
    count = len(around[0])
    assert len(more) == len(plain) + count
    assert more.sizes is not None
    np.testing.assert_array_equal(more.points[:-count], plain.points)
    np.testing.assert_array_equal(more.sizes[-count:], around[3])
    if fit is None:
        assert plain.sizes is None
        assert not more.sizes[:-count].any()


def trained(scene: Scene, settings: DenseStart) -> tuple[float, int]:
    """PSNR of the bare part of a photograph after a few iterations, and how many splats began."""
    made = scale_schedule(two_dgs(), 60 / 30_000)
    stage = replace(made.stages[0], densify=None, sh_interval=0)
    recipe = replace(made, stages=(stage,), sh_degree=0, dense_start=settings, removal=Removal(decay=0.0, dropout=0.0))
    trainer = Trainer(scene, recipe, GENERIC, backend="auto")
    count = len(trainer.splats)
    trainer.run()
    view = scene.train[2]
    with torch.no_grad():
        color = rasterize(trainer.splats, view.camera, trainer.settings, backend="auto").color
    target = torch.from_numpy(view.target((0.0, 0.0, 0.0)))
    bare = (target - 128 / 255).abs().amax(dim=2) < 1e-3
    assert 0.1 < bare.double().mean() < 0.5
    return psnr_float(color, target, bare), count


def test_training_shows_with_them_what_it_cannot_without() -> None:
    """The bare third of the wall, of which no photographs agree, on a background of black."""
    without, fewer = trained(wall(), SMALL)
    filled, more = trained(wall(), replace(SMALL, sphere=SPHERE))
    assert more > fewer
    assert filled > without + 6


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"splats": 0}, "dense_start.sphere.splats must be"),
        ({"radius": 0.0}, "dense_start.sphere.radius must be positive"),
        ({"size": -1.0}, "dense_start.sphere.size must be"),
    ],
)
def test_a_sphere_that_cannot_be_is_refused(values: dict[str, Any], said: str) -> None:
    start = DenseStart(sphere=BackgroundSphere(**values))
    with pytest.raises(RecipeError, match=said):
        validate(replace(two_dgs(), dense_start=start))


def test_a_sphere_is_a_value_of_the_recipe_that_is_written_and_left_out_by_name() -> None:
    recipe = get_recipe("best")
    assert recipe.dense_start is not None
    assert recipe.dense_start.sphere == BackgroundSphere()
    assert from_json(to_json(recipe)) == recipe
    changed: Recipe = apply_overrides(recipe, ["dense_start.sphere.splats=300"])
    assert changed.dense_start is not None
    assert changed.dense_start.sphere == BackgroundSphere(splats=300)
    without: Recipe = apply_overrides(recipe, ["dense_start.sphere=null"])
    assert without.dense_start == replace(recipe.dense_start, sphere=None)
