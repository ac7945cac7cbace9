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
from splat_scenes import a_scene

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


def test_two_disks_become_one_with_their_area_centre_covariance_and_mean_colour() -> None:
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


def test_a_disk_that_would_be_more_than_opaque_is_larger() -> None:
    """Two in one place: 2 * 0.9 * 0.01 less 0.9^2 * 0.01^2 / 0.02, over 0.01."""
    one, _ = halved(disks([[0.0, 0, 1], [0.0, 0, 1]], alpha=0.9), np.zeros(2, int))
    np.testing.assert_allclose(sigmoid(one.opacity_logits), 0.999, rtol=1e-4)
    np.testing.assert_allclose(np.exp(one.log_scales[0, :2]), 0.1 * math.sqrt(1.395 / 0.999), rtol=1e-4)


def test_alike_disks_are_merged_before_others() -> None:
    """Six in a row, 0.1 apart but for one far behind: of three mergings each pairs like with like."""
    g = disks([[0.0, 0, 1], [0.1, 0, 1], [0.2, 0, 1], [0.3, 0, 1], [0.25, 0, 1.6], [0.35, 0, 1.6]])
    g.sh0[:2] = 2.0
    found, _ = halved(g, np.zeros(6, int))
    order = np.lexsort((found.means[:, 0], found.means[:, 2]))
    np.testing.assert_allclose(found.means[order], [[0.05, 0, 1], [0.25, 0, 1], [0.3, 0, 1.6]], atol=1e-6)
    np.testing.assert_allclose(found.sh0[order, 0], [2, 0, 0], atol=1e-6)


def test_what_is_small_and_faint_goes_first() -> None:
    g = disks([[x, 0, 1] for x in (0.0, 0.1, 0.2, 0.3, 5.0, 5.001)])
    g.log_scales[4:, :2] = math.log(0.001)
    g.opacity_logits[4:] = -4.0
    g.sh0[4] = 3.0  # its colour differs, but who sees it
    found, _ = halved(g, np.zeros(6, int))
    assert len(found) == 3
    assert (np.abs(found.means[:, 0] - 5.0) < 0.01).sum() == 1


def test_splats_of_different_cells_stay_apart() -> None:
    g = Gaussians.of(a_scene(400, 1))
    cells = np.arange(400) % 2
    found, places = halved(g, cells)
    assert len(found) == 200
    for cell in (0, 1):
        alone, _ = halved(g.rows(cells == cell), np.zeros(200, int))
        assert (places == cell).sum() > 50
        assert len(alone) == 100
    lone, places = halved(g.rows(np.arange(3)), np.array([0, 1, 2]))
    np.testing.assert_array_equal(lone.means, g.means[:3])
    assert places.tolist() == [0, 1, 2]
    assert len(halved(g.rows(np.arange(0)), np.zeros(0, int))[0]) == 0


@pytest.mark.usefixtures("native")
def test_a_textured_wall_of_half_the_disks_looks_alike() -> None:
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
