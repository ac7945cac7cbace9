"""Native losses against the torch references, on every instruction set of this machine."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor

from gs2d.kernels.library import Library
from gs2d.kernels.loss_operations import NormalOptions
from gs2d.kernels.native_losses import NativeLosses
from gs2d.losses import formulas as reference
from loss_images import CONSISTENCIES, geometry, photographs, relative_error, wide_camera

SIZES = [(1, 1), (2, 9), (5, 3), (11, 16), (37, 53), (70, 21)]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_l1_ssim_l2_and_their_gradient_are_those_of_the_reference(
    native: Library, size: tuple[int, int], masked: bool
) -> None:
    rendered, target, mask = photographs(*size)
    valid = mask if masked else None
    x, y = rendered.float().requires_grad_(), target.float()
    exact, exact_y = x.detach().double().requires_grad_(), y.double()  # exactly the inputs of the native op
    values = NativeLosses(native).photometric(x, y, valid)
    exact_values = [value(exact, exact_y, valid) for value in (reference.l1, reference.ssim, reference.l2)]
    for value, exact_value, atol in zip(values, exact_values, (1e-7, 1e-6, 1e-7), strict=True):
        assert value.item() == pytest.approx(exact_value.item(), abs=atol)
    # the first matches the gradient computed in the forward pass
    for weights in [(0.8, -0.2, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-0.3, 2.0, 10.0)]:
        (found,) = torch.autograd.grad(values, x, tuple(map(torch.tensor, weights)), retain_graph=True)
        total = sum(weight * value for weight, value in zip(weights, exact_values, strict=True))
        (expected,) = torch.autograd.grad(total, exact, retain_graph=True)
        assert relative_error(found, expected) < 1e-5


@pytest.mark.parametrize(("edges", "weighted", "per_splat", "masked"), CONSISTENCIES)
@pytest.mark.parametrize("size", SIZES)
def test_normal_consistency_and_its_gradients_are_those_of_the_reference(
    native: Library, size: tuple[int, int], per_splat: bool, masked: bool, edges: str, weighted: bool
) -> None:
    *images, mask = geometry(*size, empty=0.3 if edges == "camera" else 0.05)
    camera, valid = wide_camera(*size), mask if masked else None
    weights = torch.rand(size, generator=torch.Generator().manual_seed(1)) if weighted else None
    found_in = [image.float().requires_grad_() for image in images]
    exact_in = [image.detach().double().requires_grad_() for image in found_in]
    how = NormalOptions(camera, valid, weights, edges == "camera", per_splat)
    value = NativeLosses(native).normal_consistency(*found_in, how)
    function = partial(reference.normal_consistency, per_splat=per_splat)
    exact = function(*exact_in, camera, valid, edges=edges, weights=weights)
    assert value.item() == pytest.approx(exact.item(), abs=1e-6)
    if min(size) < 3:
        assert weighted or value.item() == (0 if per_splat else 1)
        return
    for cotangent in (0.05, 3.0):  # the first matches the gradient computed in the forward pass
        found = torch.autograd.grad(value, found_in, torch.tensor(cotangent), allow_unused=True, retain_graph=True)
        expected = torch.autograd.grad(
            exact, exact_in, torch.tensor(cotangent).double(), allow_unused=True, retain_graph=True
        )
        assert (found[2] is None) == (expected[2] is None) == (not per_splat)
        for f, e in zip(found, expected, strict=True):
            if f is not None and e is not None:
                assert relative_error(f, e) < 5e-6


def smoothness_inputs(size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return normals, alpha, flatness and mask."""
    normal, _, alpha, mask = geometry(*size)
    flatness = torch.randint(0, 256, size, generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    return normal.float(), alpha.float(), flatness, mask


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [*SIZES, (9, 33)])
def test_normal_smoothness_and_its_gradient_are_those_of_the_reference(
    native: Library, size: tuple[int, int], masked: bool
) -> None:
    normal, alpha, flatness, mask = smoothness_inputs(size)
    given = (alpha, flatness, mask if masked else None)
    normal.requires_grad_()
    exact_normal = normal.detach().double().requires_grad_()
    value = NativeLosses(native).normal_smoothness(normal, *given, expected=0.8)
    exact = reference.normal_smoothness(exact_normal, *given)
    assert value.item() == pytest.approx(exact.item(), abs=1e-6)
    for cotangent in (0.8, 3.0):  # the first matches the gradient computed in the forward pass
        (found,) = torch.autograd.grad(value, normal, torch.tensor(cotangent), retain_graph=True)
        (expected,) = torch.autograd.grad(exact, exact_normal, torch.tensor(cotangent).double(), retain_graph=True)
        assert relative_error(found, expected) < 5e-6


@pytest.mark.parametrize("size", SIZES)
def test_the_masked_mean_and_its_gradient_are_those_of_the_reference(native: Library, size: tuple[int, int]) -> None:
    _, _, values, mask = geometry(*size)
    for valid in (None, mask, torch.zeros_like(mask)):
        x = values.float().requires_grad_()
        exact = x.detach().double().requires_grad_()
        found, expected = NativeLosses(native).masked_mean(x, valid), reference.masked_mean(exact, valid)
        assert found.item() == pytest.approx(expected.item(), abs=1e-6)
        (gradient,) = torch.autograd.grad(3 * found, x)
        torch.testing.assert_close(gradient, 3 * torch.autograd.grad(expected, exact)[0].float())


