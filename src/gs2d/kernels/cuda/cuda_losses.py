"""The image losses on a GPU: the functions of ``kernels/native_losses.py`` over a launcher, without waiting.

Values are summed in a fixed order, so they are the same from run to run. Unlike in the native losses, gradients are
computed in the backward pass, with cotangents read on the device; ``expected`` is accepted for the same signature. The
formulas are in ``kernels/core/losses.h``; ``losses.formulas`` has the same in torch.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.cuda.kernel_arguments import THREADS, arguments_of
from gs2d.kernels.native_losses import NormalOptions, check_smoothness, needs_gradient

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher

__all__ = ["masked_mean", "normal_consistency", "normal_smoothness", "photometric", "strips"]

STRIP, STRIP_ROWS = 128, 32  # photometric.cu: reals and rows per block
MEAN_PIXELS = 1024  # losses.cu: pixels per block
NORMAL_W, NORMAL_H = 32, 8  # losses.cu: tile of the backward pass


def ready(**tensors: Tensor) -> list[Tensor]:
    """Return the tensors, detached and contiguous; ShapeError unless all are float32 on the device of the first."""
    device = next(iter(tensors.values())).device
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32 or tensor.device != device:
            raise ShapeError(
                f"{name} must be float32 on {device} for the cuda kernels, got {tensor.dtype} on {tensor.device}; "
                "convert it, or use the reference backend"
            )
    return [tensor.detach().contiguous() for tensor in tensors.values()]


def _mask_of(mask: Tensor | None, device: torch.device) -> Tensor | None:
    if mask is None:
        return None
    if mask.dtype != torch.bool or mask.device != device:
        raise ShapeError(f"mask must be bool on {device}, got {mask.dtype} on {mask.device}")
    return mask.contiguous()


def _cotangent(given: Tensor | None) -> Tensor | None:
    return None if given is None else given.detach().to(torch.float32).contiguous()


def strips(height: int, width: int) -> int:
    """Return the number of blocks of photometric.cu."""
    return -(-3 * width // STRIP) * -(-height // STRIP_ROWS)


def _finish(launcher: Launcher, partials: Tensor, *, complement: bool = False) -> Tensor:
    """Return [1 / count, mean, ...] from the blocks' [count, sum, ...], one row each."""
    means = partials.new_empty(len(partials))
    counts = {"blocks": partials.shape[1], "values": len(partials) - 1, "complement": int(complement)}
    arguments = arguments_of("finish_means", counts, partials=partials, means=means)
    launcher.launch("finish_means", 1, THREADS, arguments)
    return means


class _CudaPhotometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,
        target: Tensor,
        mask: Tensor | None,
        wanted: bool,
        launcher: Launcher,
    ) -> tuple[Tensor, Tensor, Tensor]:
        height, width = rendered.shape[:2]
        blocks = strips(height, width)
        partials = rendered.new_empty(4, blocks)
        maps = rendered.new_empty(3, height, width, 3) if wanted else None
        if blocks > 0:
            given = {"rendered": rendered, "target": target, "mask": mask, "maps": maps, "partials": partials}
            arguments = arguments_of("photometric_forward", given, height=height, width=width)
            launcher.launch("photometric_forward", blocks, THREADS, arguments)
        means = _finish(launcher, partials)
        ctx.launcher = launcher
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(rendered, target, mask, maps, means)
        return means[1].clone(), means[2].clone(), means[3].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        rendered, target, mask, maps, means = ctx.saved_tensors
        gradient = torch.empty_like(rendered)
        height, width = rendered.shape[:2]
        if gradient.numel() > 0:
            cotangents = dict(zip(("g_l1", "g_ssim", "g_l2"), map(_cotangent, given), strict=True))
            tensors = {"rendered": rendered, "target": target, "mask": mask, "maps": maps, "means": means}
            tensors |= {"gradient": gradient}
            arguments = arguments_of("photometric_vjp", tensors, cotangents, height=height, width=width)
            ctx.launcher.launch("photometric_vjp", strips(height, width), THREADS, arguments)
        return gradient, None, None, None, None


