"""Background sphere: initial positions and colours of its splats, and the result of training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.config.recipe import DenseStart
from gs2d.data.scene import View
from gs2d.training.start.background_sphere import sphere_points
from gs2d.training.start.plane_sweep import sweep_views
from wall_scene import WALL, WIDTH, wall

SMALL = DenseStart(side=48, min_angle=1.0)


def test_splats_are_placed_where_images_show_pixels_of_unknown_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = wall()
    for name, value in (("SPLATS", 4_000), ("RADIUS", 2.0), ("SIZE", 0.5)):
        monkeypatch.setattr(f"gs2d.training.start.background_sphere.{name}", value)
    places, colors, normals, sizes = sphere_points(scene, sweep_views(scene, SMALL))
    center = np.mean([view.camera.center for view in scene.train], axis=0)
    assert scene.points is not None
    reach = np.linalg.norm(scene.points.points - center, axis=1).max()  # swept points lie next to the points
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
    bare = np.abs(colors - 0.5).max(axis=1) < 0.02  # the textureless third of the wall is grey
    assert bare.mean() > 0.5
    to_the_left = places[:, 0] / places[:, 2] * WALL < -1.2
    assert bare[to_the_left].mean() > 0.9


def test_images_with_an_alpha_channel_have_no_sphere() -> None:
    scene = wall()

    def with_alpha(view: View) -> View:
        color = np.rint(view.target((0.0, 0.0, 0.0)) * 255).astype(np.uint8)
        alpha = np.full((*color.shape[:2], 1), 255, dtype=np.uint8)
        return View.from_arrays(view.name, view.camera, np.concatenate([color, alpha], axis=2))

    cut = replace(scene, train=tuple(map(with_alpha, scene.train)))
    found = sphere_points(cut, sweep_views(scene, SMALL))
    assert [len(array) for array in found] == [0, 0, 0, 0]
