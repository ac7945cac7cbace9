"""The fused loss operations of a backend: value and gradient of a loss in one pass of native code.

The formulas are in ``kernels/core/losses.h``; ``losses.formulas`` has the same in torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError


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
    ``functions`` are the torch.autograd.Functions of photometric losses, normal consistency, normal smoothness and
    masked mean; their arguments are contiguous and checked, and the last one is the engine, a library or launcher.
    """

    functions: ClassVar[tuple[Any, Any, Any, Any]]

    def __init__(self, engine: Any) -> None:
        self._engine = engine

    @property
    def blur(self) -> Callable[[Tensor], Tensor] | None:
        """Computes the local mean of the target for :meth:`photometric`; None: caching it does not save time."""
        return None

    def _ready(self, **tensors: Tensor | None) -> list[Any]:
        """Return the tensors, detached and contiguous; ShapeError for another dtype or device."""
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
        given = (target, _mask_of(mask, rendered), target_mean, expected, needs_gradient(rendered))
        l1, ssim, l2 = self.functions[0].apply(rendered.contiguous(), *given, self._engine)
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
        images = (normal.contiguous(), depth.contiguous(), alpha.contiguous())
        wanted = needs_gradient(normal, depth, alpha)
        value: Tensor = self.functions[1].apply(*images, how, expected, wanted, self._engine)
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
        given = (alpha, flatness.contiguous(), _mask_of(mask, normal), expected, needs_gradient(normal))
        value: Tensor = self.functions[2].apply(normal.contiguous(), *given, self._engine)
        return value

    def masked_mean(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the mean [] of a map [H, W] over the pixels where ``mask`` is True, 0 if there are none.

        The summation order is fixed.
        """
        check_shapes({"values": (values, "H W")} | ({} if mask is None else {"mask": (mask, "H W")}))
        self._ready(values=values)
        mean: Tensor = self.functions[3].apply(values.contiguous(), _mask_of(mask, values), self._engine)
        return mean


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether autograd records these tensors (an autograd.Function cannot tell in its forward pass)."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _mask_of(mask: Tensor | None, like: Tensor) -> Tensor | None:
    """Return the mask, contiguous; ShapeError unless it is bool on the device of an image."""
    if mask is not None and (mask.dtype != torch.bool or mask.device != like.device):
        raise ShapeError(f"mask must be bool on {like.device}, got {mask.dtype} on {mask.device}")
    return None if mask is None else mask.contiguous()