def photometric(
    rendered: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    target_mean: Tensor | None = None,
    *,
    expected: tuple[float, float, float] = (0.8, -0.2, 0.0),
    launcher: Launcher,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean L1, SSIM and L2 of an image, all differentiable in ``rendered``.

    Parameters
    ----------
    rendered, target : Tensor [H, W, 3] float32
        In [0, 1].
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    target_mean, expected
        Unused.
    launcher : Launcher
        Launcher of the tensors' device.

    Returns
    -------
    l1, ssim, l2 : Tensor []
        Means over valid pixels and channels; 0 if no pixel is valid. L2 is the mean squared difference.

    Raises
    ------
    ShapeError
        If shapes, dtypes or devices differ.
    """
    del target_mean, expected
    shapes = {"rendered": (rendered, "H W 3"), "target": (target, "H W 3")}
    check_shapes(shapes | ({} if mask is None else {"mask": (mask, "H W")}))
    _, target = ready(rendered=rendered, target=target)
    mask = _mask_of(mask, rendered.device)
    l1, ssim, l2 = _CudaPhotometric.apply(rendered.contiguous(), target, mask, needs_gradient(rendered), launcher)
    return l1, ssim, l2


def _normal_arguments(images: Sequence[Tensor], how: NormalOptions, **more: Tensor | None) -> ctypes.Structure:
    normal, depth, alpha = images
    tensors = {"normal": normal, "depth": depth, "alpha": alpha, "mask": how.mask, "weights": how.weights, **more}
    options = {"per_splat": int(how.per_splat), "at_camera": int(how.at_camera)}
    lens = {name: getattr(how.camera, name) for name in ("height", "width", "fx", "fy", "cx", "cy")}
    arguments = arguments_of("normal_consistency", tensors, options, lens)
    arguments.rotation[:] = np.asarray(how.camera.rotation).ravel().tolist()
    return arguments


class _CudaNormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        depth: Tensor,
        alpha: Tensor,
        how: NormalOptions,
        launcher: Launcher,
    ) -> Tensor:
        blocks = -(-depth.numel() // MEAN_PIXELS)
        partials = depth.new_empty(2, blocks)
        if blocks > 0:
            arguments = _normal_arguments((normal, depth, alpha), how, partials=partials)
            launcher.launch("normal_consistency", blocks, THREADS, arguments)
        means = _finish(launcher, partials, complement=not how.per_splat and how.weights is None)
        ctx.launcher, ctx.how = launcher, how
        ctx.save_for_backward(normal, depth, alpha, means)
        return means[1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        *images, means = ctx.saved_tensors
        want = [*ctx.needs_input_grad[:2], ctx.needs_input_grad[2] and ctx.how.per_splat]
        gradients = [torch.empty_like(x) if w else None for x, w in zip(images, want, strict=True)]
        blocks = -(-ctx.how.camera.width // NORMAL_W) * -(-ctx.how.camera.height // NORMAL_H)
        if images[1].numel() > 0:
            g_normal, g_depth, g_alpha = gradients
            given = _cotangent(cotangent)
            outputs = {"g_normal": g_normal, "g_depth": g_depth, "g_alpha": g_alpha}
            outputs |= {"means": means, "cotangent": given}
            arguments = _normal_arguments(images, ctx.how, **outputs)
            ctx.launcher.launch("normal_consistency_vjp", blocks, THREADS, arguments)
        return (*gradients, None, None)


def normal_consistency(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    how: NormalOptions,
    *,
    expected: float = 0.05,
    launcher: Launcher,
) -> Tensor:
    """Return the normal consistency loss [], the CUDA form of the functions in ``losses.formulas``.

    Parameters
    ----------
    normal : Tensor [H, W, 3] float32
        sum w n, world frame.
    depth : Tensor [H, W] float32, world units
        0 where nothing was hit.
    alpha : Tensor [H, W] float32
    how : NormalOptions
    expected : float
        Unused.
    launcher : Launcher
        Launcher of the tensors' device.

    Raises
    ------
    ShapeError
        If shapes, dtypes or devices differ.
    """
    del expected
    how.check(normal, depth, alpha)
    ready(normal=normal, depth=depth, alpha=alpha)
    weights = None if how.weights is None else ready(normal=normal, weights=how.weights)[1]
    how = replace(how, mask=_mask_of(how.mask, normal.device), weights=weights)
    images = (normal.contiguous(), depth.contiguous(), alpha.contiguous())
    value: Tensor = _CudaNormalConsistency.apply(*images, how, launcher)
    return value


class _CudaNormalSmoothness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, launcher: Launcher, *images: Tensor | None) -> Tensor:
        normal = images[0]
        assert normal is not None
        partials = normal.new_empty(2, -(-normal.shape[0] * normal.shape[1] // MEAN_PIXELS))
        _smoothness(launcher, images, partials=partials)
        means = _finish(launcher, partials)
        ctx.launcher = launcher
        ctx.save_for_backward(*images, means)
        return means[1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        *images, means = ctx.saved_tensors
        gradient = torch.empty_like(images[0])
        _smoothness(ctx.launcher, images, means=means, cotangent=_cotangent(cotangent), g_normal=gradient)
        return None, gradient, None, None, None


def _smoothness(launcher: Launcher, images: Sequence[Tensor | None], **more: Tensor | None) -> None:
    normal, alpha, flatness, mask = images
    assert normal is not None
    given = {"normal": normal, "alpha": alpha, "flatness": flatness, "mask": mask}
    height, width = normal.shape[:2]
    arguments = arguments_of("normal_smoothness", given, more, height=height, width=width)
    if normal.numel() > 0:
        launcher.launch("normal_smoothness", -(-normal.shape[0] * normal.shape[1] // MEAN_PIXELS), THREADS, arguments)


def normal_smoothness(
    normal: Tensor,
    alpha: Tensor,
    flatness: Tensor,
    mask: Tensor | None = None,
    *,
    expected: float = 1.0,
    launcher: Launcher,
) -> Tensor:
    """Return the CUDA form of ``losses.formulas.normal_smoothness``; ``expected`` is unused."""
    del expected
    check_smoothness(normal, alpha, flatness, mask)
    _, alpha = ready(normal=normal, alpha=alpha)
    given = normal.contiguous(), alpha, flatness.contiguous(), _mask_of(mask, normal.device)
    value: Tensor = _CudaNormalSmoothness.apply(launcher, *given)
    return value


class _CudaMaskedMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, mask: Tensor | None, launcher: Launcher) -> Tensor:
        blocks = -(-values.numel() // MEAN_PIXELS)
        partials = values.new_empty(2, blocks)
        if blocks > 0:
            height, width = values.shape
            given = {"values": values, "mask": mask, "partials": partials}
            arguments = arguments_of("masked_mean", given, height=height, width=width)
            launcher.launch("masked_mean", blocks, THREADS, arguments)
        means = _finish(launcher, partials)
        ctx.shape = values.shape
        ctx.save_for_backward(mask, means)
        return means[1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        mask, means = ctx.saved_tensors
        each = cotangent * means[0]
        return (each.expand(ctx.shape) if mask is None else mask * each), None, None


def masked_mean(values: Tensor, mask: Tensor | None = None, *, launcher: Launcher) -> Tensor:
    """Return the mean [] of a map [H, W] over the pixels where ``mask`` is True, 0 if there are none.

    The summation order is fixed.
    """
    check_shapes({"values": (values, "H W")} | ({} if mask is None else {"mask": (mask, "H W")}))
    ready(values=values)
    mean: Tensor = _CudaMaskedMean.apply(values.contiguous(), _mask_of(mask, values.device), launcher)
    return mean
