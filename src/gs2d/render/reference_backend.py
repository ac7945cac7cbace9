"""The reference backend: plain torch, against which the tests compare the others."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render import reference_errors, reference_rasterizer
from gs2d.render.backends import Backend, register_backend
from gs2d.render.types import Features, RasterSettings, RenderOutput


@register_backend("reference")
class ReferenceBackend(Backend):
    """Plain torch, on any device, in float32 or float64."""

    name = "reference"
    about = "plain torch, slow; float32 and float64, any device"
    lowpass_depths = ("center", "plane")
    slow = True

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view."""
        if gradient_rows is not None:
            splats = Splats(**{name: _only_rows(tensor, gradient_rows) for name, tensor in splats.items()})
            screen_probe = None if screen_probe is None else _only_rows(screen_probe, gradient_rows)
        return reference_rasterizer.rasterize(splats, camera, settings, screen_probe)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        return reference_rasterizer.rasterize(splats, camera, settings, screen_probe, features)

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
        return reference_errors.splat_errors(splats, camera, image, settings, mask, occlusion)


def _only_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """Return the same values; gradients reach only these rows."""
    shape = (-1, *[1] * (tensor.dim() - 1))
    return torch.where(rows.reshape(shape), tensor, tensor.detach()) if tensor.requires_grad else tensor


PLAIN = ReferenceBackend()
