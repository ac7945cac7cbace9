"""Losses on known depths and normals: plain torch, any dtype and device (docs/math.md, "Priors").

Depth errors are relative, |z / d - 1| for a rendered depth z and a known depth d, so that the scale of the scene does
not matter. The targets are constant; nothing here waits for a device.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.losses.formulas import fill_ignored, masked_mean

MIN_POINTS = 100  # fewer points than this do not weigh as much as a whole image
FIT_PIXELS = 4_000  # approximate number of pixels that scale and shift of a relative map are fitted to
FIT_ROUNDS = 4
OPACITY = 0.5  # least rendered alpha of a pixel whose depth is compared
NOISE = 0.05  # relative error that known depths may have: below it the loss is quadratic, above linear


@dataclass(frozen=True, eq=False)
class PointDepths:
    """Depths of sparse points in an image."""

    pixels: Tensor  # [M, 4] int64: the four pixels around each point, as indices into the flattened image
    weights: Tensor  # [M, 4]: bilinear weights of their disparities; exact on a plane
    depth: Tensor  # [M] world units


@dataclass(frozen=True, eq=False)
class MetricDepth:
    """A depth map in units of the scene."""

    disparity: Tensor  # [H, W], 1 / world unit
    valid: Tensor  # [H, W] bool


@dataclass(frozen=True, eq=False)
class RelativeDepths:
    """A depth map of unknown scale and shift, which is fitted to the rendered depth."""

    values: Tensor  # [H, W]: standardised to mean 0 and deviation 1; 0 where unknown
    valid: Tensor  # [H, W] bool
    space: str  # "disparity" or "depth": the quantity that the values are linear in


@dataclass(frozen=True, eq=False)
class NormalTarget:
    """Unit normals in the world frame."""

    directions: Tensor  # [H, W, 3]: 0 where unknown
    valid: Tensor  # [H, W]: 1 where defined, else 0


Depths = PointDepths | MetricDepth | RelativeDepths


def depth_prior(target: Depths, depth: Tensor, alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean relative error of a rendered depth [H, W] where the depth is known and a surface is rendered.

    For a map, the mean runs over all valid pixels, and unknown ones count 0. For points, it runs over the points, as if
    there were at least MIN_POINTS. ``mask`` [H, W] bool: False = ignore this pixel.
    """
    hit = (alpha.detach() > OPACITY) & (depth.detach() > 0)
    hit = hit if mask is None else hit & mask
    if isinstance(target, PointDepths):
        return _of_points(target, depth, hit)
    if isinstance(target, RelativeDepths):
        target = aligned(target, depth.detach(), hit)
    return masked_mean(_robust(torch.where(hit & target.valid, depth * target.disparity - 1, 0)), mask)


def _robust(error: Tensor) -> Tensor:
    """Return Huber's loss over ``NOISE``: e^2 / (2 NOISE) below it, |e| - NOISE / 2 above."""
    return torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=NOISE) / NOISE


def _of_points(points: PointDepths, depth: Tensor, hit: Tensor) -> Tensor:
    if len(points.depth) == 0:
        return depth.sum() * 0
    at_points = depth.reshape(-1)[points.pixels]  # [M, 4]
    visible = hit.reshape(-1)[points.pixels].all(dim=1)
    # On a plane, disparity is linear in the image; depth is not.
    z = 1 / (points.weights / torch.where(visible[:, None], at_points, 1)).sum(dim=1)
    return _robust(torch.where(visible, z / points.depth - 1, 0)).sum() / max(len(points.depth), MIN_POINTS)


@torch.no_grad()
def aligned(map_: RelativeDepths, depth: Tensor, hit: Tensor) -> MetricDepth:
    """Return a relative map in units of the scene, by a robust fit to a rendered depth [H, W] where that was ``hit``.

    The result is invalid where the fit has a negative scale or gives no depth in front of the camera.
    """
    stride = max(1, round((depth.numel() / FIT_PIXELS) ** 0.5))
    usable = (map_.valid & hit)[::stride, ::stride].reshape(-1)
    values, z = map_.values[::stride, ::stride].reshape(-1), depth[::stride, ::stride].reshape(-1)
    z = torch.where(usable, z, 1)
    scale, shift = fit_line(values, 1 / z if map_.space == "disparity" else z, usable.to(z.dtype))
    line = torch.addcmul(shift, scale, map_.values)
    good = map_.valid & (line > 1e-3 * shift.abs()) & (scale > 0)  # the shift is the mean of the map
    line = torch.where(good, line, 1)
    return MetricDepth(line if map_.space == "disparity" else 1 / line, good)


def fit_line(x: Tensor, y: Tensor, weights: Tensor, rounds: int = FIT_ROUNDS) -> tuple[Tensor, Tensor]:
    """Fit y = scale x + shift by least squares with robust weights (Cauchy), and return scale and shift [].

    ``x``, ``y``, ``weights`` [M]. ``rounds``: number of solutions. Each weighs errors in units of the mean absolute
    error of the previous one.
    """
    initial, tiny = weights, torch.finfo(y.dtype).tiny
    scale = shift = y.new_zeros(())
    for _ in range(rounds):
        total = weights.sum().clamp(min=tiny)
        mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
        dx = x - mean_x
        scale = (weights * dx * (y - mean_y)).sum() / (weights * dx * dx).sum().clamp(min=tiny)
        shift = mean_y - scale * mean_x
        error = (y - scale * x - shift).abs()
        unit = (initial * error).sum() / initial.sum().clamp(min=tiny)
        weights = initial / (1 + (error / unit.clamp(min=tiny)) ** 2)
    return scale, shift


def normal_prior(target: NormalTarget, normal: Tensor, alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean over all valid pixels of alpha - <normal, N>, alpha detached; 0 where N is unknown.

    With rendered normals [H, W, 3] = sum w n this is the mean of sum w (1 - <n, N>): 1 - cosine, by blending weight.
    """
    directions, valid, alpha = target.directions, target.valid, alpha.detach()
    if mask is not None:
        normal, alpha, valid = (fill_ignored(image, torch.zeros_like(image), mask) for image in (normal, alpha, valid))
    count = alpha.numel() if mask is None else mask.sum().clamp(min=1)
    # Two dot products take a third of the time of an image of cosines.
    return (alpha.reshape(-1) @ valid.reshape(-1) - normal.reshape(-1) @ directions.reshape(-1)) / count
