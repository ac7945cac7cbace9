"""The passes of the native CPU kernels over torch tensors: ctypes around the functions of ``gs2d/kernels/cpu``."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Mapping
from operator import attrgetter
from typing import Any

from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, IMAGES
from gs2d.errors import BackendError
from gs2d.kernels.c_structures import structure
from gs2d.kernels.library import Library
from gs2d.render.types import NEAR_PLANE_POLICIES, Features, RasterSettings

CONSTANTS = ("near", "far", "alpha_min", "alpha_max", "transmittance_min", "error_cutoff", "clamp_px", "mip_px")

_View, _Parameters, Images, ImageGradients, ParameterGradients, Channels = (
    structure(name, "cpu/frame.h")
    for name in ("View", "Parameters", "Images", "ImageGradients", "ParameterGradients", "Features")
)
VIEW_LAYOUT = struct.Struct(f"{ctypes.sizeof(_View) // 8 - 4}d5i4xP")
_constants = attrgetter(*CONSTANTS)


class Frame:
    """State of a forward pass for the backward pass, in native memory; freed with this object."""

    def __init__(self, library: Library) -> None:
        self.library, self.pointer = library, ctypes.c_void_p()

    def __del__(self) -> None:
        self.library.call("gs2d_frame_release", self.pointer)


def view_of(camera: Camera, settings: RasterSettings, exact_masks: bool) -> ctypes.Structure:
    """Return the structure of a view; ``exact_masks`` False disables culling inside tiles (tests)."""
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
    rays = 0 if camera.rays is None else camera.rays.data_ptr()  # the camera keeps it alive
    return _View.from_buffer_copy(
        VIEW_LAYOUT.pack(*doubles, *integers, rays)
    )  # four times as fast as one field at a time


def kind_of(view: ctypes.Structure) -> str:
    """Return the end of the name of a function that takes this view: another one for cameras with rays."""
    return "_rays" if view.rays else ""


def address_of(tensor: Tensor | None) -> int | None:
    """Return the address of a tensor's memory, None for None."""
    return None if tensor is None else tensor.data_ptr()


def parameters_of(splats: Mapping[str, Tensor]) -> ctypes.Structure:
    """Return the structure of the six contiguous tensors of a ``Splats``."""
    count = len(splats["means"])
    if count >= 1 << 31:
        raise BackendError(f"the cpu backend takes fewer than 2^31 splats, got {count}")
    return _Parameters(count, splats["shN"].shape[1], *(address_of(splats[name]) for name in ATTRIBUTES))


def run(library: Library, name: str, *arguments: Any) -> None:
    """Call an exported function that returns whether memory was short."""
    if library.call(name, *arguments) != 0:
        raise BackendError("the CPU kernels ran out of memory; use fewer splats or --downscale")


def forward(
    library: Library, view: ctypes.Structure, splats: Mapping[str, Tensor], depth_width: float | None = None
) -> tuple[dict[str, Tensor], Frame]:
    """Return images and radii, and the state for the backward pass."""
    H, W = int(view.height), int(view.width)
    empty, dtype = library.pool.empty, library.dtype
    images = {name: empty((H, W, 3) if name in ("color", "normal") else (H, W), dtype) for name in IMAGES}
    images["radii"] = empty((len(splats["means"]),), dtype)
    native, frame = Images(*(address_of(t) for t in images.values())), Frame(library)
    run(
        library, "gs2d_raster_forward" + kind_of(view), view, parameters_of(splats), native, ctypes.byref(frame.pointer)
    )
    if depth_width is not None:
        images["depth_transmittance"] = empty((H, W), dtype)
        run(
            library,
            "gs2d_transmittance_depth",
            frame.pointer,
            native,
            depth_width,
            address_of(images["depth_transmittance"]),
        )
    return images, frame


def with_features(frame: Frame, color: Tensor, features: Features) -> Tensor:
    """Return the image [H, W, 3 + F] of a frame's colours and further channels, both contiguous."""
    (H, W, _), count = color.shape, features.values.shape[1]
    wide = frame.library.pool.empty((H, W, 3 + count), color.dtype)
    wide[..., :3] = color
    native = Channels(count, *(address_of(t) for t in (features.values, features.background, wide)))
    run(frame.library, "gs2d_raster_features", frame.pointer, native)
    return wide
