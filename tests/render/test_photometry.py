"""Vignetting and response in addition to exposure: formulas, gauge, inverse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.vignetting import reach_of, squared_radii
from gs2d.render.camera_response import bend, show, squares_of, vignetting
from gs2d.render.exposure_transform import expose, identity

CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, np.eye(4))


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def test_the_curve_keeps_its_ends_never_turns_and_has_its_inverse_at_the_other_shift() -> None:
    # k = e^s = 3: f(0.5) = 1.5 / 2 = 0.75; slopes 3 below 0 and 1/3 above 1.
    x = torch.tensor([-0.2, 0.0, 0.5, 1.0, 1.6], dtype=torch.float64)
    found = bend(x, number(math.log(3)))
    assert torch.allclose(found, torch.tensor([-0.6, 0.0, 0.75, 1.0, 1.2], dtype=torch.float64))
    every = torch.linspace(-1, 2, 301, dtype=torch.float64)
    for shift in (-1.5, 0.4, 2.0):
        bent = bend(every, number(shift))
        assert (bent.diff() > 0).all()
        assert torch.allclose(bend(bent, number(-shift)), every)


def test_vignetting_is_1_at_the_principal_point_and_decreases_outwards() -> None:
    reach = reach_of([CAMERA])
    assert reach == pytest.approx(0.5)  # hypot(4, 3) / 10
    squares = torch.from_numpy(squared_radii(CAMERA, reach))
    assert squares[0, 0] == pytest.approx((0.35**2 + 0.25**2) / 0.25)  # the centre of the corner pixel
    a = torch.tensor([0.3, 0.1, 0.2])
    assert vignetting(torch.tensor([0.0, 1.0]), a).tolist() == pytest.approx([1.0, math.exp(-0.6)])


def test_an_image_of_half_the_size_has_the_same_vignetting() -> None:
    reach = reach_of([CAMERA])
    small = squared_radii(CAMERA.downscaled(2), reach)
    # Four pixels lie half a pixel from their centre along each axis: mean square = square of the mean + 2 x 0.25 px^2.
    large = squared_radii(CAMERA, reach).reshape(3, 2, 4, 2).mean(axis=(1, 3))
    assert np.allclose(small, large - 2 * 0.25 / (10 * reach) ** 2, atol=1e-6)


def photograph(color: Tensor, transform: Tensor, numbers: Tensor, squares: Tensor, *cover: Tensor) -> Tensor:
    falloff, curve = numbers * numbers.new_tensor([1, 1, 1, 0]), numbers * numbers.new_tensor([0, 0, 0, 1])
    return show(expose(show(color, falloff, squares, *cover), transform, *cover), curve, None, *cover)


def test_mean_exposure_and_response_keep_colours_at_the_principal_point() -> None:
    color, numbers = random(6, 8, 3) * 1.4 - 0.2, torch.tensor([0.4, 0.0, 0.1, 0.0], dtype=torch.float64)
    squares = squares_of(CAMERA, 0.5, color)
    assert torch.allclose(show(color, numbers, torch.zeros_like(squares)), color)
    assert (show(color, numbers, squares)[0, 0] < color.clamp(min=0)[0, 0] + 1e-12).all()


def test_gradients_are_those_of_differences() -> None:
    color = (random(6, 8, 3, seed=1) * 1.2 - 0.1).requires_grad_()
    transform = (identity(color) + 0.1 * random(3, 4, seed=2)).detach().requires_grad_()
    numbers = torch.tensor([0.3, -0.2, 0.1, 0.6], dtype=torch.float64, requires_grad=True)
    squares = torch.from_numpy(squared_radii(CAMERA, 0.5)).double()

    assert torch.autograd.gradcheck(lambda c, t, n: photograph(c, t, n, squares), (color, transform, numbers))


def test_the_background_stays() -> None:
    color, background = random(6, 8, 3, seed=3), torch.ones(3, dtype=torch.float64)
    coverage = torch.ones(6, 8, dtype=torch.float64)
    coverage[:, 4:] = 0
    over_white, numbers = color * coverage[..., None] + (1 - coverage[..., None]), random(4)
    seen = photograph(over_white, 3 * identity(color), numbers, squares_of(CAMERA, 0.5, color), coverage, background)
    assert torch.allclose(seen[:, 4:], torch.ones(6, 4, 3, dtype=torch.float64))
