"""The exposure and white balance of a photograph: an affine transform of colour, 12 numbers.

What a camera on automatic does to the colours c of a scene is taken to be A c + b, A a 3x3 matrix (gains of the
channels on its diagonal) and b an offset; ``transform`` [3, 4] is [A | b]. Formulas: docs/math.md, "Exposure".

A photograph with an alpha channel has no background of its own: the protocol's background is put behind photograph and
rendering alike, after the camera. There the transform acts on what the photograph shows, and the background stays.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.checks import check_shapes
from gs2d.kernels.library import library_for
from gs2d.render import exposure_native as native

RIDGE = 1e-4  # of a fit, per pixel: keeps what a picture says nothing about at the identity


def identity(like: Tensor) -> Tensor:
    """Return the transform [3, 4] that changes nothing, of the type and on the device of ``like``."""
    return torch.eye(3, 4, dtype=like.dtype, device=like.device)


def expose(
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """Return a rendered picture as a camera with this transform would have taken it.

    With k = ``coverage`` (1 without one) and B = ``background``: A (C - (1 - k) B) + k b + (1 - k) B. On a CPU, in
    float32, the bits of picture and gradients do not depend on the number of threads.

    Parameters
    ----------
    color : Tensor [H, W, 3]
        Over the background; not clamped.
    transform : Tensor [3, 4]
    coverage : Tensor [H, W], optional
        Alpha in [0, 1] of what the camera saw; without it the whole picture. Not differentiated.
    background : Tensor [3], optional
        Needed with ``coverage``.

    Returns
    -------
    Tensor [H, W, 3]
        Differentiable in ``color`` and ``transform``.
    """
    arrays = {"color": (color, "H W 3"), "transform": (transform, "3 4")}
    if coverage is not None:
        assert background is not None
        arrays |= {"coverage": (coverage, "H W"), "background": (background, "3")}
    check_shapes(arrays)
    exposed: Tensor = _Expose.apply(color, transform, coverage, background)
    return exposed


class _Expose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        color: Tensor,
        transform: Tensor,
        coverage: Tensor | None,
        background: Tensor | None,
    ) -> Tensor:
        ctx.library = library_for(color)
        arguments = (color, transform, coverage, background)
        ctx.save_for_backward(*arguments)
        return _exposed(*arguments) if ctx.library is None else native.exposed(ctx.library, *arguments)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        arguments = (upstream, *ctx.saved_tensors)
        gradients = _gradients(*arguments) if ctx.library is None else native.gradients(ctx.library, *arguments)
        return (*gradients, None, None)


def _exposed(color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None) -> Tensor:
    """Return the image; by torch."""
    if coverage is None or background is None:
        return _apply(color, transform[:, :3]) + transform[:, 3]
    behind = (1 - coverage[..., None]) * background.to(color.dtype)
    return _apply(color - behind, transform[:, :3]) + coverage[..., None] * transform[:, 3] + behind


def _gradients(
    upstream: Tensor,
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Those of ``color`` and ``transform``; by torch."""
    light, weight = color, torch.ones_like(color[..., 0])
    if coverage is not None and background is not None:
        light, weight = color - (1 - coverage[..., None]) * background.to(color.dtype), coverage
    sums = [(upstream[..., i] * right).sum() for i in range(3) for right in (*light.unbind(dim=-1), weight)]
    return _apply(upstream, transform[:, :3].T), torch.stack(sums).reshape(3, 4)


def _apply(vectors: Tensor, matrix: Tensor) -> Tensor:
    """``matrix @ v`` for each v of [H, W, 3]."""
    columns = [vectors[..., k : k + 1] * matrix[:, k] for k in range(3)]
    return columns[0].add_(columns[1]).add_(columns[2])


def fit_exposure(
    color: Tensor,
    target: Tensor,
    pixels: Tensor,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """Fit the transform [3, 4] that takes a rendered image nearest to a photograph (least squares, some pixels).

    A ridge of ``RIDGE`` a pixel towards the identity decides what the pixels leave open.

    Parameters
    ----------
    color, target : Tensor [H, W, 3]
        Rendering and photograph, over the background.
    pixels : Tensor [H, W] bool
        Those that are looked at; without any the result is the identity.
    coverage, background
        As for :func:`expose`.
    """
    check_shapes({"color": (color, "H W 3"), "target": (target, "H W 3"), "pixels": (pixels, "H W")})
    light, weight, wanted = color.double(), torch.ones_like(color[..., :1], dtype=torch.float64), target.double()
    if coverage is not None:
        assert background is not None
        weight = coverage.double()[..., None]
        behind = (1 - weight) * background.double()
        light, wanted = light - behind, wanted - behind
    rows = torch.cat([light, weight], dim=-1)[pixels]  # [P, 4]
    missing = (wanted - light)[pixels]  # [P, 3]
    normal = rows.T @ rows + RIDGE * max(len(rows), 1) * torch.eye(4, dtype=rows.dtype, device=rows.device)
    return (identity(rows) + torch.linalg.solve(normal, rows.T @ missing).T).to(color.dtype)
