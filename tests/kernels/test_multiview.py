"""Two-view comparison against the torch formulas: every instruction set, and the emulated CUDA kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from emulate import Emulator
from gs2d.config.multiview import MultiView
from gs2d.kernels.cuda import cuda_multiview as cuda
from gs2d.kernels.library import Library
from gs2d.kernels.native_multiview import compare_views
from two_views import Scenario, in_torch, scenario

DOUBLE = torch.float64


def results(case: Scenario, compare: Callable[..., object] | None, *, learns: bool = False) -> list[Tensor]:
    """Return both values and their gradients to depth, normal and, if ``learns``, camera motion; float64."""
    leaves = [case.depth.clone().requires_grad_(), case.normal.clone().requires_grad_()]
    motion = torch.zeros(6, dtype=DOUBLE, requires_grad=True) if learns else None
    views = case.views(leaves[0], leaves[1], motion)
    values = in_torch(views) if compare is None else views.compared(compare)
    if motion is not None:
        leaves.append(motion)
    found = list(values)
    for value in values:
        gradients = torch.autograd.grad(value, leaves, retain_graph=True, allow_unused=True)
        found += [torch.zeros_like(x) if g is None else g for x, g in zip(leaves, gradients, strict=True)]
    return [part.detach().double() for part in found]


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).norm() / expected.norm().clamp(min=1e-30))


def native_on(library: Library) -> Callable[..., object]:
    return partial(compare_views, library=library)


@pytest.mark.parametrize(("masked", "learns"), [(False, False), (True, True)])
@pytest.mark.parametrize("radius", [1, 3])
def test_values_and_gradients_are_those_of_the_formulas_in_torch(
    native: Library, masked: bool, learns: bool, radius: int
) -> None:
    assert_as_in_torch(native_on(native), masked, learns, radius, 301)  # not a multiple of the lanes


@pytest.mark.parametrize(("masked", "learns", "radius"), [(False, True, 2), (True, False, 3)])
def test_values_and_gradients_of_the_cuda_kernels_are_too(
    emulator: Emulator, masked: bool, learns: bool, radius: int
) -> None:
    assert_as_in_torch(partial(cuda.compare_views, launcher=emulator), masked, learns, radius, 61)


def test_the_order_of_threads_changes_no_bit_of_the_cuda_kernels(emulator: Emulator) -> None:
    case = scenario(settings=MultiView(patches=61, radius=2, texture=0.03, occluded=4.0))
    launchers = (emulator, replace(emulator, descending=True), replace(emulator, seed=1))
    runs = [partial(cuda.compare_views, launcher=launcher) for launcher in launchers]
    first, *others = [results(case, run, learns=True) for run in runs]
    assert all(torch.equal(a, b) for other in others for a, b in zip(first, other, strict=True))


def assert_as_in_torch(compare: Callable[..., object], masked: bool, learns: bool, radius: int, patches: int) -> None:
    settings = MultiView(patches=patches, radius=radius, texture=0.03, occluded=4.0)
    case = scenario(masked=masked, settings=settings)
    found, expected = results(case, compare, learns=learns), results(case.double(), None, learns=learns)
    assert int((expected[2] != 0).sum()) >= patches // 2  # as many patches have a gradient
    for f, e in zip(found[:2], expected[:2], strict=True):
        assert relative_error(f, e) < 5e-5  # a round trip is a small difference of two positions
    for f, e in zip(found[2:], expected[2:], strict=True):
        # A point within rounding of a pixel centre may be sampled on the other side, with another slope.
        off = (f - e).abs() > 2e-4 * e.abs() + 2e-5 * e.abs().max()
        assert int(off.sum()) <= 0.01 * int((e != 0).sum())


def test_pixels_at_every_validity_limit_agree_with_torch(native64: Library) -> None:
    """Normals edge-on, facing away and zero; a patch that leaves the image; a neighbour that is much too close."""
    case = scenario(dtype=DOUBLE, settings=MultiView(patches=2000, radius=2, texture=0.03, occluded=4.0))
    g = torch.Generator().manual_seed(5)
    normal = torch.randn(case.normal.shape, generator=g, dtype=DOUBLE)
    normal = torch.where(torch.rand(normal.shape[:2], generator=g)[..., None] < 0.1, 1e-5 * normal, normal)
    depth = case.depth * (1 + 0.01 * torch.randn(case.depth.shape, generator=g, dtype=DOUBLE))
    depth = torch.where(torch.rand(depth.shape, generator=g) < 0.2, 0.3 * depth, depth)
    wild = replace(case, normal=normal, depth=depth)
    for found, expected in zip(results(wild, native_on(native64)), results(wild, None), strict=True):
        assert relative_error(found, expected) < 1e-10


def test_they_have_the_same_bits_for_any_number_of_threads(native: Library) -> None:
    case = scenario((131, 90), settings=MultiView(patches=3000, occluded=100.0))
    found = []
    for threads in (1, 2, 3):
        native.use_threads(threads)
        found.append(results(case, native_on(native), learns=True))
    assert all(torch.equal(a, b) for others in found[1:] for a, b in zip(found[0], others, strict=True))


def test_a_view_without_a_pixel_to_ask_has_loss_zero_and_no_gradient(native: Library) -> None:
    case = scenario()
    unknown = torch.full_like(case.normal, torch.nan)
    nothing = replace(case, candidates=torch.zeros_like(case.candidates), normal=unknown)
    assert not any(part.any() for part in results(nothing, native_on(native), learns=True))
