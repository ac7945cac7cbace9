"""Splats around everything at the start: where they stand, in what colour, and what training makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gs2d.config.presets import two_dgs
from gs2d.config.protocols import GENERIC
from gs2d.config.robust import BackgroundSphere, DenseStart, Removal
from gs2d.config.schedule import scale_schedule
from gs2d.data.scene import Scene, View
from gs2d.evaluation.images import psnr_float
from gs2d.render.api import rasterize
from gs2d.training.background_sphere import sphere_points
from gs2d.training.plane_sweep import sweep_views
from gs2d.training.trainer import Trainer
from wall_scene import WALL, WIDTH, wall

SMALL = DenseStart(side=48, planes=32, min_angle=1.0, cell=3.0)
SPHERE = BackgroundSphere(splats=4_000, radius=2.0, size=0.5)


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
