"""Native image losses for autograd: fused value and gradient, the same bits for any number of threads.

Each function computes the gradient in its forward pass, for the expected cotangent (the weight of the loss term), and
returns it in the backward pass. Another cotangent also gives the correct gradient, at the cost of a second pass. The
formulas are in ``kernels/core/losses.h``; ``losses.formulas`` has the same in torch.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.library import Library, ready_library

POINTER, INT64, DOUBLE, INT = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_int
SIGNATURES: dict[str, list[Any]] = {
    "gs2d_photometric": [POINTER] * 4 + [INT64] * 2 + [DOUBLE] * 3 + [POINTER] * 2,
    "gs2d_blur": [POINTER] + [INT64] * 2 + [POINTER],
    "gs2d_masked_mean": [POINTER] * 2 + [INT64] * 2 + [POINTER],
    "gs2d_normal_smoothness": [POINTER] * 4 + [INT64] * 2 + [DOUBLE] + [POINTER] * 2,
    "gs2d_normal_consistency": [POINTER] * 7 + [INT64] * 2 + [INT, INT, DOUBLE] + [POINTER] * 4,
}


@dataclass(frozen=True)
class LossOperations:
    """The fused loss operations of a backend, with the signatures of this module.

    Attributes
    ----------
    photometric, normal_consistency, normal_smoothness, masked_mean : callable
    blur : callable or None
        Computes the local mean of the target for ``photometric``; None: caching it does not save time.
    """

    photometric: Callable[..., tuple[Tensor, Tensor, Tensor]]
    normal_consistency: Callable[..., Tensor]
    normal_smoothness: Callable[..., Tensor]
    masked_mean: Callable[..., Tensor]
    blur: Callable[[Tensor], Tensor] | None = None


@dataclass(frozen=True, eq=False)
class NormalOptions:
    """Inputs and options of normal consistency.

    Attributes
    ----------
    camera : Camera
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    weights : Tensor [H, W] or None
        Constant weight of each pixel.
    at_camera : bool
        Whether empty pixels lie at the camera centre: ``edges`` of ``losses.formulas.normals_from_depth``.
    per_splat : bool
        Use the paper's form, mean(alpha - <n, N>), instead of the official mean(1 - alpha <n, N>) with alpha detached.
    """

    camera: Camera
    mask: Tensor | None = None
    weights: Tensor | None = None
    at_camera: bool = False
    per_splat: bool = False

    def check(self, normal: Tensor, depth: Tensor, alpha: Tensor) -> None:
        """Raise ShapeError if the images do not have the size of the camera."""
        shapes = {"depth": (depth, "H W"), "normal": (normal, "H W 3"), "alpha": (alpha, "H W")}
        shapes |= {} if self.mask is None else {"mask": (self.mask, "H W")}
        sizes = check_shapes(shapes | ({} if self.weights is None else {"weights": (self.weights, "H W")}))
        camera = self.camera
        if (camera.height, camera.width) != (sizes["H"], sizes["W"]):
            raise ShapeError(f"camera is {camera.width}x{camera.height}, but depth is {sizes['W']}x{sizes['H']}")


def _call(library: Library, name: str, *arguments: Any) -> None:
    """Call an exported function with the addresses of tensors; None becomes null."""
    pointers = [x.data_ptr() if isinstance(x, Tensor) else x for x in arguments]
    if library.function(name, INT, SIGNATURES[name])(*pointers) != 0:
        raise MemoryError(f"{name} could not allocate its scratch rows")


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether autograd records these tensors (an autograd.Function cannot tell in its forward pass)."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _mask_bytes(mask: Tensor | None) -> Tensor | None:
    if mask is None:
        return None
    if mask.dtype != torch.bool or mask.device.type != "cpu":
        raise ShapeError(f"mask must be bool on the cpu, got {mask.dtype} on {mask.device}")
    return mask.contiguous()


def blur(image: Tensor, *, library: Library | None = None) -> Tensor:
    """Filter an image [H, W, 3] with the SSIM window (11x11 Gaussian, sigma 1.5, zero outside); not differentiable.

    The result for a target is the ``target_mean`` of ``photometric``.
    """
    library = library or ready_library()
    sizes = check_shapes({"image": (image, "H W 3")})
    (source,) = library.arrays(image=image)
    out = torch.empty_like(source)
    _call(library, "gs2d_blur", source, sizes["H"], sizes["W"], out)
    return out


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,
        target: Tensor,
        mask: Tensor | None,
        mean: Tensor | None,
        expected: tuple[float, float, float],
        wanted: bool,
        library: Library,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.library = library
        ctx.expected = torch.tensor(expected, dtype=torch.float64).to(rendered.dtype)  # rounded like the cotangents
        gradient = torch.empty_like(rendered) if wanted else None
        values = _photometric(rendered, target, mask, mean, library, expected, gradient)
        ctx.save_for_backward(gradient, rendered, target, mask, mean)
        return values[0], values[1], values[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        gradient, rendered, target, mask, mean = ctx.saved_tensors
        cotangents = torch.stack(given)
        if not torch.equal(cotangents, ctx.expected):
            gradient = torch.empty_like(gradient)
            l1, ssim, l2 = cotangents.tolist()
            _photometric(rendered, target, mask, mean, ctx.library, (l1, ssim, l2), gradient)
        return gradient, None, None, None, None, None, None


def _photometric(
    rendered: Tensor,
    target: Tensor,
    mask: Tensor | None,
    mean: Tensor | None,
    library: Library,
    cotangents: tuple[float, float, float],
    gradient: Tensor | None,
) -> Tensor:
    values = torch.empty(3, dtype=torch.float64)
    height, width = rendered.shape[:2]
    _call(library, "gs2d_photometric", rendered, target, mask, mean, height, width, *cotangents, gradient, values)
    return values.to(rendered.dtype)


def photometric(
    rendered: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    target_mean: Tensor | None = None,
    *,
    expected: tuple[float, float, float] = (0.8, -0.2, 0.0),
    library: Library | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean L1, SSIM and L2 of an image, all differentiable in ``rendered``, in one fused pass.

    Parameters
    ----------
    rendered, target : Tensor [H, W, 3]
        In [0, 1].
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    target_mean : Tensor [H, W, 3], optional
        ``blur(target)``, to save time. Changes no bit of the result.
    expected : (float, float, float)
        Expected cotangents of the three values; others cost a second pass.
    library : Library, optional
        Default: :func:`ready_library`.

    Returns
    -------
    l1, ssim, l2 : Tensor []
        Means over valid pixels and channels; 0 if no pixel is valid. L2 is the mean squared difference.

    Raises
    ------
    ShapeError
        If shapes differ, or a tensor has another dtype or device than the library.
    """
    library = library or ready_library()
    shapes = {"target": (target, "H W 3"), "rendered": (rendered, "H W 3")}
    if target_mean is not None:
        shapes["target_mean"] = (target_mean, "H W 3")
    if mask is not None:
        shapes["mask"] = (mask, "H W")
    check_shapes(shapes)
    _, target, target_mean = library.arrays(rendered=rendered, target=target, target_mean=target_mean)
    wanted = needs_gradient(rendered)
    arguments = (target, _mask_bytes(mask), target_mean, expected, wanted, library)
    l1, ssim, l2 = _Photometric.apply(rendered.contiguous(), *arguments)
    return l1, ssim, l2


