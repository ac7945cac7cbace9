"""The exposure and white balance of a photograph: an affine transform of colour, 12 numbers.

What a camera on automatic does to the colours c of a scene is taken to be A c + b, A a 3x3 matrix (gains of the
channels on its diagonal) and b an offset; ``transform`` [3, 4] is [A | b]. Formulas: docs/math.md, "Exposure".

A photograph with an alpha channel has no background of its own: the protocol's background is put behind photograph and
rendering alike, after the camera. There the transform acts on what the photograph shows, and the background stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.check import check_shapes

PIECE = 8192  # pixels
RIDGE = 1e-4  # of a fit, per pixel: keeps what a picture says nothing about at the identity


def identity(like: Tensor) -> Tensor:
    """The transform [3, 4] that changes nothing, of the type and on the device of ``like``."""
    return torch.eye(3, 4, dtype=like.dtype, device=like.device)


def expose(
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
    *,
    clipped: Tensor | None = None,
) -> Tensor:
    """A rendered picture as a camera with this transform would have taken it.

    With k = ``coverage`` (1 without one) and B = ``background``: A (C - (1 - k) B) + k b + (1 - k) B. The bits do not
    depend on the number of threads, those of the gradients neither.

    Parameters
    ----------
    color : Tensor [H, W, 3]
        Over the background; not clamped.
    transform : Tensor [3, 4]
    coverage : Tensor [H, W], optional
        Alpha in [0, 1] of what the camera saw; without it the whole picture. Not differentiated.
    background : Tensor [3], optional
        Needed with ``coverage``.
    clipped : Tensor [H, W, 3] bool, optional
        Where the photograph is at its ceiling, which says "this bright or brighter": there at most 1.

    Returns
    -------
    Tensor [H, W, 3]
        Differentiable in ``color`` and ``transform``.
    """
    arrays = {"color": (color, "H W 3"), "transform": (transform, "3 4")}
    if coverage is not None:
        assert background is not None
        arrays |= {"coverage": (coverage, "H W"), "background": (background, "3")}
    if clipped is not None:
        arrays["clipped"] = (clipped, "H W 3")
    check_shapes(arrays)
    exposed: Tensor = _Expose.apply(color, transform, coverage, background, clipped)
    return exposed


class _Expose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        color: Tensor,
        transform: Tensor,
        coverage: Tensor | None,
        background: Tensor | None,
        clipped: Tensor | None,
    ) -> Tensor:
        on_host = color.device.type == "cpu"
        image, over = (_exposed_on_host if on_host else _exposed)(color, transform, coverage, background, clipped)
        ctx.save_for_backward(color, transform, coverage, background, over)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        color, transform, coverage, background, over = ctx.saved_tensors
        gradients = _gradients_on_host if color.device.type == "cpu" else _gradients
        return (*gradients(upstream, color, transform, coverage, background, over), None, None, None)


def _exposed(
    color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None, clipped: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """The picture, and where it was cut to 1 [H, W, 3]; by torch."""
    if coverage is None or background is None:
        image = _apply(color, transform[:, :3]) + transform[:, 3]
    else:
        behind = (1 - coverage[..., None]) * background.to(color.dtype)
        image = _apply(color - behind, transform[:, :3]) + coverage[..., None] * transform[:, 3] + behind
    if clipped is None:
        return image, None
    over = clipped & (image > 1)
    return torch.where(over, 1.0, image), over


def _gradients(
    upstream: Tensor,
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None,
    background: Tensor | None,
    over: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Those of ``color`` and ``transform``; by torch."""
    upstream = upstream if over is None else torch.where(over, 0.0, upstream)
    light, weight = color, torch.ones_like(color[..., 0])
    if coverage is not None and background is not None:
        light, weight = color - (1 - coverage[..., None]) * background.to(color.dtype), coverage
    sums = [(upstream[..., i] * right).sum() for i in range(3) for right in (*light.unbind(dim=-1), weight)]
    return _apply(upstream, transform[:, :3].T), torch.stack(sums).reshape(3, 4)


