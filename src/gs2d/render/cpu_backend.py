"""The cpu backend: the native library."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.splats import ATTRIBUTES, IMAGES, Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels import library
from gs2d.kernels.adam_update import AdamUpdate, bias_corrections, check_update
from gs2d.kernels.c_structures import fill, structure
from gs2d.kernels.library import Library
from gs2d.kernels.native_losses import NativeLosses
from gs2d.render import cpu_cached
from gs2d.render.backends import BackendStatus, register_backend
from gs2d.render.cpu_cached import CachedView
from gs2d.render.cpu_passes import (
    Channels,
    Frame,
    ImageGradients,
    Images,
    ParameterGradients,
    address_of,
    forward,
    kind_of,
    parameters_of,
    run,
    view_of,
    with_features,
)
from gs2d.render.kernel_backend import Gradients, KernelBackend, ViewOfSplats, plain
from gs2d.render.types import Features, RasterSettings


@register_backend("cpu")
class CpuBackend(KernelBackend):
    """The native library: SIMD and threads. Bit-identical for any number of threads on one machine and version.

    For tests: ``chosen`` renders with this variant and its dtype and number of threads, and ``exact_masks=False``
    disables culling inside tiles, and of splats without an ellipse, which changes no bit of the image. Raises
    BackendError if the library was not built or cannot be loaded.
    """

    name = "cpu"
    caches_views = takes_rays = True

    def __init__(self, chosen: Library | None = None, *, exact_masks: bool = True) -> None:
        self.dtype = (chosen or library.load()).dtype
        self._chosen, self._exact_masks = chosen, exact_masks

    def _library(self) -> Library:
        return self._chosen or library.ready_library()

    def empty(self, shape: tuple[int, ...], device: torch.device) -> Tensor:
        """Allocate a tensor for a gradient in the library's pool."""
        return (self._chosen or library.load()).pool.empty(shape, self.dtype)

    def forward_pass(
        self, scene: ViewOfSplats, features: Features | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], Frame]:
        """Render one view."""
        camera, settings, splats = scene
        depth_width = settings.depth_width(camera) if settings.with_transmittance_depth else None
        view = view_of(camera, settings, self._exact_masks)
        images, frame = forward(self._library(), view, splats, depth_width)
        if features is not None:
            images["color"] = with_features(frame, images["color"], features)
        return images, {}, frame

    def backward_pass(self, state: Frame, grads: Gradients) -> None:
        """Compute gradients of the last forward pass; the work for other rows is skipped."""
        saved, outputs, probe = grads.saved, grads.outputs, grads.outputs["probe"]
        images = Images(*(address_of(saved[name]) for name in (*IMAGES, "radii")))
        upstream = ImageGradients(*(address_of(grads.upstream.get(name)) for name in (*IMAGES, "depth_transmittance")))
        addresses = (address_of(outputs[name]) for name in (*ATTRIBUTES, "probe"))
        out = ParameterGradients(*addresses, 0 if probe is None else probe.shape[1], address_of(grads.rows))
        arguments = (state.pointer, parameters_of(saved), images, upstream, out, outputs["intrinsics"])
        if grads.wide is None:
            run(state.library, "gs2d_raster_backward_intrinsics", *arguments)
            return
        tensors = (saved["values"], saved["background"], *grads.wide, outputs["values"])
        channels = Channels(saved["values"].shape[1], *map(address_of, tensors))
        run(state.library, "gs2d_raster_backward_features", *arguments, channels)

    def errors_pass(self, scene: ViewOfSplats, image: Tensor, mask: Tensor | None, occlusion: bool) -> Tensor:
        """Return the splat errors [N] of one view."""
        errors = torch.empty(len(scene.splats["means"]), dtype=self.dtype)
        view = view_of(scene.camera, scene.settings, self._exact_masks)
        name = "gs2d_splat_errors" + kind_of(view)
        run(self._library(), name, view, parameters_of(scene.splats), image, mask, occlusion, errors)
        return errors

    def cache_view(
        self, splats: Splats, camera: Camera, settings: RasterSettings, rows: Tensor, *, limit_bytes: int
    ) -> CachedView | None:
        """Cache a view in which only the colours of ``rows`` change; None if it exceeds ``limit_bytes``."""
        self.check(splats, settings)
        tensors = plain(splats.items())
        return cpu_cached.cache_view(self._library(), camera, settings, tensors, rows, limit_bytes)

    def loss_operations(self, device: torch.device) -> NativeLosses:
        """Return the fused operations for the losses."""
        return NativeLosses()

    @torch.no_grad()
    def adam_step(self, updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """Run one Adam step on several attributes in one call; equal to torch's fused Adam to rounding.

        Raises ShapeError if a tensor has another shape, dtype or device, or a row index is out of range.
        """
        native = self._library()
        attributes = (structure("AdamAttribute", "cpu") * len(updates))()
        alive = []  # tensors behind the pointers
        for slot, update in zip(attributes, updates, strict=True):
            check_update(update)
            named = {name: getattr(update, name) for name in ("parameter", "mean", "square", "gradient")}
            tensors = native.arrays(**named)
            fill(slot, **dict(zip(named, tensors, strict=True)))
            rows = update.rows if update.trained is None else update.trained.nonzero().squeeze(1)
            if rows is not None:
                if not rows.is_cpu:
                    raise ShapeError(f"rows must be on the cpu, got {rows.device}")
                rows = rows.contiguous()
                slot.rows = rows.data_ptr()
            slot.height, slot.columns = len(update.parameter), max(1, math.prod(update.parameter.shape[1:]))
            slot.count = 0 if update.parameter.numel() == 0 else slot.height if rows is None else len(rows)
            slot.compact = update.compact
            slot.step_size, slot.root_2 = bias_corrections(update.rate, update.step, beta1, beta2)
            alive += [*tensors, rows]
        if native.call("gs2d_adam", attributes, len(updates), beta1, beta2, eps) != 0:
            raise ShapeError("rows must be row indices of the parameter, got an index out of range")
        del alive

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add a densification signal in one pass; equal to the reference to rounding.

        Raises ShapeError if shapes differ, a sum is not contiguous, or a tensor has another dtype or device than the
        library.
        """
        columns = 4 if signal.dim() == 2 and signal.shape[1] == 4 else 2
        sums = {"signed": signed, "absolute": absolute, "count": count}
        shapes = {"signal": (signal, f"N {columns}"), "radii": (radii, "N")}
        check_shapes(shapes | {name: (tensor, "N") for name, tensor in sums.items()})
        for name, tensor in sums.items():
            if not tensor.is_contiguous():
                raise ShapeError(f"{name} must be contiguous to be changed in place")
        native = self._library()
        signal, radii, *changed = native.arrays(signal=signal, radii=radii, **sums)
        native.call("gs2d_accumulate_signal", signal, columns, radii, len(radii), *changed)

    def first_not_finite(self, tensors: Sequence[Tensor]) -> int | None:
        """Return the index of the first tensor with a NaN or an infinity, in a tenth of the time of six sums."""
        native = self._library()
        plain = native.arrays(**{f"tensor {number}": tensor for number, tensor in enumerate(tensors)})
        count = len(plain)
        pointers = (ctypes.c_void_p * count)(*(tensor.data_ptr() for tensor in plain))
        sizes = (ctypes.c_int64 * count)(*(tensor.numel() for tensor in plain))
        first = int(native.call("gs2d_first_not_finite", pointers, sizes, count))
        return None if first == count else first

    def identity(self) -> dict[str, Any]:
        """Return name, instruction set and version."""
        return {
            "name": self.name,
            "instruction_set": library.load().instruction_set,
            "kernels": library.RESULTS_VERSION,
        }

    @classmethod
    def status(cls) -> BackendStatus:
        """Return the line for ``gs2d doctor``."""
        try:
            native = library.ready_library()
        except BackendError as error:
            return BackendStatus(cls.name, False, str(error).partition(";")[0], library.REMEDY, "")
        details = (
            f"{native.instruction_set}; {native.threads} threads; built: {', '.join(library.available_variants())}"
        )
        return BackendStatus(cls.name, True, "", "", details)
