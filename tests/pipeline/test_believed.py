"""Limits of rendered depth, in meshes and in images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gs2d.pipeline.finish.trusted_depth import BEYOND, believed_reach, within_reach
from wall_scene import wall


def test_depths_beyond_the_sparse_points_are_ignored() -> None:
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
