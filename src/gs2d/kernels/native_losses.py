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
from gs2d.kernels.loss_operations import Kept, LossOperations, NormalOptions, Vjp


def _for_expected(expected: float) -> Vjp:
    """Return a function that returns the kept gradients, multiplied if the cotangent is not ``expected``."""

    def vjp(images: Sequence[Any], kept: Kept, needed: Sequence[bool], cotangent: Tensor) -> Kept:
        if torch.equal(cotangent, torch.tensor(expected, dtype=torch.float64).to(cotangent.dtype)):
            return kept
        return [None if gradient is None else gradient * (cotangent / expected) for gradient in kept]

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
        self, *images: Tensor | None, expected: tuple[float, float, float], wanted: bool
    ) -> tuple[tuple[Tensor, Tensor, Tensor], Kept, Vjp]:
        def compare(images: Sequence[Any], cotangents: Sequence[float], gradient: Tensor | None) -> Tensor:
            values = torch.empty(3, dtype=torch.float64)
            height, width = images[0].shape[:2]
            self._call("gs2d_photometric", *images, height, width, *cotangents, gradient, values)
            return values.to(images[0].dtype)

        def vjp(images: Sequence[Any], kept: Kept, needed: Sequence[bool], *given: Tensor | None) -> Kept:
            cotangents = torch.stack([rounded.new_zeros(()) if one is None else one for one in given])
            if torch.equal(cotangents, rounded):
                return kept
            gradient = torch.empty_like(images[0])
            compare(images, cotangents.tolist(), gradient)
            return (gradient,)

        rendered: Any = images[0]
        gradient = torch.empty_like(rendered) if wanted else None
        values = compare(images, expected, gradient)
        rounded = torch.tensor(expected, dtype=torch.float64).to(rendered.dtype)  # like the cotangents
        return (values[0], values[1], values[2]), [gradient], vjp

    def _normal_consistency(
        self, normal: Tensor, depth: Tensor, alpha: Tensor, *, how: NormalOptions, expected: float, wanted: bool
    ) -> tuple[Tensor, Kept, Vjp]:
        camera, expected = how.camera, expected if expected != 0 else 1.0
        gradients = [torch.empty_like(image) if wanted else None for image in (normal, depth)]
        gradients.append(torch.empty_like(alpha) if wanted and how.per_splat else None)
        intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
        rotation = torch.tensor(camera.rotation, dtype=torch.float64).contiguous()
        value = torch.empty(1, dtype=torch.float64)
        inputs = (normal, depth, alpha, how.mask, how.weights, intrinsics, rotation)
        sizes = (camera.height, camera.width, int(how.per_splat), int(how.at_camera), expected)
        self._call("gs2d_normal_consistency", *inputs, *sizes, *gradients, value)
        return value[0].to(normal.dtype), gradients, _for_expected(expected)

    def _normal_smoothness(self, *images: Tensor | None, expected: float, wanted: bool) -> tuple[Tensor, Kept, Vjp]:
        normal: Any = images[0]
        gradient, expected = torch.empty_like(normal) if wanted else None, expected if expected != 0 else 1.0
        value = torch.empty(1, dtype=torch.float64)
        self._call("gs2d_normal_smoothness", *images, *normal.shape[:2], expected, gradient, value)
        return value[0].to(normal.dtype), [gradient], _for_expected(expected)

    def _masked_mean(self, values: Tensor, mask: Tensor | None) -> tuple[Tensor, Kept, Vjp]:
        mean = torch.empty(1, dtype=torch.float64)
        self._call("gs2d_masked_mean", values, mask, *values.shape, mean)

        def vjp(tensors: Sequence[Any], kept: Kept, needed: Sequence[bool], cotangent: Tensor) -> Kept:
            values, mask = tensors
            if mask is None:
                return ((cotangent / max(values.numel(), 1)).expand_as(values),)
            return (mask.to(cotangent.dtype) * (cotangent / max(int(mask.sum()), 1)),)

        return mean[0].to(values.dtype), (), vjp
