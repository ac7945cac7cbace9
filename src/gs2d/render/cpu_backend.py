"""The cpu backend: the native library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError
from gs2d.kernels import densify_stats, library, native_adam
from gs2d.kernels.native_adam import AdamUpdate
from gs2d.kernels.native_losses import NativeLosses
from gs2d.render import cpu_cached
from gs2d.render.backends import Backend, BackendStatus, register_backend
from gs2d.render.cpu_cached import CachedView
from gs2d.render.native_rasterizer import rasterize_with, splat_errors_with
from gs2d.render.types import Features, RasterSettings, RenderOutput

__all__ = ["CpuBackend"]


@register_backend("cpu")
class CpuBackend(Backend):
    """The native library: SIMD and threads; float32.

    Raises
    ------
    BackendError
        If the library was not built or cannot be loaded.
    """

    name = "cpu"
    caches_views = True

    def __init__(self) -> None:
        library.load()

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view; gradients that are not needed cost nothing."""
        return rasterize_with(library.ready_library(), splats, camera, settings, screen_probe, gradient_rows)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        return rasterize_with(library.ready_library(), splats, camera, settings, screen_probe, features=features)

    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Return the summed colour error of each splat [N]."""
        return splat_errors_with(library.ready_library(), splats, camera, image, settings, mask, occlusion)

    def cache_view(
        self, splats: Splats, camera: Camera, settings: RasterSettings, rows: Tensor, *, limit_bytes: int
    ) -> CachedView | None:
        """Cache a view in which only the colours of ``rows`` change; None if it exceeds ``limit_bytes``."""
        return cpu_cached.cache_view(splats, camera, settings, rows, limit_bytes=limit_bytes)

    def loss_operations(self, device: torch.device) -> NativeLosses:
        """Return the fused operations for the losses."""
        return NativeLosses()

    def adam_step(self, updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """Run one Adam step on several attributes in one call."""
        native_adam.adam_step(updates, beta1=beta1, beta2=beta2, eps=eps)

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add a densification signal in one pass; equal to the reference to rounding."""
        densify_stats.accumulate(signed, absolute, count, signal, radii)

    def first_not_finite(self, tensors: Sequence[Tensor]) -> int | None:
        """Return the index of the first tensor with a NaN or an infinity, in a tenth of the time of six sums."""
        return native_adam.first_not_finite(tensors)

    def facts(self) -> dict[str, Any]:
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
