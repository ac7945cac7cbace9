"""CUDA losses, emulated on the CPU, against the torch references in float64."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch

import emulate
from gs2d.kernels.cuda.cuda_losses import CudaLosses
from gs2d.kernels.loss_operations import NormalOptions
from gs2d.losses import formulas as reference
from loss_images import CONSISTENCIES, geometry, photographs, relative_error, wide_camera

# Smaller than the window; a single row; just over one strip of 128 reals (43 pixels) or 32 rows.
SIZES = [(1, 1), (5, 3), (37, 44), (33, 20)]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_l1_ssim_l2_and_their_gradient_are_those_of_the_reference(
    emulator: emulate.Emulator, size: tuple[int, int], masked: bool
) -> None:
    x, y, mask = photographs(*size, dtype=torch.float32)
    x.requires_grad_()
    valid = mask if masked else None
    exact = x.detach().double().requires_grad_()
    values = CudaLosses(emulator).photometric(x, y, valid)
    exact_values = [value(exact, y.double(), valid) for value in (reference.l1, reference.ssim, reference.l2)]
    for value, exact_value, atol in zip(values, exact_values, (1e-6, 2e-6, 1e-6), strict=True):
        assert value.item() == pytest.approx(exact_value.item(), abs=atol)
    for weights in [(0.8, -0.2, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.8, -0.2, 10.0)]:
        (found,) = torch.autograd.grad(values, x, tuple(map(torch.tensor, weights)), retain_graph=True)
        total = sum(weight * value for weight, value in zip(weights, exact_values, strict=True))
        (expected,) = torch.autograd.grad(total, exact, retain_graph=True)
        assert relative_error(found, expected) < 2e-5


def test_without_a_valid_pixel_values_and_gradients_are_0(emulator: emulate.Emulator) -> None:
    x, y, _ = photographs(7, 6, dtype=torch.float32)
    nothing = torch.zeros(7, 6, dtype=torch.bool)
    x.requires_grad_()
    l1, ssim, l2 = CudaLosses(emulator).photometric(x, y, nothing)
    normal, depth, alpha, _ = geometry(7, 6, dtype=torch.float32)
    mean = CudaLosses(emulator).masked_mean(x[..., 0], nothing)
    seen = NormalOptions(wide_camera(7, 6), nothing)
    consistency = CudaLosses(emulator).normal_consistency(normal, depth, alpha, seen)
    assert [l1.item(), ssim.item(), l2.item(), mean.item(), consistency.item()] == [0.0] * 5
    (gradient,) = torch.autograd.grad(l1 + ssim + l2 + mean, x)
    assert not gradient.any()


@pytest.mark.parametrize(("edges", "weighted", "per_splat", "masked"), CONSISTENCIES)
@pytest.mark.parametrize("size", [*SIZES, (9, 33)])
def test_normal_consistency_and_its_gradients_are_those_of_the_reference(
    emulator: emulate.Emulator, size: tuple[int, int], per_splat: bool, masked: bool, edges: str, weighted: bool
) -> None:
    *images, mask = geometry(*size, empty=0.3 if edges == "camera" else 0.05, dtype=torch.float32)
    camera, valid = wide_camera(*size), mask if masked else None
    weights = torch.rand(size, generator=torch.Generator().manual_seed(1)) if weighted else None
    found_in = [image.requires_grad_() for image in images]
    exact_in = [image.detach().double().requires_grad_() for image in images]
    how = NormalOptions(camera, valid, weights, edges == "camera", per_splat)
    value = CudaLosses(emulator).normal_consistency(*found_in, how)
    function = partial(reference.normal_consistency, per_splat=per_splat)
    exact = function(*exact_in, camera, valid, edges=edges, weights=weights)
    assert value.item() == pytest.approx(exact.item(), abs=1e-6)
    if min(size) < 3:
        return
    weight = torch.tensor(0.05)
    found = torch.autograd.grad(value, found_in, weight, allow_unused=True)
    expected = torch.autograd.grad(exact, exact_in, weight.double(), allow_unused=True)
    assert (found[2] is None) == (expected[2] is None) == (not per_splat)
    for f, e in zip(found, expected, strict=True):
        if f is not None and e is not None:
            assert relative_error(f, e) < 2e-5


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [*SIZES, (35, 31)])
def test_normal_smoothness_and_its_gradient_are_those_of_the_reference(
    emulator: emulate.Emulator, size: tuple[int, int], masked: bool
) -> None:
    normal, _, alpha, mask = geometry(*size, dtype=torch.float32)
    flatness = torch.randint(0, 256, size, generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    given = (alpha, flatness, mask if masked else None)
    normal.requires_grad_()
    exact_normal = normal.detach().double().requires_grad_()
    value = CudaLosses(emulator).normal_smoothness(normal, *given)
    exact = reference.normal_smoothness(exact_normal, *given)
    assert value.item() == pytest.approx(exact.item(), abs=1e-6)
    (found,) = torch.autograd.grad(value, normal, torch.tensor(0.8))
    (expected,) = torch.autograd.grad(exact, exact_normal, torch.tensor(0.8).double())
    assert relative_error(found, expected) < 2e-5


@pytest.mark.parametrize("masked", [False, True])
def test_the_mean_of_a_map_and_its_gradient_are_those_of_the_reference(
    emulator: emulate.Emulator, masked: bool
) -> None:
    """35 x 31 pixels are more than one block of 1024."""
    values, mask = (
        torch.randn(35, 31, generator=torch.Generator().manual_seed(0)),
        photographs(35, 31, dtype=torch.float32)[2],
    )
    values.requires_grad_()
    exact = values.detach().double().requires_grad_()
    found = CudaLosses(emulator).masked_mean(values, mask if masked else None)
    expected = reference.masked_mean(exact, mask if masked else None)
    assert found.item() == pytest.approx(expected.item(), abs=1e-7)
    (gradient,) = torch.autograd.grad(found, values, torch.tensor(3.0))
    assert relative_error(gradient, torch.autograd.grad(expected, exact, torch.tensor(3.0).double())[0]) < 1e-6


def test_values_and_gradients_do_not_depend_on_the_order_of_threads(emulator: emulate.Emulator) -> None:
    """Sums have a fixed order; a missing barrier would also show."""
    x, y, mask = photographs(37, 44, dtype=torch.float32)
    *images, _ = geometry(37, 44, dtype=torch.float32)
    results = []
    for launcher in (
        emulator,
        replace(emulator, descending=True),
        replace(emulator, seed=1),
        replace(emulator, seed=2),
    ):
        z, depth = x.clone().requires_grad_(), images[1].clone().requires_grad_()
        values = CudaLosses(launcher).photometric(z, y, mask)
        seen = NormalOptions(wide_camera(37, 44), mask)
        consistency = CudaLosses(launcher).normal_consistency(images[0], depth, images[2], seen)
        mean = CudaLosses(launcher).masked_mean(x[..., 0], mask)
        results.append((*values, consistency, mean, *torch.autograd.grad(sum(values) + consistency, (z, depth))))
    for others in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], others, strict=True))