@pytest.mark.parametrize("masked", [False, True])
def test_the_native_formulas_pass_a_float64_gradient_check(native64: Library, masked: bool) -> None:
    size = (8, 9)
    rendered, target, mask = photographs(*size, seed=3)
    rendered = torch.where((rendered - target).abs() < 1e-3, target + 0.05, rendered)  # |x - y| has a kink
    valid = mask if masked else None
    assert torch.autograd.gradcheck(
        lambda x: NativeLosses(native64).photometric(x, target, valid), (rendered.requires_grad_(),)
    )
    normal, depth, alpha, _ = geometry(*size, seed=4)
    camera = wide_camera(*size)
    inputs = (normal.requires_grad_(), torch.where(depth > 0, depth, 2.5).requires_grad_(), alpha.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda *x: NativeLosses(native64).normal_consistency(*x, NormalOptions(camera, valid, per_splat=True)), inputs
    )
    how = NormalOptions(camera, valid)
    assert torch.autograd.gradcheck(  # alpha is detached in this form
        lambda n, d: NativeLosses(native64).normal_consistency(n, d, alpha.detach(), how),
        inputs[:2],
    )
    assert torch.autograd.gradcheck(lambda x: NativeLosses(native64).masked_mean(x, valid), (inputs[2],))
    weights, empty = geometry(*size, seed=5)[2], geometry(*size, seed=6, empty=0.3)[1] == 0
    assert torch.autograd.gradcheck(
        lambda n, d: NativeLosses(native64).normal_consistency(
            n, torch.where(empty, 0.0, d), alpha.detach(), NormalOptions(camera, valid, weights, at_camera=True)
        ),
        inputs[:2],
    )


def everything(native: Library, height: int = 150, width: int = 41) -> list[Tensor]:
    """Return values and gradients of every native loss."""
    rendered, target, mask = photographs(height, width, seed=6)
    normal, depth, alpha, _ = geometry(height, width, seed=7)
    leaves = [image.float().requires_grad_() for image in (rendered, normal, depth, alpha)]
    x, n, z, a = leaves
    y, camera = target.float(), wide_camera(height, width)
    values = [
        *NativeLosses(native).photometric(x, y, mask),
        *NativeLosses(native).photometric(x, y),
        NativeLosses(native).normal_consistency(n, z, a, NormalOptions(camera, mask)),
        NativeLosses(native).normal_consistency(n, z, a, NormalOptions(camera, per_splat=True)),
        NativeLosses(native).normal_consistency(n, z, a, NormalOptions(camera, weights=y[..., 0], at_camera=True)),
        NativeLosses(native).masked_mean(a, mask),
    ]
    return [*values, *torch.autograd.grad(sum(values), leaves), NativeLosses(native).blur(y)]


def test_every_bit_is_the_same_for_any_number_of_threads(native: Library) -> None:
    native.use_threads(1)
    expected = everything(native)
    for threads in (2, 3, 7):
        native.use_threads(threads)
        for found, wanted in zip(everything(native), expected, strict=True):
            assert torch.equal(found, wanted)


@pytest.mark.parametrize("masked", [False, True])
def test_a_cached_target_mean_changes_no_bit(native: Library, masked: bool) -> None:
    rendered, target, mask = photographs(45, 38, seed=8)
    x, y, valid = rendered.float().requires_grad_(), target.float(), mask if masked else None
    results = []
    for mean in (None, NativeLosses(native).blur(y)):
        l1, ssim, l2 = NativeLosses(native).photometric(x, y, valid, mean)
        results.append((l1, ssim, l2, *torch.autograd.grad(0.8 * l1 - 0.2 * ssim + l2, x)))
    for found, wanted in zip(*results, strict=True):
        assert torch.equal(found, wanted)


def test_nan_at_a_valid_pixel_reaches_the_loss(native: Library) -> None:
    rendered, target, _ = photographs(20, 20)
    x = rendered.float()
    x[3, 4, 1] = float("nan")
    assert all(value.isnan() for value in NativeLosses(native).photometric(x, target.float()))
    camera = wide_camera(20, 20)
    for bad in range(3):
        images = [image.float() for image in geometry(20, 20)[:3]]
        images[1][images[1] == 0] = 2.5
        images[bad][7, 8] = float("nan")
        assert NativeLosses(native).normal_consistency(*images, NormalOptions(camera)).isnan()
        assert reference.normal_consistency(*images, camera).isnan()
        images[1][7, 7] = 0  # beside it
        assert NativeLosses(native).normal_consistency(*images, NormalOptions(camera, at_camera=True)).isnan()
        assert reference.normal_consistency(*images, camera, edges="camera").isnan()


def test_a_target_changed_before_backward_is_an_error_not_a_wrong_gradient(native: Library) -> None:
    rendered, target, _ = photographs(9, 9)
    x, y = rendered.float().requires_grad_(), target.float().contiguous()
    l1, *_ = NativeLosses(native).photometric(x, y)
    y.zero_()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        l1.backward()
