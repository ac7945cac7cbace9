"""Depth and normal prior losses: hand-computed values, gradients, fits of relative maps."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gs2d.losses.prior_formulas import (
    MIN_POINTS,
    Depths,
    MetricDepth,
    NormalTarget,
    PointDepths,
    RelativeDepths,
    aligned,
    depth_prior,
    fit_line,
    normal_prior,
)
from loss_images import make_output

HIT = torch.ones(4, 5, dtype=torch.float64)


def valid(depth: Tensor) -> MetricDepth:
    """Return a map in which depths above 0 are valid."""
    return MetricDepth(1 / torch.where(depth > 0, depth, 1), depth > 0)


def directed(normals: Tensor) -> NormalTarget:
    """Return normals that are valid where they are not 0."""
    return NormalTarget(normals, (normals != 0).any(dim=2).to(normals))


def points(pixels: list[list[int]], weights: list[list[float]], depth: list[float]) -> PointDepths:
    return PointDepths(torch.tensor(pixels), torch.tensor(weights).double(), torch.tensor(depth).double())


# -- values ---------------------------------------------------------------------------------------------------------
@pytest.fixture
def no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the loss the absolute error."""
    monkeypatch.setattr("gs2d.losses.prior_formulas.NOISE", 1e-9)


@pytest.mark.usefixtures("no_noise")
def test_the_loss_of_a_map_is_the_mean_relative_error() -> None:
    depth, truth = torch.full((4, 5), 2.0).double(), torch.zeros(4, 5).double()
    truth[0, 0], truth[1, 2], truth[3, 4] = 1.0, 2.0, 4.0  # errors 1, 0, 1/2; 17 pixels are invalid
    loss = depth_prior(valid(truth), depth, HIT)
    assert loss.item() == pytest.approx(1.5 / 20)


@pytest.mark.usefixtures("no_noise")
def test_pixels_that_are_hardly_covered_do_not_count() -> None:
    depth, alpha = torch.full((4, 5), 2.0).double(), HIT.clone()
    alpha[0, 0], depth[1, 1] = 0.4, 0.0  # too faint; no surface
    loss = depth_prior(valid(torch.ones(4, 5).double()), depth, alpha)
    assert loss.item() == pytest.approx(18 / 20)


@pytest.mark.usefixtures("no_noise")
def test_a_point_between_pixels_is_compared_with_the_plane_through_them() -> None:
    # On a plane, disparity is linear: 1/2 and 1/4 at the pixels, 3/8 at the midpoint, so z = 8/3.
    depth = torch.full((2, 2), 2.0).double()
    depth[:, 1] = 4.0
    middle = points([[0, 1, 2, 3]], [[0.25] * 4], [2.0])
    assert depth_prior(middle, depth, HIT[:2, :2]).item() == pytest.approx((8 / 3 / 2 - 1) / MIN_POINTS)