class _NormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        depth: Tensor,
        alpha: Tensor,
        how: NormalOptions,
        expected: float,
        wanted: bool,
        library: Library,
    ) -> Tensor:
        camera = how.camera
        gradients = [torch.empty_like(x) if wanted else None for x in (normal, depth)]
        gradients.append(torch.empty_like(alpha) if wanted and how.per_splat else None)
        intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
        rotation = torch.tensor(camera.rotation, dtype=torch.float64).contiguous()
        value = torch.empty(1, dtype=torch.float64)
        ctx.expected = expected if expected != 0 else 1.0
        inputs = (normal, depth, alpha, how.mask, how.weights, intrinsics, rotation)
        sizes = (camera.height, camera.width, int(how.per_splat), int(how.at_camera), ctx.expected)
        _call(library, "gs2d_normal_consistency", *inputs, *sizes, *gradients, value)
        ctx.save_for_backward(*gradients)
        return value[0].to(normal.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return (*_as_expected(ctx, cotangent), *[None] * 4)


def _as_expected(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """Return the saved gradients, multiplied if the cotangent is not ``ctx.expected``."""
    gradients: tuple[Tensor | None, ...] = ctx.saved_tensors
    if torch.equal(cotangent, torch.tensor(ctx.expected, dtype=torch.float64).to(cotangent.dtype)):
        return gradients
    return tuple(None if g is None else g * (cotangent / ctx.expected) for g in gradients)


def normal_consistency(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    how: NormalOptions,
    *,
    expected: float = 0.05,
    library: Library | None = None,
) -> Tensor:
    """Return the normal consistency loss [], the native form of the functions in ``losses.formulas``.

    Parameters
    ----------
    normal : Tensor [H, W, 3]
        sum w n, world frame.
    depth : Tensor [H, W] world units
        0 where nothing was hit.
    alpha : Tensor [H, W]
    how : NormalOptions
    expected : float
        Expected cotangent; another one costs a multiplication of the gradients.
    library : Library, optional

    Raises
    ------
    ShapeError
        If shapes differ, or a tensor has another dtype or device than the library.
    """
    library = library or ready_library()
    how.check(normal, depth, alpha)
    *_, weights = library.arrays(normal=normal, depth=depth, alpha=alpha, weights=how.weights)
    images = (normal.contiguous(), depth.contiguous(), alpha.contiguous())
    how = replace(how, mask=_mask_bytes(how.mask), weights=weights)
    value: Tensor = _NormalConsistency.apply(*images, how, expected, needs_gradient(normal, depth, alpha), library)
    return value


class _NormalSmoothness(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        alpha: Tensor,
        flatness: Tensor,
        mask: Tensor | None,
        expected: float,
        wanted: bool,
        library: Library,
    ) -> Tensor:
        gradient = torch.empty_like(normal) if wanted else None
        value = torch.empty(1, dtype=torch.float64)
        ctx.expected = expected if expected != 0 else 1.0
        inputs = (normal, alpha, flatness, mask, *alpha.shape, ctx.expected)
        _call(library, "gs2d_normal_smoothness", *inputs, gradient, value)
        ctx.save_for_backward(gradient)
        return value[0].to(normal.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return (_as_expected(ctx, cotangent)[0], *[None] * 6)


def check_smoothness(normal: Tensor, alpha: Tensor, flatness: Tensor, mask: Tensor | None) -> None:
    """Raise ShapeError if the inputs of ``normal_smoothness`` do not fit together."""
    shapes = {"normal": (normal, "H W 3"), "alpha": (alpha, "H W"), "flatness": (flatness, "H W")}
    check_shapes(shapes | ({} if mask is None else {"mask": (mask, "H W")}))
    if flatness.dtype != torch.uint8 or flatness.device != normal.device:
        raise ShapeError(f"flatness must be uint8 on {normal.device}, got {flatness.dtype} on {flatness.device}")


def normal_smoothness(
    normal: Tensor,
    alpha: Tensor,
    flatness: Tensor,
    mask: Tensor | None = None,
    *,
    expected: float = 1.0,
    library: Library | None = None,
) -> Tensor:
    """Return the native form of ``losses.formulas.normal_smoothness``.

    Parameters
    ----------
    normal : Tensor [H, W, 3]
        sum w n, world frame.
    alpha : Tensor [H, W]
        A constant.
    flatness : Tensor [H, W] uint8
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    expected : float
        Expected cotangent; another one costs a multiplication of the gradient.
    library : Library, optional

    Raises
    ------
    ShapeError
        If shapes differ, or a tensor has another dtype or device than the library.
    """
    library = library or ready_library()
    check_smoothness(normal, alpha, flatness, mask)
    _, alpha = library.arrays(normal=normal, alpha=alpha)
    given = (normal.contiguous(), alpha.detach(), flatness.contiguous(), _mask_bytes(mask))
    value: Tensor = _NormalSmoothness.apply(*given, expected, needs_gradient(normal), library)
    return value


class _MaskedMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, mask: Tensor | None, library: Library) -> Tensor:
        ctx.mask, ctx.like = mask, values
        mean = torch.empty(1, dtype=torch.float64)
        _call(library, "gs2d_masked_mean", values, mask, *values.shape, mean)
        return mean[0].to(values.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.mask is None:
            return (cotangent / max(ctx.like.numel(), 1)).expand_as(ctx.like), None, None
        return ctx.mask.to(cotangent.dtype) * (cotangent / max(int(ctx.mask.sum()), 1)), None, None


def masked_mean(values: Tensor, mask: Tensor | None = None, *, library: Library | None = None) -> Tensor:
    """Return the mean [] of a map [H, W] over the pixels where ``mask`` is True, 0 if there are none.

    The summation order is fixed.
    """
    library = library or ready_library()
    check_shapes({"values": (values, "H W")} | ({"mask": (mask, "H W")} if mask is not None else {}))
    library.arrays(values=values)
    mean: Tensor = _MaskedMean.apply(values.contiguous(), _mask_bytes(mask), library)
    return mean