def _apply(vectors: Tensor, matrix: Tensor) -> Tensor:
    """``matrix @ v`` for each v of [H, W, 3]."""
    columns = [vectors[..., k : k + 1] * matrix[:, k] for k in range(3)]
    return columns[0].add_(columns[1]).add_(columns[2])


# On the host numpy does the same plane by plane, in pieces that stay in the cache: faster than torch on pixels
# of three, and in one order of sums, where torch's would depend on its threads. ``over`` is [3, H * W] here.
def _exposed_on_host(
    color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None, clipped: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    out = torch.empty_like(color, memory_format=torch.contiguous_format)
    rows, offset = transform[:, :3].tolist(), transform[:, 3].tolist()
    target = out.reshape(-1, 3).numpy()
    ceiling = None if clipped is None else clipped.reshape(-1, 3).numpy()
    over = None if ceiling is None else np.zeros((3, len(target)), bool)
    for piece, light, weight, behind in _pieces(color, coverage, background):
        for i, plane in enumerate(_combined(light, rows)):
            plane += offset[i] if weight is None else weight * light.dtype.type(offset[i])
            if behind is not None:
                plane += behind[i]
            if over is not None and ceiling is not None:
                cut = np.logical_and(plane > 1, ceiling[piece, i], out=over[i, piece])
                plane[cut] = 1
            target[piece, i] = plane
    return out, None if over is None else torch.from_numpy(over)


def _gradients_on_host(
    upstream: Tensor,
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None,
    background: Tensor | None,
    over: Tensor | None,
) -> tuple[Tensor, Tensor]:
    to_color = torch.empty_like(color, memory_format=torch.contiguous_format)
    target, columns, sums = to_color.reshape(-1, 3).numpy(), transform[:, :3].T.tolist(), np.zeros((3, 4))
    given, cut = upstream.contiguous().reshape(-1, 3).numpy(), None if over is None else over.numpy()
    for piece, light, weight, _ in _pieces(color, coverage, background):
        up = given[piece].T.copy()  # [3, P]
        if cut is not None:
            up[cut[:, piece]] = 0
        sums[:, :3] += np.einsum("ip,jp->ij", up, light)
        sums[:, 3] += np.add.reduce(up if weight is None else up * weight, axis=1)
        for i, plane in enumerate(_combined(up, columns)):
            target[piece, i] = plane
    return to_color, torch.from_numpy(sums).to(transform.dtype)


def _pieces(
    color: Tensor, coverage: Tensor | None, background: Tensor | None
) -> Iterator[tuple[slice, np.ndarray, np.ndarray | None, np.ndarray | None]]:
    """Pixels, light [3, P], coverage [P] and the background behind it [3, P] of each piece of a picture."""
    pixels = color.contiguous().reshape(-1, 3).numpy()
    weights = None if coverage is None else coverage.to(color.dtype).contiguous().reshape(-1).numpy()
    for start in range(0, len(pixels), PIECE):
        piece = slice(start, start + PIECE)
        light = np.ascontiguousarray(pixels[piece].T)
        if weights is None or background is None:
            yield piece, light, None, None
            continue
        behind = (1 - weights[piece]) * background.to(color.dtype).numpy()[:, None]
        yield piece, light - behind, weights[piece], behind


def _combined(planes: np.ndarray, rows: list[list[float]]) -> Iterator[np.ndarray]:
    """Sum over j of rows[i][j] times plane j, for each i."""
    for row in rows:
        total = planes[0] * planes.dtype.type(row[0])
        for j in (1, 2):
            total += planes[j] * planes.dtype.type(row[j])
        yield total


def fit_exposure(
    color: Tensor,
    target: Tensor,
    pixels: Tensor,
    coverage: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """The transform [3, 4] that takes a rendered picture nearest to a photograph: least squares over some pixels.

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


def take_back(image: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """A photograph uint8 [H, W, 3 or 4] in the exposure of the scene: A^-1 (P - b), rounded; alpha stays."""
    back = np.linalg.inv(transform[:, :3].astype(np.float64))
    color = (image[..., :3] / 255.0 - transform[:, 3]) @ back.T
    result = image.copy()
    result[..., :3] = np.rint(255 * np.clip(color, 0, 1))
    return result
