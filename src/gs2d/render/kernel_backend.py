"""What the cpu and the cuda backend share: one differentiable torch function of a forward and a backward pass."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, IMAGES, Splats
from gs2d.errors import ShapeError
from gs2d.render.backends import Backend
from gs2d.render.types import PLAIN_COLORS, Features, RasterSettings, RenderOutput


class ViewOfSplats(NamedTuple):
    """What a pass draws; ``splats`` are the six parameters by name, contiguous and without gradients."""

    camera: Camera
    settings: RasterSettings
    splats: Mapping[str, Tensor]


@dataclass(frozen=True, eq=False)
class Gradients:
    """Inputs and outputs of a backward pass.

    ``saved`` are the outputs and hidden tensors of the forward pass, the parameters, and "values" and "background" of
    further channels; its colours are [H, W, 3]. ``outputs`` is memory for the gradients of the parameters, "probe",
    "intrinsics" [N, 4] and "values"; None: not computed.
    """

    saved: Mapping[str, Tensor]
    upstream: Mapping[str, Tensor | None]  # gradients of the images by name
    outputs: Mapping[str, Tensor | None]
    rows: Tensor | None  # [N] bool, splats with gradients; all others get zeros
    wide: tuple[Tensor, Tensor] | None  # the image with further channels [H, W, 3 + F], and its gradient


class KernelBackend(Backend):
    """A backend of kernels, which run outside of autograd.

    Subclasses implement the three passes and, if they have another dtype or allocator, ``dtype`` and ``empty``.
    """

    dtype: torch.dtype = torch.float32

    def forward_pass(
        self, scene: ViewOfSplats, features: Features | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], Any]:
        """Render one view.

        Returns outputs, hidden tensors for the backward pass, and further state for it, which does not refer to the
        outputs. The outputs are images and radii, in the order of RenderOutput. With ``features`` [N, F], colours are
        [H, W, 3 + F].
        """
        raise NotImplementedError

    def backward_pass(self, state: Any, grads: Gradients) -> None:
        """Compute gradients of a forward pass."""
        raise NotImplementedError

    def errors_pass(self, scene: ViewOfSplats, image: Tensor, mask: Tensor | None, occlusion: bool) -> Tensor:
        """Return the splat errors [N] of one view; the tensors are contiguous."""
        raise NotImplementedError

    def empty(self, shape: tuple[int, ...], device: torch.device) -> Tensor:
        """Allocate a tensor for a gradient."""
        return torch.empty(shape, dtype=self.dtype, device=device)

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view; gradients that are not needed cost nothing."""
        if gradient_rows is not None:
            gradient_rows = gradient_rows.clone().contiguous()  # it may change before the backward pass
        return self._render(_View(self, camera, settings, gradient_rows), splats, screen_probe, None)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        background = features.background.detach().contiguous()
        return self._render(_View(self, camera, settings, None, background), splats, screen_probe, features.values)

    def _render(self, view: _View, splats: Splats, probe: Tensor | None, values: Tensor | None) -> RenderOutput:
        self.check(splats, view.settings)
        names = [*IMAGES, "radii", *["depth_transmittance"] * view.settings.with_transmittance_depth]
        outputs = _Rasterize.apply(view, probe, view.camera.intrinsics, values, *(t for _, t in splats.items()))
        return RenderOutput(**dict(zip(names, outputs, strict=True)))

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
        self.check(splats, settings)
        scene = ViewOfSplats(camera, settings, plain(splats.items()))
        return self.errors_pass(
            scene, image.detach().contiguous(), None if mask is None else mask.contiguous(), occlusion
        )

    def check(self, splats: Splats, settings: RasterSettings) -> None:
        """Raise ShapeError for tensors that would make a kernel read beyond its arrays."""
        device = torch.device("cpu") if self.on_host else splats.device
        for name, tensor in splats.items():
            if tensor.dtype != self.dtype or tensor.device != device:
                raise ShapeError(
                    f"{name} must be {self.dtype} on {device} for the {self.name} backend, got {tensor.dtype} "
                    f"on {tensor.device}; convert with splats.to(...) or use --backend reference"
                )
        if not PLAIN_COLORS <= settings.sh_degree <= 3 or (settings.sh_degree + 1) ** 2 > 1 + splats.shN.shape[1]:
            raise ShapeError(
                f"sh_degree must be -1 to 3 and within the stored coefficients ({1 + splats.shN.shape[1]}), "
                f"got {settings.sh_degree}"
            )