def test_errors_below_the_noise_cost_their_square(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gs2d.losses.prior_formulas.NOISE", 0.1)
    truth = torch.ones(4, 5).double()
    for depth, expected in ((1.05, 0.05**2 / 0.2), (0.9, 0.05), (1.5, 0.45)):  # noise 0.1: e^2 / 0.2, then e - 0.05
        rendered = torch.full((4, 5), depth, dtype=torch.float64)
        loss = depth_prior(valid(truth), rendered, HIT)
        assert loss.item() == pytest.approx(expected)


def test_normals_cost_one_minus_their_cosine_by_blending_weight() -> None:
    normal, truth = torch.zeros(2, 2, 3).double(), torch.zeros(2, 2, 3).double()
    alpha = torch.tensor([[1.0, 0.8], [0.5, 1.0]]).double()
    normal[0, 0], truth[0, 0] = torch.tensor([0, 0, 1.0]), torch.tensor([0, 0, 1.0])  # 0
    normal[0, 1], truth[0, 1] = torch.tensor([0.8, 0, 0]), torch.tensor([0, 1.0, 0])  # 0.8 (1 - 0)
    normal[1, 0], truth[1, 0] = torch.tensor([0, 0, -0.5]), torch.tensor([0, 0, 1.0])  # 0.5 (1 + 1)
    normal[1, 1] = torch.tensor([1.0, 0, 0])  # invalid
    assert normal_prior(directed(truth), normal, alpha).item() == pytest.approx((0.8 + 1.0) / 4)


# -- gradients ------------------------------------------------------------------------------------------------------
def priors() -> dict[str, Depths]:
    g = torch.Generator().manual_seed(4)
    truth = 1 + torch.rand(6, 7, generator=g).double()
    truth[torch.rand(6, 7, generator=g) < 0.2] = 0
    at = torch.randint(0, 34, (9, 1), generator=g) + torch.tensor([0, 1, 7, 8])
    weights = torch.rand(9, 4, generator=g).double()
    weights /= weights.sum(dim=1, keepdim=True)
    return {
        "map": valid(truth),
        "points": PointDepths(at, weights, 1 + torch.rand(9, generator=g).double()),
    }


@pytest.mark.parametrize("kind", ["map", "points"])
def test_gradients_of_depths_are_those_of_finite_differences(kind: str) -> None:
    output = make_output(6, 7, seed=1)
    prior = priors()[kind]
    assert torch.autograd.gradcheck(lambda z: depth_prior(prior, z, output.alpha), (output.depth_mean,), atol=1e-7)


def test_gradients_of_normals_are_those_of_finite_differences() -> None:
    output = make_output(6, 7, seed=2)
    truth = torch.nn.functional.normalize(make_output(6, 7, seed=3).normal.detach(), dim=2)
    truth[2, 3] = 0
    prior = directed(truth)
    assert torch.autograd.gradcheck(lambda n: normal_prior(prior, n, output.alpha), (output.normal,), atol=1e-7)


def test_no_gradient_goes_into_alpha_or_into_the_fit_of_a_relative_map() -> None:
    output, truth = make_output(6, 7), torch.rand(6, 7).double()
    relative = RelativeDepths(truth, truth >= 0, "disparity")
    (with_fit,) = torch.autograd.grad(
        depth_prior(relative, output.depth_mean, output.alpha), [output.depth_mean], retain_graph=True
    )
    hit = (output.alpha > 0.5) & (output.depth_mean > 0)
    fixed = aligned(relative, output.depth_mean.detach(), hit)
    (constant,) = torch.autograd.grad(depth_prior(fixed, output.depth_mean, output.alpha), [output.depth_mean])
    assert torch.equal(with_fit, constant)
    loss = depth_prior(relative, output.depth_mean, output.alpha)
    assert torch.autograd.grad(loss, [output.alpha], allow_unused=True) == (None,)


# -- relative maps --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("space", ["disparity", "depth"])
def test_a_relative_map_of_the_rendered_surface_has_no_loss(space: str) -> None:
    depth = 1 + torch.rand(12, 13, generator=torch.Generator().manual_seed(0)).double()
    values = 0.3 * (1 / depth if space == "disparity" else depth) + 0.2
    relative = RelativeDepths(values, values >= 0, space)
    assert depth_prior(relative, depth, torch.ones_like(depth)).item() == pytest.approx(0, abs=1e-12)


def test_the_fit_is_robust_to_a_fifth_of_outliers() -> None:
    g = torch.Generator().manual_seed(0)
    x = torch.rand(500, generator=g).double()
    y = 2 * x + 1
    y[:100] += 5 * torch.rand(100, generator=g).double()
    scale, shift = fit_line(x, y, torch.ones_like(x), rounds=20)
    assert scale.item() == pytest.approx(2, abs=0.02)
    assert shift.item() == pytest.approx(1, abs=0.04)
    plain, _ = fit_line(x, y, torch.ones_like(x), rounds=1)
    assert abs(plain.item() - 2) > 0.1
