"""The CUDA comparison of two views, executed on the CPU by the emulator, against the formulas in torch in float64."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

import emulate
from gs2d.config.multiview import MultiView
from gs2d.kernels.cuda.multiview import compare_views
from two_views import Scenario, in_torch, scenario

FEW = MultiView(patches=61, radius=2, texture=0.03, occluded=4.0)  # not a multiple of a block


def results(case: Scenario, emulator: emulate.Emulator | None, learns: bool = False) -> list[Tensor]:
    """Both values, and the gradients of a sum of both to depth, normal and, where it learns, the camera's motion."""
    leaves = [case.depth.clone().requires_grad_(), case.normal.clone().requires_grad_()]
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True) if learns else None
    views = case.views(leaves[0], leaves[1], motion)
    values = in_torch(views) if emulator is None else views.compared(partial(compare_views, launcher=emulator))
    total = values[0] + 0.7 * values[1]
    found = torch.autograd.grad(total, leaves if motion is None else [*leaves, motion])
    return [value.detach().double() for value in (*values, *found)]


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize(("masked", "learns", "radius"), [(False, True, 2), (True, False, 3)])
def test_values_and_gradients_are_those_of_the_formulas_in_torch(
    emulator: emulate.Emulator, masked: bool, learns: bool, radius: int
) -> None:
    case = scenario(masked=masked, settings=replace(FEW, radius=radius), depth_size=(33, 20) if masked else None)
    found, expected = results(case, emulator, learns), results(case.double(), None, learns)
    assert int((expected[2] != 0).sum()) > 30
    for f, e, bound in zip(found, expected, (1e-5, 1e-5, 2e-5, 2e-5, 1e-4), strict=False):
        assert relative_error(f, e) < bound


def test_the_order_of_threads_changes_no_bit(emulator: emulate.Emulator) -> None:
    case = scenario(settings=FEW)
    launchers = (emulator, replace(emulator, descending=True), replace(emulator, seed=1))
    first, *others = [results(case, launcher, True) for launcher in launchers]
    assert all(torch.equal(a, b) for other in others for a, b in zip(first, other, strict=True))
