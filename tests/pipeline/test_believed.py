"""How far rendered depths are believed, and what of them a picture shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gs2d.pipeline.finish.run_images import shown_limits
from gs2d.pipeline.finish.trusted_depth import BEYOND, believed_reach, within_reach
from wall_scene import wall


def test_depths_past_what_points_reach_are_not_believed() -> None:
    scene = wall()
    reach = believed_reach(scene)
    assert reach is not None
    assert scene.points is not None
    camera = scene.train[0].camera
    depths = np.full((camera.height, camera.width), 0.5 * reach.radius)
    assert within_reach(reach, camera, depths).all()
    assert not within_reach(reach, camera, depths * 4).any()
    farthest = np.linalg.norm(scene.points.points - reach.center, axis=1).max()
    assert reach.radius <= BEYOND * max(farthest, scene.extent)
    assert believed_reach(replace(scene, points=None)) is None


def test_the_colours_of_a_depth_picture_are_spent_on_what_is_within_reach() -> None:
    scene = wall()
    view, reach = scene.train[0], believed_reach(scene)
    assert reach is not None
    depth = np.linspace(0.4, 0.5, view.camera.width)[None].repeat(view.camera.height, 0) * reach.radius
    depth[: len(depth) // 2] = 5 * reach.radius  # the background is on a sphere
    alpha = np.ones_like(depth)
    near, far = shown_limits(scene, view, depth, alpha)
    assert 0.39 * reach.radius < near < far < 0.51 * reach.radius
    near, far = shown_limits(replace(scene, points=None), view, depth, alpha)
    assert far > 4.9 * reach.radius
    near, far = shown_limits(scene, view, np.full_like(depth, 5 * reach.radius), alpha)  # nothing is within reach
    assert near > 4.9 * reach.radius
