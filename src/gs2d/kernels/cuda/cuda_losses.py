"""The image losses on a GPU, over a launcher, without waiting.

Values are summed in a fixed order, so they are the same from run to run. Unlike in the native losses, gradients are
computed in the backward pass, with cotangents read on the device; expected ones are unused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.errors import ShapeError
from gs2d.kernels.cuda.kernel_arguments import THREADS, arguments_of
from gs2d.kernels.loss_operations import LossOperations, NormalOptions

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher

STRIP, STRIP_ROWS = 128, 32  # photometric.cu: reals and rows per block
MEAN_PIXELS = 1024  # losses.cu: pixels per block
NORMAL_W, NORMAL_H = 32, 8  # losses.cu: tile of the backward pass


def ready(**tensors: Tensor | None) -> list[Any]:
    """Return the tensors, detached and contiguous; ShapeError unless all are float32 on the device of the first."""
    (first, *_) = tensors.values()
    assert first is not None
    for name, tensor in tensors.items():
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device != first.device):
            raise ShapeError(
                f"{name} must be float32 on {first.device} for the cuda kernels, got {tensor.dtype} on "
                f"{tensor.device}; convert it, or use the reference backend"
            )
    return [None if tensor is None else tensor.detach().contiguous() for tensor in tensors.values()]


def _cotangent(given: Tensor | None) -> Tensor | None:
    return None if given is None else given.detach().to(torch.float32).contiguous()


def strips(height: int, width: int) -> int:
    """Return the number of blocks of photometric.cu."""
    return -(-3 * width // STRIP) * -(-height // STRIP_ROWS)


def _launch(launcher: Launcher, kernel: str, blocks: int, *named: Mapping[str, Any], **fields: Any) -> None:
    launcher.launch(kernel, blocks, THREADS, arguments_of(kernel, *named, **fields))


def _finish(launcher: Launcher, partials: Tensor, *, complement: bool = False) -> Tensor:
    """Return [1 / count, mean, ...] from the blocks' [count, sum, ...], one row each."""
    means = partials.new_empty(len(partials))
    counts = {"blocks": partials.shape[1], "values": len(partials) - 1, "complement": int(complement)}
    _launch(launcher, "finish_means", 1, counts, partials=partials, means=means)
    return means


class _CudaPhotometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,
        target: Tensor,
        mask: Tensor | None,
        target_mean: Tensor | None,
        expected: tuple[float, float, float],
        wanted: bool,
        launcher: Launcher,
    ) -> tuple[Tensor, Tensor, Tensor]:
        height, width = rendered.shape[:2]
        blocks = strips(height, width)
        partials = rendered.new_empty(4, blocks)
        maps = rendered.new_empty(3, height, width, 3) if wanted else None
        given = {"rendered": rendered, "target": target, "mask": mask, "maps": maps, "partials": partials}
        _launch(launcher, "photometric_forward", blocks, given, height=height, width=width)
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
        tensors = {"rendered": rendered, "target": target, "mask": mask, "maps": maps, "means": means}
        tensors |= dict(zip(("g_l1", "g_ssim", "g_l2"), map(_cotangent, given), strict=True)) | {"gradient": gradient}
        _launch(ctx.launcher, "photometric_vjp", strips(height, width), tensors, height=height, width=width)
        return gradient, *[None] * 6


def _normal_inputs(how: NormalOptions, normal: Tensor, depth: Tensor, alpha: Tensor) -> dict[str, Any]:
    """Return the arguments that both passes of normal consistency take."""
    inputs: dict[str, Any] = {"normal": normal, "depth": depth, "alpha": alpha}
    inputs |= {"mask": how.mask, "weights": how.weights}
    inputs |= {name: getattr(how.camera, name) for name in ("height", "width", "fx", "fy", "cx", "cy")}
    inputs |= {"per_splat": int(how.per_splat), "at_camera": int(how.at_camera)}
    return inputs | {"rotation": tuple(np.asarray(how.camera.rotation).ravel().tolist())}


class _CudaNormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        depth: Tensor,
        alpha: Tensor,
        how: NormalOptions,
        expected: float,
        wanted: bool,
        launcher: Launcher,
    ) -> Tensor:
        blocks = -(-depth.numel() // MEAN_PIXELS)
        partials = depth.new_empty(2, blocks)
        inputs = _normal_inputs(how, normal, depth, alpha)
        _launch(launcher, "normal_consistency", blocks, inputs, partials=partials)
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
        outputs = dict(zip(("g_normal", "g_depth", "g_alpha"), gradients, strict=True))
        outputs |= {"means": means, "cotangent": _cotangent(cotangent)}
        _launch(ctx.launcher, "normal_consistency_vjp", blocks, _normal_inputs(ctx.how, *images), outputs)
        return (*gradients, *[None] * 4)


class _CudaNormalSmoothness(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        alpha: Tensor,
        flatness: Tensor,
        mask: Tensor | None,
        expected: float,
        wanted: bool,
        launcher: Launcher,
    ) -> Tensor:
        (height, width), blocks = alpha.shape, -(-alpha.numel() // MEAN_PIXELS)
        inputs = {"normal": normal, "alpha": alpha, "flatness": flatness, "mask": mask}
        partials = normal.new_empty(2, blocks)
        _launch(launcher, "normal_smoothness", blocks, inputs, partials=partials, height=height, width=width)
        ctx.launcher = launcher
        means = _finish(launcher, partials)
        ctx.save_for_backward(*inputs.values(), means)
        return means[1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        normal, alpha, flatness, mask, means = ctx.saved_tensors
        gradient, (height, width) = torch.empty_like(normal), alpha.shape
        inputs = {"normal": normal, "alpha": alpha, "flatness": flatness, "mask": mask, "means": means}
        inputs |= {"cotangent": _cotangent(cotangent), "g_normal": gradient}
        blocks = -(-alpha.numel() // MEAN_PIXELS)
        _launch(ctx.launcher, "normal_smoothness", blocks, inputs, height=height, width=width)
        return gradient, *[None] * 6


class _CudaMaskedMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, mask: Tensor | None, launcher: Launcher) -> Tensor:
        blocks = -(-values.numel() // MEAN_PIXELS)
        partials = values.new_empty(2, blocks)
        height, width = values.shape
        given = {"values": values, "mask": mask, "partials": partials}
        _launch(launcher, "masked_mean", blocks, given, height=height, width=width)
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


class CudaLosses(LossOperations):
    """The losses of CUDA kernels; the engine is the launcher of the tensors' device."""

    functions = (_CudaPhotometric, _CudaNormalConsistency, _CudaNormalSmoothness, _CudaMaskedMean)

    def _ready(self, **tensors: Tensor | None) -> list[Any]:
        return ready(**tensors)
