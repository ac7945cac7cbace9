"""Levels of detail: what a merged pair keeps, which pairs are merged, and that what is drawn stays alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.contrib.formats.levels import halved
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.io.gaussians import Gaussians, sigmoid
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings

UP = np.array([0.0, -1.0, 0.0])


def disks(means: list[list[float]], scale: float = 0.1, alpha: float = 0.5) -> Gaussians:
    """Round disks in planes z = constant, grey."""
    n = len(means)
    return Gaussians.of(
        Splats(
            means=torch.tensor(means),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
            log_scales=torch.full((n, 2), math.log(scale)),
            opacity_logits=torch.full((n,), math.log(alpha / (1 - alpha))),
            sh0=torch.zeros(n, 1, 3),
            shN=torch.zeros(n, 3, 3),
        )
    )


def test_two_disks_merge_with_area_centre_covariance_and_mean_colour() -> None:
    """Of masses 3 : 1 (scales 0.1 x 0.1 and, turned a quarter, 0.1 x 0.1 of a third of the opacity), 0.2 apart in x."""
    two = disks([[0.0, 0, 1], [0.2, 0, 1]], alpha=0.6)
    two = replace(two, opacity_logits=np.log(np.array([0.6 / 0.4, 0.2 / 0.8], np.float32)))
    two = replace(two, quats=np.array([[1, 0, 0, 0], [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]], np.float32))
    two.sh0[0], two.shN[1, 2] = 1.0, 2.0
    one, cells = halved(two, np.array([7, 7]))
    assert cells.tolist() == [7]
    np.testing.assert_allclose(one.means, [[0.05, 0, 1]], atol=1e-6)
    # In x: 0.01 and 3/4 * 1/4 * 0.2^2 between the centres; in y 0.01 alone.
    scales = np.sqrt([0.01 + 0.0075, 0.01])
    np.testing.assert_allclose(np.exp(one.log_scales[0, :2]), scales, rtol=1e-5)
    # Both at once: 0.6 * 0.2 of two areas 0.01, whose product has the spread 0.02 and the height exp(-0.2^2 / 0.04).
    both = 0.6 * 0.2 * 0.01**2 / 0.02 * math.exp(-1)
    np.testing.assert_allclose(sigmoid(one.opacity_logits), (0.8 * 0.01 - both) / scales.prod(), rtol=1e-5)
    np.testing.assert_allclose(one.sh0[0], 0.75, rtol=1e-6)
    np.testing.assert_allclose(one.shN[0], [[0] * 3, [0] * 3, [0.5] * 3], atol=1e-6)
    camera = look_at(np.array([0.05, 0, -1.0]), np.array([0.05, 0, 1.0]), UP, width=64, height=64, fx=200.0)
    normal = rasterize(one.to_surfels("a"), camera, RasterSettings(sh_degree=1)).normal[32, 32]
    assert abs(float(normal[2])) > 0.1  # it lies in the plane of the two, and is seen


@pytest.mark.usefixtures("native")
def test_half_the_disks_of_a_textured_wall_look_similar() -> None:
    """A grid of 60 x 60 disks whose colours change slowly; the same of every second disk alone has holes."""
    side = np.linspace(-1, 1, 60)
    x, y = np.meshgrid(side, side)
    g = disks(np.stack([x, y, np.full_like(x, 2)], axis=-1).reshape(-1, 3).tolist(), scale=0.025, alpha=0.95)
    g.sh0[:] = np.stack([np.sin(3 * x), np.cos(2 * y), x * y], axis=-1).reshape(-1, 3)
    camera = look_at(np.zeros(3), np.array([0, 0, 2.0]), UP, width=160, height=160, fx=160.0)

    def drawn(some: Gaussians) -> np.ndarray:
        return rasterize(some.to_surfels("a"), camera, RasterSettings(sh_degree=1)).color.clamp(0, 1).numpy()

    def psnr(some: Gaussians) -> float:
        return float(-10 * np.log10(np.square(drawn(some) - drawn(g)).mean()))

    found, cells = halved(g, np.zeros(len(g), int))
    assert len(found) == 1800
    assert psnr(found) > 36
    assert psnr(found) > psnr(g.rows(np.arange(len(g)) % 2 == 0)) + 10
    assert psnr(halved(found, cells)[0]) > 32
