"""The native CPU rasterizer: ctypes around the kernels in ``gs2d/kernels/cpu``, as one differentiable torch function.

:mod:`gs2d.render.api` checks the arguments. The checks here are those whose violation would crash native code.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.splats import IMAGES, Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.c_structures import structure
from gs2d.kernels.library import Library
from gs2d.render.types import NEAR_PLANE_POLICIES, PLAIN_COLORS, Features, RasterSettings, RenderOutput

__all__ = [
    "ParameterGradients",
    "address_of",
    "check_tensors",
    "parameters_of",
    "rasterize_with",
    "render_forward",
    "splat_errors_with",
    "view_of",
]

CONSTANTS = ("near", "far", "alpha_min", "alpha_max", "transmittance_min", "error_cutoff", "clamp_px", "mip_px")


_View, _Parameters, _Images, _ImageGradients, ParameterGradients, _Features = (
    structure(name, "cpu/frame.h")
    for name in ("View", "Parameters", "Images", "ImageGradients", "ParameterGradients", "Features")
)
VIEW_LAYOUT = struct.Struct(f"{ctypes.sizeof(_View) // 8 - 3}d5i4x")
_constants = attrgetter(*CONSTANTS)


class _Frame:
    """State of a forward pass for the backward pass, in native memory; freed with this object."""

    def __init__(self, library: Library, pointer: ctypes.c_void_p) -> None:
        self.pointer = pointer
        self._release = library.function("gs2d_frame_release", None, [ctypes.c_void_p])

    def __del__(self) -> None:
        self._release(self.pointer)


def view_of(camera: Camera, settings: RasterSettings, exact_masks: bool) -> ctypes.Structure:
    """Return the structure of a view; BackendError for what only the reference backend supports."""
    if settings.lowpass_depth != "center":
        raise BackendError(
            f"the cpu backend needs lowpass_depth 'center', got {settings.lowpass_depth!r}; use --backend reference"
        )
    if max(camera.width, camera.height) > 1 << 19:
        raise BackendError(f"the cpu backend renders up to 524288 px a side, got {camera.width}x{camera.height}")
    a, b, c, _ = camera.T_cam_world.tolist()
    center = (-(a[i] * a[3] + b[i] * b[3] + c[i] * c[3]) for i in range(3))  # camera.center without numpy saves 40 us
    doubles = (*a[:3], *b[:3], *c[:3], a[3], b[3], c[3], *center)
    doubles += (camera.fx, camera.fy, camera.cx, camera.cy, *_constants(settings), *settings.background)
    integers = (
        camera.width,
        camera.height,
        settings.sh_degree,
        exact_masks,
        NEAR_PLANE_POLICIES.index(settings.near_plane_policy),
    )
    return _View.from_buffer_copy(VIEW_LAYOUT.pack(*doubles, *integers))  # four times as fast as one field at a time


def address_of(tensor: Tensor | None) -> int | None:
    """Return the address of a tensor's memory, None for None."""
    return None if tensor is None else tensor.data_ptr()


def _plain(tensor: Tensor | None, dtype: torch.dtype) -> Tensor | None:
    """Return the tensor, contiguous and with this dtype, for native code."""
    if tensor is None or (tensor.dtype == dtype and tensor.is_contiguous()):
        return tensor
    return tensor.detach().to(dtype).contiguous()


def parameters_of(tensors: Sequence[Tensor]) -> ctypes.Structure:
    """Return the structure of the six tensors of a ``Splats``."""
    means, *_, shN = tensors
    return _Parameters(means.shape[0], shN.shape[1], *(address_of(t) for t in tensors))


def _check(code: int) -> None:
    if code != 0:
        raise BackendError("the CPU kernels ran out of memory; use fewer splats or --downscale")


def check_tensors(splats: Splats, settings: RasterSettings, dtype: torch.dtype) -> None:
    """Raise for splats or a degree that would make a kernel read beyond its arrays."""
    for name, tensor in splats.items():
        if not tensor.is_cpu or tensor.dtype != dtype:
            raise ShapeError(
                f"{name} must be {dtype} on the CPU for the cpu backend, got {tensor.dtype} on {tensor.device}; "
                "convert with splats.to(...) or use --backend reference"
            )
    if not PLAIN_COLORS <= settings.sh_degree <= 3 or (settings.sh_degree + 1) ** 2 > 1 + splats.shN.shape[1]:
        raise ShapeError(
            f"sh_degree must be -1 to 3 and within the stored coefficients ({1 + splats.shN.shape[1]}), "
            f"got {settings.sh_degree}"
        )
    if len(splats) >= 1 << 31:
        raise BackendError(f"the cpu backend takes fewer than 2^31 splats, got {len(splats)}")


