"""The native vignetting and response against the torch formula."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gs2d.kernels.library import Library
from gs2d.render.camera_response import _shown
from gs2d.render.native_image_ops import respond, respond_vjp


@pytest.mark.parametrize("cut_out", [False, True])
@pytest.mark.parametrize("darkens", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (130, 129)])
def test_image_and_gradients_agree_with_torch(
    any_native: Library, cut_out: bool, darkens: bool, size: tuple[int, int]
) -> None:
    g = torch.Generator().manual_seed(size[0])

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g).to(any_native.dtype)

    color = (1.6 * random(*size, 3) - 0.3).requires_grad_()  # includes values below 0 and above 1
    numbers = torch.tensor([0.3, -0.1, 0.2, 0.7], dtype=any_native.dtype, requires_grad=True)
    squares, upstream = random(*size) if darkens else None, random(*size, 3) - 0.5
    cover = (random(*size).mul(2).clamp(max=1), random(3)) if cut_out else (None, None)
    wanted = _shown(color, numbers, squares, *cover)
    found = respond(any_native, color, numbers, squares, *cover)
    digits = 1e-6 if any_native.dtype == torch.float32 else 1e-14
    assert torch.allclose(found, wanted, rtol=10 * digits, atol=10 * digits)
    by_torch = torch.autograd.grad(wanted, (color, numbers), upstream, allow_unused=True)
    by_us = respond_vjp(any_native, upstream, color, numbers, squares, *cover)
    for a, b in zip(by_us, by_torch, strict=True):
        assert b is not None
        assert torch.allclose(a, b, rtol=100 * digits, atol=100 * digits * max(float(b.abs().max()), 1.0))
