"""Initial splats."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.data.scene import PointCloud, Scene
from gs2d.errors import DataError, ProtocolError
from gs2d.training.start.initialize import Initial, initial_splats, usable_points


def start(scene: Scene, *, near: float = 0.1, degree: int = 3, count: int = 500, seed: int = 0) -> Initial:
    generator = torch.Generator().manual_seed(seed)
    return initial_splats(scene, sh_degree=degree, random_points=count, near=near, generator=generator)


def with_points(scene: Scene, points: list[list[float]], colors: np.ndarray | None = None) -> Scene:
    return replace(scene, points=PointCloud(np.array(points, dtype=np.float64), colors))


def test_points_give_places_colours_opacity_and_scales(scene: Scene) -> None:
    colors = np.array([[255, 0, 127], [0, 0, 0], [255, 255, 255], [10, 20, 30]], np.uint8)
    initial = start(with_points(scene, [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]], colors))
    splats = initial.splats
    assert (initial.source, initial.dropped, len(splats)) == ("points", 0, 4)
    torch.testing.assert_close(splats.means[:, 0], torch.tensor([0.0, 0.1, 0.2, 0.3]))
    torch.testing.assert_close(splats.opacities, torch.full((4,), 0.1))
    # the three other points: squared distances 1 + 4 + 9 and 1 + 1 + 4 (in units of 0.01)
    outer, inner = 0.1 * math.sqrt(14 / 3), 0.1 * math.sqrt(2)
    expected = torch.tensor([outer, inner, inner, outer])
    torch.testing.assert_close(splats.scales, expected[:, None].repeat(1, 2))
    rgb = 0.5 + 0.28209479177387814 * splats.sh0[:, 0]
    torch.testing.assert_close(rgb, torch.as_tensor(colors) / 255.0, atol=1e-6, rtol=0)
    assert not splats.shN.any()
    assert splats.shN.shape == (4, 15, 3)


def test_unusable_points_are_dropped(scene: Scene) -> None:
    beside_camera = scene.train[0].camera.center + 0.05
    good = [[0, 0, 0], [0.1, 0, 0]]
    cloud = with_points(scene, [*good, list(beside_camera), [float("nan"), 0, 0], [float("inf"), 0, 0]])
    assert usable_points(cloud.points.points, cloud, 0.1).tolist() == [True, True, False, False, False]
    assert start(cloud).dropped == 3
    behind = replace(cloud, train=scene.train[:1])  # one camera at x = 3 that looks at the origin
    assert usable_points(np.array([[9.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), behind, 0.1).tolist() == [False, True]


def test_without_points_splats_are_random_in_the_bounds_and_grey(scene: Scene) -> None:
    bare = replace(scene, points=None, bounds=np.array([[-0.5, -0.2, 0.0], [0.5, 0.2, 0.1]]))
    initial = start(bare)
    splats = initial.splats
    assert (initial.source, len(splats)) == ("random", 500)
    assert (splats.means.amin(dim=0) >= torch.tensor([-0.5, -0.2, 0.0])).all()
    assert (splats.means.amax(dim=0) <= torch.tensor([0.5, 0.2, 0.1])).all()
    # the mean of 500 uniform numbers is within 0.06 of the centre of an interval of length 1 (4.6 sigma)
    assert splats.means.mean(dim=0).sub(torch.tensor([0.0, 0.0, 0.05])).abs().max() < 0.06
    assert not splats.sh0.any()
    assert torch.equal(start(bare).splats.means, splats.means)
    assert not torch.equal(start(bare, seed=1).splats.means, splats.means)


def test_a_near_plane_beyond_the_scene_is_refused(scene: Scene) -> None:
    with pytest.raises(ProtocolError, match="near = 50"):
        start(scene, near=50.0)


def test_points_behind_all_cameras_are_refused(scene: Scene) -> None:
    one = replace(with_points(scene, [[9.0, 0, 1], [10.0, 0, 1]]), train=scene.train[:1])
    with pytest.raises(DataError, match="fewer than 2"):
        start(one)
