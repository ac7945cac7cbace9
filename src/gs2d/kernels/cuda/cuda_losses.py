"""The image losses on a GPU, over a launcher, without waiting.

Values are summed in a fixed order, so they are the same from run to run. Unlike in the native losses, gradients are
computed in the backward pass, with cotangents read on the device; expected ones are unused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gs2d.errors import ShapeError
from gs2d.kernels.cuda.kernel_arguments import THREADS, arguments_of
from gs2d.kernels.loss_operations import LossOperations, NormalOptions, Saved, Vjp

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


def _cotangent(gradient: Tensor | None) -> Tensor | None:
    return None if gradient is None else gradient.detach().to(torch.float32).contiguous()


def strips(height: int, width: int) -> int:
    """Return the number of blocks of photometric.cu."""
    return -(-3 * width // STRIP) * -(-height // STRIP_ROWS)


def _normal_inputs(how: NormalOptions) -> dict[str, Any]:
    """Return the options that both passes of normal consistency take."""
    inputs: dict[str, Any] = {"mask": how.mask, "weights": how.weights}
    inputs |= {name: getattr(how.camera, name) for name in ("height", "width", "fx", "fy", "cx", "cy")}
    inputs |= {"per_splat": int(how.per_splat), "at_camera": int(how.at_camera)}
    return inputs | {"rotation": tuple(np.asarray(how.camera.rotation).ravel().tolist())}


class CudaLosses(LossOperations):
    """The losses of CUDA kernels; the launcher is that of the tensors' device."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher

    def _ready(self, **tensors: Tensor | None) -> list[Any]:
        return ready(**tensors)

    def _launch(self, kernel: str, blocks: int, *named: Mapping[str, Any], **fields: Any) -> None:
        self._launcher.launch(kernel, blocks, THREADS, arguments_of(kernel, *named, **fields))

    def _finish(self, partials: Tensor, *, complement: bool = False) -> Tensor:
        """Return [1 / count, mean, ...] from the blocks' [count, sum, ...], one row each."""
        means = partials.new_empty(len(partials))
        counts = {"blocks": partials.shape[1], "values": len(partials) - 1, "complement": int(complement)}
        self._launch("finish_means", 1, counts, partials=partials, means=means)
        return means

    def _photometric(
        self, *images: Tensor | None, expected: tuple[float, float, float], grad: bool
    ) -> tuple[tuple[Tensor, Tensor, Tensor], Saved, Vjp]:
        rendered: Any = images[0]
        height, width = rendered.shape[:2]
        blocks = strips(height, width)
        partials = rendered.new_empty(4, blocks)
        maps = rendered.new_empty(3, height, width, 3) if grad else None
        tensors, size = (
            dict(zip(("rendered", "target", "mask"), images, strict=False)),
            {"height": height, "width": width},
        )
        self._launch("photometric_forward", blocks, tensors, size, maps=maps, partials=partials)
        means = self._finish(partials)

        def vjp(images: Sequence[Any], saved: Saved, needed: Sequence[bool], *cotangents: Tensor | None) -> Saved:
            gradient, (maps, means) = torch.empty_like(images[0]), saved
            inputs = dict(zip(("rendered", "target", "mask"), images, strict=False))
            inputs |= dict(zip(("g_l1", "g_ssim", "g_l2"), map(_cotangent, cotangents), strict=True))
            self._launch("photometric_vjp", blocks, size, inputs, maps=maps, means=means, gradient=gradient)
            return (gradient,)

        return (means[1].clone(), means[2].clone(), means[3].clone()), (maps, means), vjp

    def _normal_consistency(
        self, normal: Tensor, depth: Tensor, alpha: Tensor, *, how: NormalOptions, expected: float, grad: bool
    ) -> tuple[Tensor, Saved, Vjp]:
        blocks, options = -(-depth.numel() // MEAN_PIXELS), _normal_inputs(how)
        partials = depth.new_empty(2, blocks)
        self._launch("normal_consistency", blocks, options, normal=normal, depth=depth, alpha=alpha, partials=partials)
        means = self._finish(partials, complement=not how.per_splat and how.weights is None)

        def vjp(images: Sequence[Any], saved: Saved, needed: Sequence[bool], cotangent: Tensor) -> Saved:
            mask = [*needed[:2], needed[2] and how.per_splat]
            gradients = [torch.empty_like(x) if w else None for x, w in zip(images, mask, strict=True)]
            tiles = -(-how.camera.width // NORMAL_W) * -(-how.camera.height // NORMAL_H)
            inputs = dict(zip(("normal", "depth", "alpha"), images, strict=True))
            outputs = dict(zip(("g_normal", "g_depth", "g_alpha"), gradients, strict=True))
            outputs |= {"means": saved[0], "cotangent": _cotangent(cotangent)}
            self._launch("normal_consistency_vjp", tiles, options, inputs, outputs)
            return gradients

        return means[1].clone(), [means], vjp

    def _normal_smoothness(self, *images: Tensor | None, expected: float, grad: bool) -> tuple[Tensor, Saved, Vjp]:
        normal: Any = images[0]
        height, width = normal.shape[:2]
        blocks, size = -(-height * width // MEAN_PIXELS), {"height": height, "width": width}
        partials, names = normal.new_empty(2, blocks), ("normal", "alpha", "flatness", "mask")
        self._launch("normal_smoothness", blocks, size, dict(zip(names, images, strict=True)), partials=partials)
        means = self._finish(partials)

        def vjp(images: Sequence[Any], saved: Saved, needed: Sequence[bool], cotangent: Tensor) -> Saved:
            gradient = torch.empty_like(images[0])
            outputs = {"means": saved[0], "cotangent": _cotangent(cotangent), "g_normal": gradient}
            self._launch("normal_smoothness", blocks, size, dict(zip(names, images, strict=True)), outputs)
            return (gradient,)

        return means[1].clone(), [means], vjp

    def _masked_mean(self, values: Tensor, mask: Tensor | None) -> tuple[Tensor, Saved, Vjp]:
        blocks = -(-values.numel() // MEAN_PIXELS)
        partials = values.new_empty(2, blocks)
        height, width = values.shape
        inputs = {"values": values, "mask": mask, "partials": partials}
        self._launch("masked_mean", blocks, inputs, height=height, width=width)
        means = self._finish(partials)

        def vjp(tensors: Sequence[Any], saved: Sequence[Any], needed: Sequence[bool], cotangent: Tensor) -> Saved:
            (values, mask), (means,) = tensors, saved
            each = cotangent * means[0]
            return (each.expand_as(values) if mask is None else mask * each,)

        return means[1].clone(), [means], vjp
