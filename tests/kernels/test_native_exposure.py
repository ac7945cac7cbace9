"""The native colour transform of an image against the torch formula."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gs2d.kernels.library import Library
from gs2d.render.exposure_transform import _Expose, _exposed


@pytest.mark.parametrize("cut_out", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (130, 129)])
def test_image_and_gradients_agree_with_torch(any_native: Library, cut_out: bool, size: tuple[int, int]) -> None:
    """130 x 129 pixels are nine chunks; the last has 386 pixels, not a multiple of a vector."""
    g = torch.Generator().manual_seed(size[0])

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g).to(any_native.dtype)

    color, transform, upstream = 1.5 * random(*size, 3), random(3, 4), random(*size, 3) - 0.5
    cover = (random(*size), random(3)) if cut_out else (None, None)
    color.requires_grad_()
    transform.requires_grad_()
    wanted = _exposed(color, transform, *cover)
    found = _Expose.apply(any_native, color, transform, *cover)
    digits = 1e-6 if any_native.dtype == torch.float32 else 1e-14
    assert torch.allclose(found, wanted, rtol=digits, atol=digits)
    by_torch = torch.autograd.grad(wanted, (color, transform), upstream)
    by_us = torch.autograd.grad(found, (color, transform), upstream)
    for a, b in zip(by_us, by_torch, strict=True):
        assert torch.allclose(a, b, rtol=100 * digits, atol=100 * digits * float(b.abs().max()))
