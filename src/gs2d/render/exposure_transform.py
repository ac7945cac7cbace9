"""Exposure and white balance of a photograph: an affine colour transform of 12 numbers.

A camera with automatic exposure maps the scene's colour c to A c + b, with a 3x3 matrix A (channel gains on its
diagonal) and an offset b. ``transform`` [3, 4] is [A | b]. Formulas: docs/math.md, "Exposure".

A photograph with an alpha channel has no background of its own. The protocol's background is composited behind both
photograph and rendering, after the camera: the transform changes the object's colours and not the background's.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.checks import check_shapes
from gs2d.kernels.c_structures import arguments_of
from gs2d.kernels.library import Library, library_for

RIDGE = 1e-4  # per pixel: keeps what the pixels do not determine at the identity


def identity(like: Tensor) -> Tensor:
    """Return the identity transform [3, 4] with the dtype and device of ``like``."""
    return torch.eye(3, 4, dtype=like.dtype, device=like.device)


def expose(
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """Apply the transform [3, 4] of a camera to a rendered image [H, W, 3], differentiably in both.

    With k = ``coverage`` (default 1) and B = ``background`` [3]: A (C - (1 - k) B) + k b + (1 - k) B. The image is
    rendered over the background and not clamped; ``coverage`` [H, W] is the alpha in [0, 1] of the object, which is not
    differentiated and without which the object covers the image. On the CPU in float32 the bits of the image and its
    gradients do not depend on the number of threads.
    """
    arrays = {"color": (color, "H W 3"), "transform": (transform, "3 4")}
    if coverage is not None:
        assert background is not None
        arrays |= {"coverage": (coverage, "H W"), "background": (background, "3")}
    check_shapes(arrays)
    coverage = None if coverage is None else coverage.detach()
    library = library_for(color)
    if library is None:
        return _exposed(color, transform, coverage, background)
    exposed: Tensor = _Expose.apply(library, color, transform, coverage, background)
    return exposed


class _Expose(torch.autograd.Function):
    """The transform in native code (``kernels/cpu/exposure.cpp``)."""

    @staticmethod
    def forward(
        ctx: Any,
        library: Library,
        color: Tensor,
        transform: Tensor,
        coverage: Tensor | None,
        background: Tensor | None,
    ) -> Tensor:
        color, coverage = library.arrays(color=color, coverage=coverage)
        out = torch.empty_like(color)
        library.call("gs2d_expose", _picture(color, transform, coverage, background), None, out, None)
        ctx.library = library
        ctx.save_for_backward(color, transform, coverage, background)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        color, transform, coverage, background = ctx.saved_tensors
        upstream, to_color, sums = upstream.contiguous(), torch.empty_like(color), torch.empty(12, dtype=torch.float64)
        picture = _picture(color, transform, coverage, background)
        if ctx.library.call("gs2d_expose_vjp", picture, None, upstream, to_color, sums) != 0:
            raise MemoryError("gs2d_expose_vjp could not allocate its sums")
        return None, to_color, sums.reshape(3, 4).to(transform.dtype), None, None


def _picture(color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None) -> ctypes.Structure:
    """Return the arguments of the native functions; the tensors are contiguous."""
    picture = arguments_of("gs2d_expose", color=color, coverage=coverage, pixels=color.numel() // 3)
    picture.transform = tuple(transform.flatten().tolist())
    if coverage is not None and background is not None:
        picture.background = tuple(background.tolist())
    return picture


def _exposed(color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None) -> Tensor:
    """Return the exposed image, computed by torch."""
    if coverage is None or background is None:
        return _apply(color, transform[:, :3]) + transform[:, 3]
    behind = (1 - coverage[..., None]) * background.to(color.dtype)
    return _apply(color - behind, transform[:, :3]) + coverage[..., None] * transform[:, 3] + behind


def _apply(vectors: Tensor, matrix: Tensor) -> Tensor:
    """Return ``matrix @ v`` for each v of [H, W, 3]."""
    columns = [vectors[..., k : k + 1] * matrix[:, k] for k in range(3)]
    return columns[0].add_(columns[1]).add_(columns[2])


def fit_exposure(
    color: Tensor,
    target: Tensor,
    pixels: Tensor,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """Fit the transform [3, 4] from a rendered image to a photograph, [H, W, 3] over the background, by least squares.

    Only ``pixels`` [H, W] bool count; without any, the result is the identity. A ridge of ``RIDGE`` per pixel pulls the
    transform to the identity where the pixels do not determine it. The others are as for :func:`expose`.
    """
    check_shapes({"color": (color, "H W 3"), "target": (target, "H W 3"), "pixels": (pixels, "H W")})
    light, weight, observed = color.double(), torch.ones_like(color[..., :1], dtype=torch.float64), target.double()
    if coverage is not None:
        assert background is not None
        weight = coverage.double()[..., None]
        behind = (1 - weight) * background.double()
        light, observed = light - behind, observed - behind
    rows = torch.cat([light, weight], dim=-1)[pixels]  # [P, 4]
    residual = (observed - light)[pixels]  # [P, 3]
    normal = rows.T @ rows + RIDGE * max(len(rows), 1) * torch.eye(4, dtype=rows.dtype, device=rows.device)
    return (identity(rows) + torch.linalg.solve(normal, rows.T @ residual).T).to(color.dtype)
