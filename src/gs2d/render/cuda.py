"""The cuda backend: the passes of the CUDA kernels as one differentiable torch function of a launcher.

A launcher runs a kernel by name: on a GPU it hands the structure to the driver on torch's current stream; the tests'
one runs the same sources on the CPU. Everything else (memory, sorts, order) is the same for both.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.camera import Camera
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.arguments import View
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render.cuda_passes import IMAGES, PARAMETERS, Frame, backward, errors, forward
from gs2d.render.cuda_passes import view_of as _view
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.splats import Splats

__all__ = ["rasterize", "rasterize_with", "splat_errors", "splat_errors_with"]


def _check_tensors(splats: Splats, settings: RasterSettings) -> None:
    """What would make a kernel read beyond its arrays."""
    for name, tensor in splats.items():
        if tensor.dtype != torch.float32 or tensor.device != splats.device:
            raise ShapeError(
                f"{name} must be float32 on {splats.device} for the cuda backend, got {tensor.dtype} on {tensor.device}"
            )
    if not 0 <= settings.sh_degree <= 3 or (settings.sh_degree + 1) ** 2 > 1 + splats.shN.shape[1]:
        raise ShapeError(
            f"sh_degree must be 0 to 3 and within the stored coefficients ({1 + splats.shN.shape[1]}), "
            f"got {settings.sh_degree}"
        )


class _Rasterize(torch.autograd.Function):
    """Images and radii from the six parameter tensors."""

    @staticmethod
    def forward(
        ctx: Any, launcher: Launcher, view: View, exact: bool, probe: Tensor | None, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        tensors = [p.detach().contiguous() for p in parameters]
        frame = forward(launcher, view, tensors, exact=exact)
        if any(ctx.needs_input_grad):
            # The images returned to the user may be changed in place: save_for_backward would notice, a plain
            # attribute would not. The rest is nobody else's.
            ctx.launcher, ctx.view = launcher, view
            ctx.probe_shape = None if probe is None else tuple(probe.shape)
            hidden = (frame.records, frame.tile_counts, frame.entries, frame.ranges, frame.tiles, frame.seen)
            ctx.save_for_backward(*hidden, frame.radii, *frame.images.values(), *tensors)
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(frame.radii)
        return (*(frame.images[name] for name in IMAGES), frame.radii)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        tensors = saved[-len(PARAMETERS) :]
        images = dict(zip((*IMAGES, "final_T", "moments"), saved[7 : -len(PARAMETERS)], strict=True))
        records, tile_counts, entries, ranges, tiles, seen, radii = saved[:7]
        frame = Frame(ctx.view, records, tile_counts, entries, ranges, tiles, seen, images, radii)
        given = [None if g is None else g.detach().to(torch.float32).contiguous() for g in upstream[: len(IMAGES)]]
        want_probe, *want = ctx.needs_input_grad[3:]
        wanted = {
            name: torch.empty_like(t) if w else None for name, t, w in zip(PARAMETERS, tensors, want, strict=True)
        }
        device = tensors[0].device
        probe = torch.empty(ctx.probe_shape, dtype=torch.float32, device=device) if want_probe else None
        backward(ctx.launcher, frame, tensors, dict(zip(IMAGES, given, strict=True)), {**wanted, "probe": probe})
        return None, None, None, probe, *wanted.values()


def rasterize_with(
    launcher: Launcher,
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    screen_probe: Tensor | None = None,
    *,
    exact_masks: bool = True,
) -> RenderOutput:
    """Render one view with the CUDA kernels; the contract is in :mod:`gs2d.render.api`.

    Images are deterministic. Gradients are sums by atomic additions: their last digits vary from run to run on a GPU.

    Parameters
    ----------
    launcher : Launcher
        Runs the kernels; it decides on which device the tensors must be.
    splats : Splats
        float32.
    camera : Camera
    settings : RasterSettings
    screen_probe : Tensor [N, 2] or [N, 4], optional
        Zeros; its gradient is the densification signal.
    exact_masks : bool
        False turns off culling inside tiles; the image must not change by a bit (tests).

    Raises
    ------
    ShapeError
        If a tensor is not float32, or sh_degree needs more coefficients than there are.
    BackendError
        If there are too many splats or pairs, or a setting is one of the reference backend only.
    """
    _check_tensors(splats, settings)
    parameters = [t for _, t in splats.items()]
    *images, radii = _Rasterize.apply(launcher, _view(camera, settings), exact_masks, screen_probe, *parameters)
    return RenderOutput(**dict(zip(IMAGES, images, strict=True)), radii=radii)


def rasterize(
    splats: Splats, camera: Camera, settings: RasterSettings, screen_probe: Tensor | None = None
) -> RenderOutput:
    """:func:`rasterize_with` on the device on which the splats lie, on torch's current stream there."""
    return rasterize_with(launch.launcher_for(splats.device), splats, camera, settings, screen_probe)


def splat_errors_with(
    launcher: Launcher,
    splats: Splats,
    camera: Camera,
    image: Tensor,
    settings: RasterSettings,
    mask: Tensor | None = None,
) -> Tensor:
    """Inner sum of the paper's E_i for one view [N]; rule 17 of the contract, without ``occlusion``. Deterministic.

    Parameters
    ----------
    launcher, splats, camera, settings
        As for :func:`rasterize_with`.
    image : Tensor [H, W, 3] float32
    mask : Tensor [H, W] bool, optional
        False = ignore.

    Raises
    ------
    ShapeError, BackendError
        As for :func:`rasterize_with`; also for an image or a mask of another shape or dtype.
    """
    _check_tensors(splats, settings)
    size = (camera.height, camera.width)
    if tuple(image.shape) != (*size, 3) or image.dtype != torch.float32 or image.device != splats.device:
        raise ShapeError(
            f"image must be {[*size, 3]} float32 on {splats.device}, got {list(image.shape)} {image.dtype} "
            f"on {image.device}"
        )
    if mask is not None and (tuple(mask.shape) != size or mask.dtype != torch.bool or mask.device != splats.device):
        raise ShapeError(
            f"mask must be {list(size)} bool on {splats.device}, got {list(mask.shape)} {mask.dtype} on {mask.device}"
        )
    parameters = [t.detach().contiguous() for _, t in splats.items()]
    image, mask = image.detach().contiguous(), None if mask is None else mask.contiguous()
    return errors(launcher, _view(camera, settings), parameters, image, mask)


def splat_errors(
    splats: Splats,
    camera: Camera,
    image: Tensor,
    settings: RasterSettings,
    mask: Tensor | None = None,
    occlusion: bool = False,
) -> Tensor:
    """:func:`splat_errors_with` on the device on which the splats lie.

    Raises
    ------
    BackendError
        Also for ``occlusion``, which has no CUDA kernel.
    """
    if occlusion:
        raise BackendError("the cuda backend has no splat errors with occlusion; use --backend cpu for this recipe")
    return splat_errors_with(launch.launcher_for(splats.device), splats, camera, image, settings, mask)
