"""The colour transform of an image: formula, gradients, fit and inverse."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from gs2d.render.exposure_transform import (
    expose,
    fit_exposure,
    identity,
)


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def gains(red: float, green: float, blue: float, offset: float = 0.0) -> Tensor:
    return torch.tensor([[red, 0, 0, offset], [0, green, 0, offset], [0, 0, blue, offset]], dtype=torch.float64)


def test_the_identity_changes_no_bit() -> None:
    color = random(5, 4, 3).float()
    assert torch.equal(expose(color, identity(color)), color)


def test_a_pixel_gets_its_gains_its_mixture_and_the_offset() -> None:
    transform = gains(2.0, 1.0, 0.5, 0.1)
    transform[0, 2] = 0.5  # red gets half of the blue
    pixel = torch.tensor([[[0.2, 0.4, 0.6]]], dtype=torch.float64)
    # 2 * 0.2 + 0.5 * 0.6 + 0.1 = 0.8;  0.4 + 0.1 = 0.5;  0.5 * 0.6 + 0.1 = 0.4
    assert expose(pixel, transform).flatten().tolist() == pytest.approx([0.8, 0.5, 0.4])


def test_where_a_photograph_has_an_alpha_channel_the_background_behind_it_keeps_its_colour() -> None:
    white, coverage = torch.ones(3, dtype=torch.float64), torch.tensor([[0.0, 0.5, 1.0]], dtype=torch.float64)
    light = torch.tensor([0.0, 0.4, 0.8], dtype=torch.float64)  # 0.8 premultiplied by coverage
    over_white = (light + 1 - coverage[0])[None, :, None].expand(1, 3, 3)
    seen = expose(over_white, gains(0.5, 0.5, 0.5, 0.1), coverage, white)
    # 1;  0.5 * 0.4 + 0.5 * 0.1 + 0.5 = 0.75;  0.5 * 0.8 + 0.1 = 0.5
    assert seen[0, :, 0].tolist() == pytest.approx([1.0, 0.75, 0.5])


@pytest.mark.parametrize("cut_out", [False, True])
def test_gradients_are_those_of_finite_differences(cut_out: bool) -> None:
    color, transform = random(4, 3, 3).requires_grad_(), random(3, 4, seed=1).requires_grad_()
    cover = (random(4, 3, seed=2), random(3, seed=3)) if cut_out else ()
    assert torch.autograd.gradcheck(lambda c, t: expose(c, t, *cover).sin(), (color, transform))


@pytest.mark.parametrize("cut_out", [False, True])
def test_a_fit_finds_the_transform_that_made_the_picture(cut_out: bool) -> None:
    color, truth = random(20, 20, 3), gains(1.3, 0.9, 0.7, 0.05)
    cover = (random(20, 20, seed=2), random(3, seed=3)) if cut_out else ()
    found = fit_exposure(color, expose(color, truth, *cover), torch.ones(20, 20, dtype=torch.bool), *cover)
    assert (found - truth).abs().max() < 0.02  # the ridge term biases slightly


def test_a_fit_looks_at_its_pixels_only_and_says_identity_where_there_are_none() -> None:
    color, pixels = random(10, 10, 3), torch.zeros(10, 10, dtype=torch.bool)
    assert torch.equal(fit_exposure(color, 0 * color, pixels), identity(color))
    pixels[:5] = True
    target = torch.where(pixels[..., None], 0.5 * color, 0 * color)
    assert (fit_exposure(color, target, pixels) - gains(0.5, 0.5, 0.5)).abs().max() < 0.02


def test_a_grey_picture_fits_without_wild_colours() -> None:
    # Every pixel is (0.5, 0.5, 0.5): any row [a, a, a, b] with 1.5 a + b = 0.4 fits; the ridge picks the smallest one.
    grey = torch.full((8, 8, 3), 0.5, dtype=torch.float64)
    found = fit_exposure(grey, 0.8 * grey, torch.ones(8, 8, dtype=torch.bool))
    assert expose(grey, found).flatten().tolist() == pytest.approx([0.4] * 192, abs=1e-3)
    assert (found - identity(found)).abs().max() < 0.1
