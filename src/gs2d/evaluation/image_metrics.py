"""PSNR, SSIM and LPIPS of rendered images.

``psnr`` and ``ssim`` use the 8-bit image, as the official 2DGS evaluation does, which reads PNG files. ``psnr_float``
and ``ssim_float`` use the float image clamped to [0, 1]. Masked pixels are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.evaluation.lpips import MIN_SIZE, REMEDY, Lpips
from gs2d.losses import base as losses
from gs2d.render.backends import Backend


@dataclass(frozen=True)
class Metric:
    """A number, or None with a reason."""

    value: float | None
    reason: str | None = None


@dataclass(frozen=True)
class ImageMetrics:
    """Similarity of a rendered image and its target."""

    psnr: Metric  # dB, of the image quantised to 8 bits (official evaluation)
    ssim: Metric  # in [-1, 1], of the same
    psnr_float: Metric  # PSNR of the float image
    ssim_float: Metric  # SSIM of the float image
    lpips: Metric  # VGG LPIPS of the 8-bit image scaled to [0, 1] (as 3DGS and 2DGS report)
    lpips_signed: Metric  # VGG LPIPS of the 8-bit image scaled to [-1, 1] (convention of its authors)

    def to_json(self) -> dict[str, float | str | None]:
        """Return each value by name, and ``<name>_reason`` for values that are null or incomplete."""
        row: dict[str, float | str | None] = {}
        for name, metric in asdict(self).items():
            row[name] = metric["value"]
            if metric["reason"] is not None:
                row[f"{name}_reason"] = metric["reason"]
        return row


def quantise(image: Tensor) -> Tensor:
    """Clamp a float image to [0, 1] and round it to 8 bits, half up; uint8 of the same shape."""
    return (image * 255 + 0.5).clamp(0, 255).to(torch.uint8)


def psnr_float(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the PSNR in dB: -10 log10 of the mean squared error over valid pixels and channels.

    It is ``inf`` for equal images, ``nan`` if no pixel is valid. ``image``, ``target`` [H, W, 3] in [0, 1]; the image
    is clamped to it. ``mask`` [H, W] bool: False = ignore this pixel.
    """
    check_shapes({"target": (target, "H W 3"), "image": (image, "H W 3")})
    squared = image.detach().clamp(0, 1).double()  # [H, W, 3]
    squared -= target.detach()
    squared.square_()  # in place, because a 4K image of doubles has 200 MB
    if mask is not None:
        check_shapes({"target": (target, "H W 3"), "mask": (mask, "H W")})
        squared = squared[mask]
    if squared.numel() == 0:
        return math.nan
    error = float(squared.mean())
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim_float(image: Tensor, target: Tensor, mask: Tensor | None = None, *, backend: str | Backend) -> float:
    """Return the mean SSIM over valid pixels (11x11 Gaussian window, zero padding, as in the loss); ``nan`` if none is.

    The image is clamped to [0, 1]. Uses fused operations of the ``backend`` if it has them, else torch.
    """
    check_shapes({"target": (target, "H W 3"), "image": (image, "H W 3")})
    if target.numel() == 0 or (mask is not None and not bool(mask.any())):
        return math.nan
    with torch.no_grad():
        return float(losses.ssim(image.clamp(0, 1), target, mask, backend=backend))


def _metric(value: float) -> Metric:
    if math.isnan(value):
        return Metric(None, "no valid pixel")
    return Metric(None, "the images are equal: infinite") if math.isinf(value) else Metric(value)


def _lpips(network: Lpips | None, image: Tensor, target: Tensor, mask: Tensor | None, convention: str) -> Metric:
    if network is None:
        return Metric(None, f"no LPIPS weights: {REMEDY}")
    if min(image.shape[:2]) < MIN_SIZE:
        return Metric(None, f"the image is smaller than {MIN_SIZE} px")
    if mask is not None:
        if not bool(mask.any()):
            return Metric(None, "no valid pixel")
        image = torch.where(mask[..., None], image, target)
    with torch.no_grad():
        pair = (image.float().to(network.device), target.float().to(network.device))
        return _metric(float(network(*pair, convention=convention)))


def image_metrics(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    *,
    backend: str | Backend,
    lpips: Lpips | None = None,
) -> ImageMetrics:
    """Compute all image metrics of one view.

    ``image``, ``target`` [H, W, 3] in [0, 1]; the image is clamped to it. ``mask`` [H, W] bool: False = ignore this
    pixel. For LPIPS, the target replaces the image there, and the mean is over all pixels. ``lpips``: from
    ``evaluation.lpips.load_lpips``; without it LPIPS is null, with a remedy as the reason.
    """
    rounded = quantise(image).to(image.dtype) / 255, quantise(target).to(target.dtype) / 255
    return ImageMetrics(
        psnr=_metric(psnr_float(*rounded, mask)),
        ssim=_metric(ssim_float(*rounded, mask, backend=backend)),
        psnr_float=_metric(psnr_float(image, target, mask)),
        ssim_float=_metric(ssim_float(image, target, mask, backend=backend)),
        lpips=_lpips(lpips, *rounded, mask, "0..1"),
        lpips_signed=_lpips(lpips, *rounded, mask, "-1..1"),
    )


def mean_metrics(views: Sequence[ImageMetrics]) -> ImageMetrics:
    """Average each metric over the views that have it; the reason states how many do not, and why."""

    def mean(name: str) -> Metric:
        metrics = [getattr(view, name) for view in views]
        values = [metric.value for metric in metrics if metric.value is not None]
        reasons = [metric.reason for metric in metrics if metric.value is None]
        if not values:
            return Metric(None, reasons[0] if reasons else "no views")
        reason = f"{len(reasons)} of {len(views)} views left out: {reasons[0]}" if reasons else None
        return Metric(sum(values) / len(values), reason)

    return ImageMetrics(**{field.name: mean(field.name) for field in fields(ImageMetrics)})
