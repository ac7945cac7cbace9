"""Vignetting and response curve of a camera, applied to a rendering after the exposure of the photograph.

Formulas: docs/math.md, "Vignetting and response". At the mean exposure, a camera with the mean response leaves the
scene's colours unchanged at the principal point.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.vignetting import squared_radii
from gs2d.kernels.library import library_for
from gs2d.render import native_image_ops as native


def squares_of(camera: Camera, reach: float, like: Tensor) -> Tensor:
    """Return the squared radii [H, W] of a camera's pixels; cached for the last 8 cameras."""
    size = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return _squares(size, reach, like.device, like.dtype)


@lru_cache(maxsize=8)
def _squares(size: tuple[Any, ...], reach: float, device: torch.device, dtype: torch.dtype) -> Tensor:
    width, height, fx, fy, cx, cy = size
    return torch.from_numpy(squared_radii(Camera(width, height, fx, fy, cx, cy, np.eye(4)), reach)).to(device, dtype)


def show(
    color: Tensor,
    numbers: Tensor,
    squares: Tensor | None,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """Apply a response curve, then vignetting, to a rendered image.

    On the CPU in float32 the bits of the image and its gradients do not depend on the number of threads.

    Parameters
    ----------
    color : Tensor [H, W, 3]
    numbers : Tensor [4]
        a, b, c of the falloff and s of the curve.
    squares : Tensor [H, W], optional
        Squared radii; without them, no vignetting.
    coverage, background
        As for :func:`gs2d.render.exposure_transform.expose`.

    Returns
    -------
    Tensor [H, W, 3]
        Differentiable in ``color`` and ``numbers``.
    """
    if library_for(color) is None:
        return _shown(color, numbers, squares, coverage, background)
    image: Tensor = _Show.apply(color, numbers, squares, coverage, background)
    return image


class _Show(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        color: Tensor,
        numbers: Tensor,
        squares: Tensor | None,
        coverage: Tensor | None,
        background: Tensor | None,
    ) -> Tensor:
        ctx.library = library_for(color)
        ctx.save_for_backward(color, numbers, squares, coverage, background)
        return native.respond(ctx.library, color, numbers, squares, coverage, background)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        to_color, to_numbers = native.respond_vjp(ctx.library, upstream, *ctx.saved_tensors)
        return to_color, to_numbers, None, None, None


def _shown(
    color: Tensor, numbers: Tensor, squares: Tensor | None, coverage: Tensor | None, background: Tensor | None
) -> Tensor:
    """Return the image, computed by torch."""
    behind = 0.0 if coverage is None or background is None else (1 - coverage[..., None]) * background.to(color.dtype)
    light = color - behind
    bent = bend(light, numbers[3])
    bent = bent if coverage is None else torch.where(coverage[..., None] >= 1, bent, light)
    if squares is not None:
        bent = bent * vignetting(squares, numbers[:3])[..., None]
    return bent + behind


def bend(values: Tensor, shift: Tensor) -> Tensor:
    """Return f(x) = k x / (1 + (k - 1) x), k = e^s, linear below 0 and above 1; the inverse is f with -s."""
    growth = shift.exp()
    inside, below, above = values.clamp(0, 1), values.clamp(max=0), values.clamp(min=1) - 1
    return growth * below + growth * inside / (1 + (growth - 1) * inside) + above / growth


def vignetting(squares: Tensor, falloff: Tensor) -> Tensor:
    """Return the relative brightness at squared radii."""
    return (-squares * (falloff[0] + squares * (falloff[1] + squares * falloff[2]))).exp()