def render_forward(
    library: Library, view: ctypes.Structure, tensors: Sequence[Tensor], depth_width: float | None = None
) -> tuple[dict[str, Tensor], Tensor, _Frame]:
    """Return images, radii and the state for the backward pass; the tensors are contiguous."""
    H, W = int(view.height), int(view.width)
    empty, dtype = library.pool.empty, library.dtype
    images = {name: empty((H, W, 3) if name in ("color", "normal") else (H, W), dtype) for name in IMAGES}
    radii = empty((len(tensors[0]),), dtype)
    forward = library.function("gs2d_raster_forward", ctypes.c_int, [ctypes.c_void_p] * 4)
    pointer = ctypes.c_void_p()
    native_images = _Images(*(address_of(t) for t in images.values()), address_of(radii))
    native_splats = parameters_of(tensors)
    _check(forward(*(ctypes.byref(x) for x in (view, native_splats, native_images, pointer))))
    frame = _Frame(library, pointer)
    if depth_width is not None:
        images["depth_transmittance"] = empty((H, W), dtype)
        find = library.function(
            "gs2d_transmittance_depth", ctypes.c_int, [ctypes.c_void_p] * 2 + [ctypes.c_double, ctypes.c_void_p]
        )
        found = address_of(images["depth_transmittance"])
        _check(find(pointer, ctypes.byref(native_images), depth_width, found))
    return images, radii, frame


def _with_features(library: Library, frame: _Frame, color: Tensor, values: Tensor, background: Tensor) -> Tensor:
    """Return the image [H, W, 3 + F] of a frame's colours and further channels [N, F], both contiguous."""
    H, W, _ = color.shape
    wide = library.pool.empty((H, W, 3 + values.shape[1]), library.dtype)
    wide[..., :3] = color
    blend = library.function("gs2d_raster_features", ctypes.c_int, [ctypes.c_void_p] * 2)
    native = _Features(values.shape[1], *(address_of(t) for t in (values, background, wide)))
    _check(blend(frame.pointer, ctypes.byref(native)))
    return wide


class _NativeOptions(NamedTuple):
    """Arguments of _NativeRasterize without gradients."""

    library: Library
    view: ctypes.Structure
    depth_width: float | None  # None: no depth by transmittance
    rows: Tensor | None  # splats with gradients; None: all
    background: Tensor | None  # behind further channels