def plain(named: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    """Return the tensors contiguous and without gradients."""
    return {name: tensor.detach().contiguous() for name, tensor in named}


class _View(NamedTuple):
    """Arguments of :class:`_Rasterize` without gradients."""

    backend: KernelBackend
    camera: Camera
    settings: RasterSettings
    rows: Tensor | None  # splats with gradients; None: all
    background: Tensor | None = None  # behind further channels


class _Rasterize(torch.autograd.Function):
    """Compute images and radii from the six parameter tensors.

    With further channels ``values`` [N, F], colours are [H, W, 3 + F].
    """

    @staticmethod
    def forward(
        ctx: Any,
        view: _View,
        probe: Tensor | None,
        intrinsics: Tensor | None,
        values: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        splats = plain(zip(ATTRIBUTES, parameters, strict=True))
        features = None
        if values is not None and view.background is not None:
            features = Features(values.detach().contiguous(), view.background)
        outputs, hidden, state = view.backend.forward_pass(ViewOfSplats(view.camera, view.settings, splats), features)
        if any(ctx.needs_input_grad):
            ctx.view, ctx.state = view, state
            ctx.probe_shape = None if probe is None else tuple(probe.shape)
            ctx.of_intrinsics = None if intrinsics is None else intrinsics.detach()  # for dtype and device
            # save_for_backward notices if a caller changes a returned image in place.
            saved = outputs | hidden | splats | ({} if features is None else vars(features))
            ctx.names = tuple(saved)
            ctx.save_for_backward(*saved.values())
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(outputs["radii"])
        return tuple(outputs.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        backend: KernelBackend = ctx.view.backend
        saved = dict(zip(ctx.names, ctx.saved_tensors, strict=True))
        upstream = {
            name: None if tensor is None else tensor.detach().to(backend.dtype).contiguous()
            for name, tensor in zip(ctx.names, cotangents, strict=False)
        }
        needs_probe, needs_intrinsics, needs_values, *needed = ctx.needs_input_grad[1:]
        values, wide = saved.get("values"), None
        if values is not None:
            if upstream["color"] is not None:
                wide = saved["color"], upstream["color"]
                upstream["color"] = upstream["color"][..., :3].contiguous()
            saved["color"] = saved["color"][..., :3].contiguous()
        count, device = len(saved["means"]), saved["means"].device
        shapes: dict[str, Any] = {
            name: saved[name].shape if w else None for name, w in zip(ATTRIBUTES, needed, strict=True)
        }
        shapes["probe"] = ctx.probe_shape if needs_probe else None
        shapes["intrinsics"] = (count, 4) if needs_intrinsics else None
        shapes["values"] = None if values is None or wide is None else values.shape
        outputs = {name: None if shape is None else backend.empty(shape, device) for name, shape in shapes.items()}
        backend.backward_pass(ctx.state, Gradients(saved, upstream, outputs, ctx.view.rows, wide))
        if needs_values and values is not None and wide is None:
            outputs["values"] = torch.zeros_like(values)
        each, total = outputs["intrinsics"], None
        if each is not None and each.is_cpu:  # numpy adds row by row, whatever the number of threads
            total = torch.from_numpy(each.numpy().sum(axis=0, dtype=np.float64)).to(ctx.of_intrinsics)
        elif each is not None:
            total = each.sum(dim=0, dtype=torch.float64).to(ctx.of_intrinsics)
        return None, outputs["probe"], total, outputs["values"], *(outputs[name] for name in ATTRIBUTES)
