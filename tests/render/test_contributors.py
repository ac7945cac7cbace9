"""The first contributors of points agree with the images, and have their gradients."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import gs2d
from gs2d.core.sh import C0
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import ShapeError
from gs2d.render import reference_contributors
from render_scenes import front_camera, splat
from splat_scenes import a_scene
from tiny import ball_cameras

CAMERA = ball_cameras(1, 20)[0]
ALL = torch.stack(torch.meshgrid(torch.arange(20) + 0.5, torch.arange(20) + 0.5, indexing="xy"), dim=2).reshape(-1, 2)


def scene() -> gs2d.Splats:
    splats = a_scene(30, 0)
    splats.means[:] = 0.3 * (splats.means - 1)
    splats.log_scales[:] += 3
    return splats


def test_all_contributors_of_all_pixels_blend_to_the_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference_contributors, "MAX_PAIRS", 30 * 70)  # several parts
    splats = scene()
    image = gs2d.rasterize(splats, CAMERA, backend="reference")
    found = gs2d.first_contributors(splats, CAMERA, ALL, count=30)
    assert found.ids.shape == (400, 30)
    assert ((found.ids >= 0) == (found.weights > 0)).all()
    colors = (0.5 + C0 * splats.sh0[:, 0]).clamp(min=0)[found.ids.clamp(min=0)]
    w = found.weights[..., None]
    assert found.weights.sum() > 100
    assert_close(found.weights.sum(dim=1), image.alpha.reshape(-1))
    assert_close((w * colors).sum(dim=1), image.color.reshape(-1, 3))
    assert_close((w * found.normal).sum(dim=1), image.normal.reshape(-1, 3))
    assert_close((found.weights * found.depth).sum(dim=1), (image.depth_mean * image.alpha).reshape(-1))


def test_fewer_are_the_first_in_blending_order() -> None:
    everything, first = (gs2d.first_contributors(scene(), CAMERA, ALL, count=count) for count in (30, 2))
    for whole, part in zip(everything, first, strict=True):
        assert torch.equal(whole[:, :2], part)
    order = (scene().means - torch.from_numpy(CAMERA.center).float()) @ torch.from_numpy(CAMERA.forward).float()
    depth = order[first.ids.clamp(min=0)]
    assert (depth[:, 0] <= depth[:, 1])[first.ids[:, 1] >= 0].all()
    assert (everything.ids[:, 2] >= 0).any()


def test_uv_and_depth_are_the_point_of_the_splat_that_is_projected_to_the_pixel() -> None:
    splats = scene()
    found = gs2d.first_contributors(splats, CAMERA, ALL, count=3)
    rows, ranks = ((found.uv != 0).any(dim=2) & (found.ids >= 0)).nonzero(as_tuple=True)
    assert len(rows) > 50
    ids, uv = found.ids[rows, ranks], found.uv[rows, ranks]
    frames = quats_to_matrices(splats.quats[ids])[:, :, :2] * splats.scales[ids][:, None]
    points = splats.means[ids] + (frames @ uv[:, :, None])[..., 0]
    pixels, depth = CAMERA.project(points.double().numpy())
    assert_close(torch.from_numpy(pixels).float(), ALL[rows], atol=1e-3, rtol=0)
    assert_close(torch.from_numpy(depth).float(), found.depth[rows, ranks], atol=1e-4, rtol=0)


def test_gradients_are_those_of_the_image() -> None:
    gradients = []
    for whole in (True, False):
        splats = scene()
        for _, tensor in splats.items():
            tensor.requires_grad_()
        if whole:
            image = gs2d.rasterize(splats, CAMERA, backend="reference")
            (image.alpha * image.depth_mean).sum().backward()
        else:
            found = gs2d.first_contributors(splats, CAMERA, ALL, count=30)
            (found.weights * found.depth).sum().backward()
        gradients.append([splats.means.grad, splats.quats.grad, splats.log_scales.grad, splats.opacity_logits.grad])
    for one, other in zip(*gradients, strict=True):
        assert one.abs().sum() > 0
        assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_empty_scenes_and_wrong_points() -> None:
    behind = gs2d.first_contributors(splat((0, 0, -2)), front_camera(), torch.tensor([[4.5, 4.5]]), count=3)
    assert behind.ids.tolist() == [[-1, -1, -1]]
    assert not behind.normal.any()
    none = gs2d.first_contributors(splat(), front_camera(), torch.zeros(0, 2))
    assert none.uv.shape == (0, 8, 2)
    for points, count in ((torch.zeros(3), 8), (torch.zeros(1, 2).double(), 8), (torch.zeros(1, 2), 0)):
        with pytest.raises(ShapeError, match="points"):
            gs2d.first_contributors(splat(), front_camera(), points, count)