class _NativeRasterize(torch.autograd.Function):
    """Compute radii and images from the six parameter tensors.

    With further channels ``values`` [N, F], colours are [H, W, 3 + F].
    """

    @staticmethod
    def forward(
        ctx: Any,
        options: _NativeOptions,
        probe: Tensor | None,
        intrinsics: Tensor | None,
        values: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        tensors = [p.detach().contiguous() for p in parameters]
        library, view, depth_width, rows, background = options
        images, radii, frame = render_forward(library, view, tensors, depth_width)
        wide = None
        if values is not None and background is not None:
            values, background = values.detach().contiguous(), background.detach().contiguous()
            wide = _with_features(library, frame, images["color"], values, background)
        if any(ctx.needs_input_grad):
            ctx.library, ctx.frame, ctx.rows = library, frame, rows
            ctx.probe_shape = None if probe is None else tuple(probe.shape)
            ctx.of_intrinsics = None if intrinsics is None else intrinsics.detach()  # for dtype and device
            saved = [images[name] for name in ("color", "alpha", "normal", "depth_mean", "distortion")]
            ctx.save_for_backward(wide, values, background, *saved, *tensors)
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return (radii, *(images if wide is None else images | {"color": wide}).values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        library: Library = ctx.library
        wide, values, background, color, alpha, normal, depth_mean, distortion, *tensors = ctx.saved_tensors
        images = _Images(*(address_of(t) for t in (color, alpha, normal, depth_mean, None, distortion, None)))
        given = [_plain(g, library.dtype) for g in upstream[1:]]
        of_wide = None if values is None else given[0]
        if of_wide is not None:
            given[0] = of_wide[..., :3].contiguous()
        want_probe, want_intrinsics, want_values, *want = ctx.needs_input_grad[1:]
        empty, dtype = library.pool.empty, library.dtype
        grads = [empty(t.shape, dtype) if wanted else None for t, wanted in zip(tensors, want, strict=True)]
        probe = empty(ctx.probe_shape, dtype) if want_probe else None
        columns = 0 if probe is None else int(probe.shape[1])
        out = ParameterGradients(*(address_of(g) for g in grads), address_of(probe), columns, address_of(ctx.rows))
        to_intrinsics = empty((len(tensors[0]), 4), dtype) if want_intrinsics else None
        native_splats, native_given = parameters_of(tensors), _ImageGradients(*(address_of(g) for g in given))
        arguments = (native_splats, images, native_given, out)
        pointers = [ctx.frame.pointer, *(ctypes.byref(a) for a in arguments), address_of(to_intrinsics)]
        name, to_values = "gs2d_raster_backward_intrinsics", torch.zeros_like(values) if want_values else None
        if of_wide is not None:
            name, to_values = "gs2d_raster_backward_features", empty(values.shape, dtype)
            addresses = (address_of(t) for t in (values, background, wide, of_wide, to_values))
            pointers.append(ctypes.byref(_Features(values.shape[1], *addresses)))
        backward = library.function(name, ctypes.c_int, [ctypes.c_void_p] * len(pointers))
        _check(backward(*pointers))
        total = None
        if to_intrinsics is not None:  # numpy adds row by row, whatever the number of threads
            total = torch.from_numpy(to_intrinsics.numpy().sum(axis=0, dtype=np.float64)).to(ctx.of_intrinsics)
        return None, probe, total, to_values, *grads


def rasterize_with(
    library: Library,
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    screen_probe: Tensor | None = None,
    gradient_rows: Tensor | None = None,
    *,
    features: Features | None = None,
    exact_masks: bool = True,
) -> RenderOutput:
    """Render one view with a variant of the native library; the contract is in :mod:`gs2d.render.api`.

    Bit-identical for any number of threads on one machine, instruction set and version.

    Parameters
    ----------
    library : Library
    splats : Splats
        On the CPU, with the library's dtype.
    camera : Camera
    settings : RasterSettings
    screen_probe : Tensor [N, 2] or [N, 4], optional
        Zeros; its gradient is the densification signal.
    gradient_rows : Tensor [N] bool, optional
        Splats with gradients. The work for others is skipped; the bits of the gradients are the same.
    features : Features, optional
        Further channels; not with ``gradient_rows`` or depth by transmittance.
    exact_masks : bool
        False disables culling inside tiles, and of splats without an ellipse; no bit of the image changes (tests).

    Raises
    ------
    ShapeError
        If a tensor has another dtype or device.
    BackendError
        If memory runs out, or only the reference backend supports a setting.
    """
    check_tensors(splats, settings, library.dtype)
    if gradient_rows is not None:
        gradient_rows = gradient_rows.to("cpu", copy=True).contiguous()  # it may change before the backward pass
    depth_width = settings.depth_width(camera) if settings.with_transmittance_depth else None
    view = view_of(camera, settings, exact_masks)
    background, values = (None, None) if features is None else (features.background, features.values)
    options = _NativeOptions(library, view, depth_width, gradient_rows, background)
    learning = (screen_probe, camera.intrinsics, values)
    radii, *images = _NativeRasterize.apply(options, *learning, *(t for _, t in splats.items()))
    names = (*IMAGES, "depth_transmittance")[: len(images)]
    return RenderOutput(**dict(zip(names, images, strict=True)), radii=radii)


def splat_errors_with(
    library: Library,
    splats: Splats,
    camera: Camera,
    image: Tensor,
    settings: RasterSettings,
    mask: Tensor | None = None,
    occlusion: bool = False,
    *,
    exact_masks: bool = True,
) -> Tensor:
    """Return the inner sum of the paper's E_i for one view [N]; rule 17 of the contract in :mod:`gs2d.render.api`.

    ``library`` and ``exact_masks`` are as for :func:`rasterize_with`.
    """
    check_tensors(splats, settings, library.dtype)
    tensors = [t.detach().contiguous() for _, t in splats.items()]
    image = image.detach().contiguous()
    mask = None if mask is None else mask.contiguous()
    errors = torch.empty(len(splats), dtype=library.dtype)
    native = library.function(
        "gs2d_splat_errors", ctypes.c_int, [ctypes.c_void_p] * 4 + [ctypes.c_int, ctypes.c_void_p]
    )
    view, parameters = view_of(camera, settings, exact_masks), parameters_of(tensors)
    given = (ctypes.byref(view), ctypes.byref(parameters), address_of(image), address_of(mask))
    _check(native(*given, int(occlusion), address_of(errors)))
    return errors
