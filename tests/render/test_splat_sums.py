"""Values of pixels summed for each splat with its blending weights."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import gs2d
from gs2d.errors import ShapeError
from gs2d.render.backends import Backend
from render_scenes import front_camera, splat
from splat_scenes import a_scene
from tiny import ball_cameras


@pytest.mark.parametrize("channels", [1, 2, 7])
def test_the_sums_are_those_of_the_weights_of_each_splat(backend: Backend, channels: int) -> None:
    """The weights of a splat are the image in which it alone is white; a background would add to it."""
    splats = a_scene(12, 1)
    splats.means[:] = 0.3 * (splats.means - 1)
    splats.log_scales[:] += 3
    camera = ball_cameras(1, 24)[0]
    values = torch.randn(24, 24, channels, generator=torch.Generator().manual_seed(0))
    settings = gs2d.RasterSettings(background=(1.0, 0.5, 0.0))
    sums, weights = gs2d.splat_sums(splats, camera, values, settings, backend=backend)
    assert (sums.shape, weights.shape) == ((12, channels), (12,))
    assert not sums.requires_grad
    plain = replace(splats, sh0=torch.zeros(12, 1, 3), shN=splats.shN[:, :0])
    for i in range(12):
        plain.sh0[:] = 0
        plain.sh0[i] = 1
        image = gs2d.rasterize(plain, camera, gs2d.RasterSettings(sh_degree=-1), backend=backend).color[..., :1]
        torch.testing.assert_close(sums[i], (image * values).sum(dim=(0, 1)), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(weights[i], image.sum(), rtol=1e-4, atol=1e-4)
    assert weights.sum() > 50
    torch.testing.assert_close(weights.sum(), gs2d.rasterize(splats, camera, backend=backend).alpha.sum())


def test_labels_of_an_image_reach_the_splats_that_show_them() -> None:
    """The near splat hides the far one in the middle; a splat behind the camera gets nothing."""
    near, far = splat((0, 0, 2), (0.3, 0.3), opacity=0.999), splat((0, 0, 4), (3.0, 3.0), opacity=0.999)
    scene = near.followed_by(far).followed_by(splat((0, 0, -2)))
    camera = front_camera(41, 41, 40.0)
    labels = torch.zeros(41, 41, 2)
    rows, columns = torch.meshgrid(torch.arange(41) - 20, torch.arange(41) - 20, indexing="ij")
    inside = rows**2 + columns**2 < 12**2  # two standard deviations of the near splat
    labels[..., 0], labels[..., 1] = inside.float(), (~inside).float()
    sums, weights = gs2d.splat_sums(scene, camera, labels)
    assert sums[0].argmax() == 0
    assert sums[1].argmax() == 1
    assert weights[2] == 0


def test_values_of_another_shape_or_dtype_are_refused() -> None:
    camera = front_camera()
    wrong = [torch.zeros(9, 8, 1), torch.zeros(9, 9), torch.zeros(9, 9, 1).double(), torch.full((9, 9, 1), torch.nan)]
    for values in wrong:
        with pytest.raises(ShapeError, match="values"):
            gs2d.splat_sums(splat(), camera, values)
