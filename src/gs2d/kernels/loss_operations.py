"""The fused loss operations of a backend: value and gradient of a loss in one pass of native code.

The formulas are in ``kernels/core/losses.h``; ``losses.formulas`` has the same in torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError

Vjp: TypeAlias = Callable[..., Sequence[Tensor | None]]
"""Gradients of the first tensors of a loss, from its tensors, those that it saved, which need one, and the cotangents.

Of several cotangents, some may be None, which is 0.
"""
Saved: TypeAlias = Sequence[Tensor | None]


@dataclass(frozen=True, eq=False)
class NormalOptions:
    """Inputs and options of normal consistency."""

    camera: Camera
    mask: Tensor | None = None  # [H, W] bool, False = ignore this pixel
    weights: Tensor | None = None  # [H, W], constant
    # Whether empty pixels lie at the camera centre: ``edges`` of ``losses.formulas.normals_from_depth``.
    at_camera: bool = False
    per_splat: bool = False  # the paper's mean(alpha - <n, N>), not the official mean(1 - alpha <n, N>), alpha detached


class LossOperations:
    """The fused losses of a processor, differentiable, with values that do not depend on the number of threads.

    All of them raise ShapeError if shapes differ, or if a tensor has another dtype or device than the processor needs.
    A subclass implements the methods with an underscore, which get checked, contiguous tensors and return the values of
    a loss, the tensors that it saves for the backward pass, and its :data:`Vjp`, which is only called if gradients are
    needed (``grad``).
    """

    @property
    def blur(self) -> Callable[[Tensor], Tensor] | None:
        """Computes the local mean of the target for :meth:`photometric`; None: caching it does not save time."""
        return None

    def _ready(self, **tensors: Tensor | None) -> list[Any]:
        """Return the tensors, detached and contiguous; ShapeError for another dtype or device."""
        raise NotImplementedError

    def _photometric(
        self, *images: Tensor | None, expected: tuple[float, float, float], grad: bool
    ) -> tuple[tuple[Tensor, Tensor, Tensor], Saved, Vjp]:
        """``images``: rendered, target, mask and target_mean."""
        raise NotImplementedError

    def _normal_consistency(
        self, normal: Tensor, depth: Tensor, alpha: Tensor, *, how: NormalOptions, expected: float, grad: bool
    ) -> tuple[Tensor, Saved, Vjp]:
        raise NotImplementedError

    def _normal_smoothness(self, *images: Tensor | None, expected: float, grad: bool) -> tuple[Tensor, Saved, Vjp]:
        """``images``: normal, alpha, flatness and mask."""
        raise NotImplementedError

    def _masked_mean(self, values: Tensor, mask: Tensor | None) -> tuple[Tensor, Saved, Vjp]:
        raise NotImplementedError

    def photometric(
        self,
        rendered: Tensor,
        target: Tensor,
        mask: Tensor | None = None,
        target_mean: Tensor | None = None,
        *,
        expected: tuple[float, float, float] = (0.8, -0.2, 0.0),
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean L1, SSIM and L2 of an image, all differentiable in ``rendered``, in one fused pass.

        Images are [H, W, 3] in [0, 1]; ``mask`` [H, W] bool, False = ignore this pixel. ``target_mean`` is
        ``blur(target)``, which saves time and changes no bit of the result. ``expected`` are the expected cotangents of
        the three values; others may cost a second pass. The values [] are means over valid pixels and channels, 0 if no
        pixel is valid; L2 is the mean squared difference.
        """
        shapes = {"target": (target, "H W 3"), "rendered": (rendered, "H W 3")}
        shapes |= {} if target_mean is None else {"target_mean": (target_mean, "H W 3")}
        check_shapes(shapes | ({} if mask is None else {"mask": (mask, "H W")}))
        _, target, target_mean = self._ready(rendered=rendered, target=target, target_mean=target_mean)
        loss = partial(self._photometric, expected=expected, grad=needs_gradient(rendered))
        l1, ssim, l2 = _Fused.apply(loss, rendered.contiguous(), target, _mask_of(mask, rendered), target_mean)
        return l1, ssim, l2

    def normal_consistency(
        self, normal: Tensor, depth: Tensor, alpha: Tensor, how: NormalOptions, *, expected: float = 0.05
    ) -> Tensor:
        """Return the normal consistency loss []: the functions of that name in ``losses.formulas``.

        ``normal`` [H, W, 3] is sum w n in the world frame, ``depth`` [H, W] is in world units, 0 where nothing was hit.
        Another cotangent than ``expected`` may cost a multiplication of the gradients.
        """
        shapes = {"depth": (depth, "H W"), "normal": (normal, "H W 3"), "alpha": (alpha, "H W")}
        shapes |= {} if how.mask is None else {"mask": (how.mask, "H W")}
        sizes = check_shapes(shapes | ({} if how.weights is None else {"weights": (how.weights, "H W")}))
        camera = how.camera
        if (camera.height, camera.width) != (sizes["H"], sizes["W"]):
            raise ShapeError(f"camera is {camera.width}x{camera.height}, but depth is {sizes['W']}x{sizes['H']}")
        *_, weights = self._ready(normal=normal, depth=depth, alpha=alpha, weights=how.weights)
        how = replace(how, mask=_mask_of(how.mask, normal), weights=weights)
        grad = needs_gradient(normal, depth, alpha)
        loss = partial(self._normal_consistency, how=how, expected=expected, grad=grad)
        value: Tensor = _Fused.apply(loss, normal.contiguous(), depth.contiguous(), alpha.contiguous())
        return value

    def normal_smoothness(
        self, normal: Tensor, alpha: Tensor, flatness: Tensor, mask: Tensor | None = None, *, expected: float = 1.0
    ) -> Tensor:
        """Return the normal smoothness loss []: ``losses.formulas.normal_smoothness`` has the shapes.

        Another cotangent than ``expected`` may cost a multiplication of the gradient.
        """
        shapes = {"normal": (normal, "H W 3"), "alpha": (alpha, "H W"), "flatness": (flatness, "H W")}
        check_shapes(shapes | ({} if mask is None else {"mask": (mask, "H W")}))
        if flatness.dtype != torch.uint8 or flatness.device != normal.device:
            raise ShapeError(f"flatness must be uint8 on {normal.device}, got {flatness.dtype} on {flatness.device}")
        _, alpha = self._ready(normal=normal, alpha=alpha)
        loss = partial(self._normal_smoothness, expected=expected, grad=needs_gradient(normal))
        value: Tensor = _Fused.apply(loss, normal.contiguous(), alpha, flatness.contiguous(), _mask_of(mask, normal))
        return value

    def masked_mean(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the mean [] of a map [H, W] over the pixels where ``mask`` is True, 0 if there are none.

        The summation order is fixed.
        """
        check_shapes({"values": (values, "H W")} | ({} if mask is None else {"mask": (mask, "H W")}))
        self._ready(values=values)
        mean: Tensor = _Fused.apply(self._masked_mean, values.contiguous(), _mask_of(mask, values))
        return mean


class _Fused(torch.autograd.Function):
    """The values of a loss of some tensors; ``loss`` returns them, what it saves and its :data:`Vjp`."""

    @staticmethod
    def forward(ctx: Any, loss: Callable[..., tuple[Any, Saved, Vjp]], *tensors: Tensor | None) -> Any:
        values, saved, ctx.vjp = loss(*tensors)
        ctx.count = len(tensors)
        ctx.save_for_backward(*tensors, *saved)  # notices if a caller changes one in place
        ctx.set_materialize_grads(isinstance(values, Tensor))
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors, saved = ctx.saved_tensors[: ctx.count], ctx.saved_tensors[ctx.count :]
        gradients = ctx.vjp(tensors, saved, ctx.needs_input_grad[1:], *cotangents)
        return None, *gradients, *[None] * (len(tensors) - len(gradients))


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether autograd records these tensors (an autograd.Function cannot tell in its forward pass)."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _mask_of(mask: Tensor | None, like: Tensor) -> Tensor | None:
    """Return the mask, contiguous; ShapeError unless it is bool on the device of an image."""
    if mask is not None and (mask.dtype != torch.bool or mask.device != like.device):
        raise ShapeError(f"mask must be bool on {like.device}, got {mask.dtype} on {mask.device}")
    return None if mask is None else mask.contiguous()
