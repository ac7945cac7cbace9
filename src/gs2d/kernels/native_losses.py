"""Native image losses for autograd: the same bits for any number of threads.

Each loss computes the gradient with its value, for the expected cotangent (the weight of the loss term). Another
cotangent also gives the correct gradient, at the cost of a second pass or a multiplication.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.kernels.library import Library, ready_library
from gs2d.kernels.loss_operations import LossOperations, NormalOptions, Saved, Vjp


def _for_expected(expected: float) -> Vjp:
    """Return a function that returns the saved gradients, multiplied if the cotangent is not ``expected``."""

    def vjp(images: Sequence[Any], saved: Saved, needed: Sequence[bool], cotangent: Tensor) -> Saved:
        if torch.equal(cotangent, torch.tensor(expected, dtype=torch.float64).to(cotangent.dtype)):
            return saved
        return [None if gradient is None else gradient * (cotangent / expected) for gradient in saved]

    return vjp


class NativeLosses(LossOperations):
    """The losses of a native library, by default :func:`ready_library`."""

    def __init__(self, library: Library | None = None) -> None:
        self._library = library or ready_library()

    def _call(self, name: str, *arguments: Any) -> None:
        if self._library.call(name, *arguments) != 0:
            raise MemoryError(f"{name} could not allocate its scratch rows")

    def _ready(self, **tensors: Tensor | None) -> list[Any]:
        return self._library.arrays(**tensors)

    @property
    def blur(self) -> Callable[[Tensor], Tensor]:
        """Filters an image [H, W, 3] with the SSIM window (11x11 Gaussian, sigma 1.5, zero outside), no gradient."""
        return self._blur

    def _blur(self, image: Tensor) -> Tensor:
        sizes = check_shapes({"image": (image, "H W 3")})
        (source,) = self._ready(image=image)
        out = torch.empty_like(source)
        self._call("gs2d_blur", source, sizes["H"], sizes["W"], out)
        return out

    def _photometric(
        self, *images: Tensor | None, expected: tuple[float, float, float], grad: bool
    ) -> tuple[tuple[Tensor, Tensor, Tensor], Saved, Vjp]:
        def compare(images: Sequence[Any], cotangents: Sequence[float], gradient: Tensor | None) -> Tensor:
            values = torch.empty(3, dtype=torch.float64)
            height, width = images[0].shape[:2]
            self._call("gs2d_photometric", *images, height, width, *cotangents, gradient, values)
            return values.to(images[0].dtype)

        def vjp(images: Sequence[Any], saved: Saved, needed: Sequence[bool], *upstream: Tensor | None) -> Saved:
            cotangents = torch.stack([rounded.new_zeros(()) if one is None else one for one in upstream])
            if torch.equal(cotangents, rounded):
                return saved
            gradient = torch.empty_like(images[0])
            compare(images, cotangents.tolist(), gradient)
            return (gradient,)

        rendered: Any = images[0]
        gradient = torch.empty_like(rendered) if grad else None
        values = compare(images, expected, gradient)
        rounded = torch.tensor(expected, dtype=torch.float64).to(rendered.dtype)  # like the cotangents
        return (values[0], values[1], values[2]), [gradient], vjp

    def _normal_consistency(
        self, normal: Tensor, depth: Tensor, alpha: Tensor, *, how: NormalOptions, expected: float, grad: bool
    ) -> tuple[Tensor, Saved, Vjp]:
        camera, expected = how.camera, expected if expected != 0 else 1.0
        gradients = [torch.empty_like(image) if grad else None for image in (normal, depth)]
        gradients.append(torch.empty_like(alpha) if grad and how.per_splat else None)
        intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
        rotation = torch.tensor(camera.rotation, dtype=torch.float64).contiguous()
        value = torch.empty(1, dtype=torch.float64)
        inputs = (normal, depth, alpha, how.mask, how.weights, intrinsics, rotation)
        sizes = (camera.height, camera.width, int(how.per_splat), int(how.at_camera), expected)
        self._call("gs2d_normal_consistency", *inputs, *sizes, *gradients, value)
        return value[0].to(normal.dtype), gradients, _for_expected(expected)

    def _normal_smoothness(self, *images: Tensor | None, expected: float, grad: bool) -> tuple[Tensor, Saved, Vjp]:
        normal: Any = images[0]
        gradient, expected = torch.empty_like(normal) if grad else None, expected if expected != 0 else 1.0
        value = torch.empty(1, dtype=torch.float64)
        self._call("gs2d_normal_smoothness", *images, *normal.shape[:2], expected, gradient, value)
        return value[0].to(normal.dtype), [gradient], _for_expected(expected)

    def _masked_mean(self, values: Tensor, mask: Tensor | None) -> tuple[Tensor, Saved, Vjp]:
        mean = torch.empty(1, dtype=torch.float64)
        self._call("gs2d_masked_mean", values, mask, *values.shape, mean)

        def vjp(tensors: Sequence[Any], saved: Saved, needed: Sequence[bool], cotangent: Tensor) -> Saved:
            values, mask = tensors
            if mask is None:
                return ((cotangent / max(values.numel(), 1)).expand_as(values),)
            return (mask.to(cotangent.dtype) * (cotangent / max(int(mask.sum()), 1)),)

        return mean[0].to(values.dtype), (), vjp
