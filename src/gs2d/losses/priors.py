"""Losses on depths and normals that are known beforehand: plain torch, any dtype and device (docs/math.md, "Priors").

Depth errors are relative, |z / d - 1| for a rendered depth z and a known one d: the same weight in a scene of any size.
What is known is constant; nothing here waits for a device.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.losses.reference import fill_ignored, masked_mean

MIN_POINTS = 100  # fewer points than these do not weigh as much as a whole picture
FIT_PIXELS = 4_000  # of a relative map, about, that its scale and shift are fitted by
FIT_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class PointDepths:
    """Sparse points in a picture.

    Attributes
    ----------
    pixels : Tensor [M, 4] int64
        The four pixels around each point, as places in the flattened picture.
    weights : Tensor [M, 4]
        Of their disparities: bilinear, which is exact on a plane.
    depth : Tensor [M] world units
    """

    pixels: Tensor
    weights: Tensor
    depth: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return self.pixels.nbytes + self.weights.nbytes + self.depth.nbytes


@dataclass(frozen=True, eq=False)
class MetricDepth:
    """A depth map in units of the scene.

    Attributes
    ----------
    disparity : Tensor [H, W], 1 / world unit
    valid : Tensor [H, W] bool
    """

    disparity: Tensor
    valid: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return self.disparity.nbytes + self.valid.nbytes


@dataclass(frozen=True, eq=False)
class RelativeDepths:
    """A depth map of unknown scale and shift, for want of points fitted to what is rendered.

    Attributes
    ----------
    values : Tensor [H, W]
        Centred on 0 with deviation 1 (whatever the unit was); 0 where unknown.
    valid : Tensor [H, W] bool
    space : "disparity" or "depth"
        What it is linear in.
    """

    values: Tensor
    valid: Tensor
    space: str

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return self.values.nbytes + self.valid.nbytes


@dataclass(frozen=True, eq=False)
class NormalTarget:
    """Unit normals in the world.

    Attributes
    ----------
    directions : Tensor [H, W, 3]
        0 where unknown.
    valid : Tensor [H, W]
        1 where known, else 0.
    """

    directions: Tensor
    valid: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return self.directions.nbytes + self.valid.nbytes


Depths = PointDepths | MetricDepth | RelativeDepths


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the view of an iteration.

    Attributes
    ----------
    depth : PointDepths, MetricDepth, RelativeDepths or None
    normal : NormalTarget or None
    opacity : float
        Least rendered alpha of a pixel whose depth is asked.
    noise : float
        Relative error of a known depth that is to be expected.
    depth_weight, normal_weight : float
        What is left of the weights of the losses.
    """

    depth: Depths | None = None
    normal: NormalTarget | None = None
    opacity: float = 0.5
    noise: float = 0.05
    depth_weight: float = 1.0
    normal_weight: float = 1.0


def depth_prior(prior: Prior, depth: Tensor, alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean relative error of a rendered depth [H, W], where something is known and something was hit.

    Over all valid pixels for a map, unknown ones counting 0; over the points for points, as if there were MIN_POINTS
    at least. ``mask`` [H, W] bool: False = ignore this pixel.
    """
    valid = prior.depth
    assert valid is not None
    hit = (alpha.detach() > prior.opacity) & (depth.detach() > 0)
    hit = hit if mask is None else hit & mask
    if isinstance(valid, PointDepths):
        error = _of_points(valid, depth, hit, prior.noise)
    else:
        if isinstance(valid, RelativeDepths):
            valid = aligned(valid, depth.detach(), hit)
        error = masked_mean(_robust(torch.where(hit & valid.valid, depth * valid.disparity - 1, 0), prior.noise), mask)
    return prior.depth_weight * error


def _robust(error: Tensor, noise: float) -> Tensor:
    """Huber's loss over ``noise``: e^2 / (2 noise) below it, |e| - noise / 2 beyond."""
    return torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=noise) / noise


def _of_points(points: PointDepths, depth: Tensor, hit: Tensor, noise: float) -> Tensor:
    if len(points.depth) == 0:
        return depth.sum() * 0
    at_points = depth.reshape(-1)[points.pixels]  # [M, 4]
    seen = hit.reshape(-1)[points.pixels].all(dim=1)
    # Disparity is linear in the picture of a plane, depth is not.
    z = 1 / (points.weights / torch.where(seen[:, None], at_points, 1)).sum(dim=1)
    return _robust(torch.where(seen, z / points.depth - 1, 0), noise).sum() / max(len(points.depth), MIN_POINTS)


@torch.no_grad()
def aligned(map_: RelativeDepths, depth: Tensor, hit: Tensor) -> MetricDepth:
    """Return a relative map in units of the scene, by a robust fit to a rendered depth [H, W] where that was ``hit``.

    Nothing is known where the fit runs the other way, or where it gives no depth in front of the camera.
    """
    stride = max(1, round((depth.numel() / FIT_PIXELS) ** 0.5))
    usable = (map_.valid & hit)[::stride, ::stride].reshape(-1)
    values, z = map_.values[::stride, ::stride].reshape(-1), depth[::stride, ::stride].reshape(-1)
    z = torch.where(usable, z, 1)
    scale, shift = fit_line(values, 1 / z if map_.space == "disparity" else z, usable.to(z.dtype))
    line = torch.addcmul(shift, scale, map_.values)
    good = map_.valid & (line > 1e-3 * shift.abs()) & (scale > 0)  # the shift is the value in the middle of the map
    line = torch.where(good, line, 1)
    return MetricDepth(line if map_.space == "disparity" else 1 / line, good)


def fit_line(x: Tensor, y: Tensor, weights: Tensor, rounds: int = FIT_ROUNDS) -> tuple[Tensor, Tensor]:
    """Scale and shift [] of y = scale x + shift, by least squares whose weights fall with the error (Cauchy's).

    Parameters
    ----------
    x, y, weights : Tensor [M]
    rounds : int
        Solutions; the unit of errors is the mean absolute one of the last.
    """
    given, tiny = weights, torch.finfo(y.dtype).tiny
    scale = shift = y.new_zeros(())
    for _ in range(rounds):
        total = weights.sum().clamp(min=tiny)
        mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
        dx = x - mean_x
        scale = (weights * dx * (y - mean_y)).sum() / (weights * dx * dx).sum().clamp(min=tiny)
        shift = mean_y - scale * mean_x
        error = (y - scale * x - shift).abs()
        unit = (given * error).sum() / given.sum().clamp(min=tiny)
        weights = given / (1 + (error / unit.clamp(min=tiny)) ** 2)
    return scale, shift


def normal_prior(prior: Prior, normal: Tensor, alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean over all valid pixels of alpha - <normal, N>, alpha detached, 0 where no N is known.

    With rendered normals [H, W, 3] = sum w n this is the mean of sum w (1 - <n, N>): 1 - cosine, by blending weight.
    """
    assert prior.normal is not None
    directions, valid, alpha = prior.normal.directions, prior.normal.valid, alpha.detach()
    if mask is not None:
        normal, alpha, valid = (fill_ignored(image, torch.zeros_like(image), mask) for image in (normal, alpha, valid))
    count = alpha.numel() if mask is None else mask.sum().clamp(min=1)
    # Two products of vectors: a third of the time of a picture of cosines.
    total = alpha.reshape(-1) @ valid.reshape(-1) - normal.reshape(-1) @ directions.reshape(-1)
    return prior.normal_weight * total / count
