"""Native image losses for autograd: the same bits for any number of threads.

Each function computes the gradient in its forward pass, for the expected cotangent (the weight of the loss term), and
returns it in the backward pass. Another cotangent also gives the correct gradient, at the cost of a second pass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.checks import check_shapes
from gs2d.kernels.library import Library, ready_library
from gs2d.kernels.loss_operations import LossOperations, NormalOptions


def _call(library: Library, name: str, *arguments: Any) -> None:
    if library.call(name, *arguments) != 0:
        raise MemoryError(f"{name} could not allocate its scratch rows")


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,
        target: Tensor,
        mask: Tensor | None,
        mean: Tensor | None,
        expected: tuple[float, float, float],
        wanted: bool,
        library: Library,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.library = library
        ctx.expected = torch.tensor(expected, dtype=torch.float64).to(rendered.dtype)  # rounded like the cotangents
        gradient = torch.empty_like(rendered) if wanted else None
        values = _photometric(rendered, target, mask, mean, library, expected, gradient)
        ctx.save_for_backward(gradient, rendered, target, mask, mean)
        return values[0], values[1], values[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        gradient, rendered, target, mask, mean = ctx.saved_tensors
        cotangents = torch.stack(given)
        if not torch.equal(cotangents, ctx.expected):
            gradient = torch.empty_like(gradient)
            l1, ssim, l2 = cotangents.tolist()
            _photometric(rendered, target, mask, mean, ctx.library, (l1, ssim, l2), gradient)
        return gradient, None, None, None, None, None, None


def _photometric(
    rendered: Tensor,
    target: Tensor,
    mask: Tensor | None,
    mean: Tensor | None,
    library: Library,
    cotangents: tuple[float, float, float],
    gradient: Tensor | None,
) -> Tensor:
    values = torch.empty(3, dtype=torch.float64)
    height, width = rendered.shape[:2]
    _call(library, "gs2d_photometric", rendered, target, mask, mean, height, width, *cotangents, gradient, values)
    return values.to(rendered.dtype)


class _NormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        depth: Tensor,
        alpha: Tensor,
        how: NormalOptions,
        expected: float,
        wanted: bool,
        library: Library,
    ) -> Tensor:
        camera = how.camera
        gradients = [torch.empty_like(x) if wanted else None for x in (normal, depth)]
        gradients.append(torch.empty_like(alpha) if wanted and how.per_splat else None)
        intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
        rotation = torch.tensor(camera.rotation, dtype=torch.float64).contiguous()
        value = torch.empty(1, dtype=torch.float64)
        ctx.expected = expected if expected != 0 else 1.0
        inputs = (normal, depth, alpha, how.mask, how.weights, intrinsics, rotation)
        sizes = (camera.height, camera.width, int(how.per_splat), int(how.at_camera), ctx.expected)
        _call(library, "gs2d_normal_consistency", *inputs, *sizes, *gradients, value)
        ctx.save_for_backward(*gradients)
        return value[0].to(normal.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return (*_as_expected(ctx, cotangent), *[None] * 4)


def _as_expected(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """Return the saved gradients, multiplied if the cotangent is not ``ctx.expected``."""
    gradients: tuple[Tensor | None, ...] = ctx.saved_tensors
    if torch.equal(cotangent, torch.tensor(ctx.expected, dtype=torch.float64).to(cotangent.dtype)):
        return gradients
    return tuple(None if g is None else g * (cotangent / ctx.expected) for g in gradients)


class _NormalSmoothness(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        alpha: Tensor,
        flatness: Tensor,
        mask: Tensor | None,
        expected: float,
        wanted: bool,
        library: Library,
    ) -> Tensor:
        gradient = torch.empty_like(normal) if wanted else None
        value = torch.empty(1, dtype=torch.float64)
        ctx.expected = expected if expected != 0 else 1.0
        inputs = (normal, alpha, flatness, mask, *alpha.shape, ctx.expected)
        _call(library, "gs2d_normal_smoothness", *inputs, gradient, value)
        ctx.save_for_backward(gradient)
        return value[0].to(normal.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return (_as_expected(ctx, cotangent)[0], *[None] * 6)


class _MaskedMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, mask: Tensor | None, library: Library) -> Tensor:
        ctx.mask, ctx.like = mask, values
        mean = torch.empty(1, dtype=torch.float64)
        _call(library, "gs2d_masked_mean", values, mask, *values.shape, mean)
        return mean[0].to(values.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.mask is None:
            return (cotangent / max(ctx.like.numel(), 1)).expand_as(ctx.like), None, None
        return ctx.mask.to(cotangent.dtype) * (cotangent / max(int(ctx.mask.sum()), 1)), None, None


class NativeLosses(LossOperations):
    """The losses of a native library, by default :func:`ready_library`."""

    functions = (_Photometric, _NormalConsistency, _NormalSmoothness, _MaskedMean)

    def __init__(self, library: Library | None = None) -> None:
        super().__init__(library or ready_library())

    @property
    def blur(self) -> Callable[[Tensor], Tensor]:
        """Filters an image [H, W, 3] with the SSIM window (11x11 Gaussian, sigma 1.5, zero outside), no gradient."""
        return self._blur

    def _ready(self, **tensors: Tensor | None) -> list[Any]:
        found: list[Any] = self._engine.arrays(**tensors)
        return found

    def _blur(self, image: Tensor) -> Tensor:
        sizes = check_shapes({"image": (image, "H W 3")})
        (source,) = self._ready(image=image)
        out = torch.empty_like(source)
        _call(self._engine, "gs2d_blur", source, sizes["H"], sizes["W"], out)
        return out
