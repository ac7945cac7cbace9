"""The passes of the CUDA kernels as one differentiable torch function of a launcher.

A launcher runs a kernel by name. On a GPU it passes the argument structure to the driver, on torch's current stream;
the launcher of the tests runs the same sources on the CPU. Memory, sorts and the order of passes are the same for both.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, IMAGES, Splats
from gs2d.errors import ShapeError
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render.cuda_passes import (
    CHANNELS,
    DEPTH,
    ForwardState,
    RequestedGradients,
    backward,
    blend_features,
    errors,
    forward,
)
from gs2d.render.cuda_passes import view_of as _view
from gs2d.render.pair_budget import PairBudget
from gs2d.render.types import PLAIN_COLORS, Features, RasterSettings, RenderOutput

__all__ = ["CudaChoices", "rasterize_with", "splat_errors_with"]


def _check_tensors(splats: Splats, settings: RasterSettings) -> None:
    """Raise ShapeError for tensors that would make a kernel read beyond its arrays."""
    for name, tensor in splats.items():
        if tensor.dtype != torch.float32 or tensor.device != splats.device:
            raise ShapeError(
                f"{name} must be float32 on {splats.device} for the cuda backend, got {tensor.dtype} on {tensor.device}"
            )
    if not PLAIN_COLORS <= settings.sh_degree <= 3 or (settings.sh_degree + 1) ** 2 > 1 + splats.shN.shape[1]:
        raise ShapeError(
            f"sh_degree must be -1 to 3 and within the stored coefficients ({1 + splats.shN.shape[1]}), "
            f"got {settings.sh_degree}"
        )


@dataclass(frozen=True, eq=False)
class CudaChoices:
    """Options of the CUDA kernels.

    Attributes
    ----------
    exact_masks : bool
        False disables culling inside tiles; no bit of the image may change (tests).
    deterministic : bool or None
        The same gradients bit for bit from run to run. Costs one more pass and 320 bytes for each pair of splat and
        tile, and 16 more bytes for each further channel. None: as torch.use_deterministic_algorithms says.
    budget : PairBudget or None
        Replaces waiting for the number of pairs of splat and tile. The caller checks whether it sufficed.
    """

    exact_masks: bool = True
    deterministic: bool | None = None
    budget: PairBudget | None = None


@dataclass(frozen=True, eq=False)
class _CudaOptions:
    """Arguments of _CudaRasterize without gradients."""

    launcher: Launcher
    view: ctypes.Structure
    distortion: bool
    transmittance: bool
    choices: CudaChoices
    learns: Tensor | None
    background: Tensor | None  # behind further channels


def _image_names(transmittance: bool) -> tuple[str, ...]:
    return (*IMAGES, "depth_transmittance") if transmittance else IMAGES


SAVED = tuple(field.name for field in fields(ForwardState) if field.name not in ("view", "images"))


class _CudaRasterize(torch.autograd.Function):
    """Compute radii and images from the six parameter tensors.

    With further channels ``values`` [N, F], colours are [H, W, 3 + F].
    """

    @staticmethod
    def forward(
        ctx: Any,
        options: _CudaOptions,
        probe: Tensor | None,
        intrinsics: Tensor | None,
        values: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        tensors = [p.detach().contiguous() for p in parameters]
        launcher, view = options.launcher, options.view
        choices = {
            "exact": options.choices.exact_masks,
            "distortion": options.distortion,
            "transmittance": options.transmittance,
            "whole_lists": values is not None,
        }
        frame = forward(launcher, view, tensors, **choices, budget=options.choices.budget)
        features, color = None, frame.images["color"]
        if values is not None and options.background is not None:
            count = values.shape[1]
            values = pad(values.detach(), (0, len(options.background) - count))
            features = blend_features(launcher, frame, values, options.background)
            color = torch.cat([color, features[:count].permute(1, 2, 0)], dim=2)
        if any(ctx.needs_input_grad):
            # save_for_backward notices if a caller changes a returned image in place.
            ctx.options = options
            ctx.probe_shape = None if probe is None else tuple(probe.shape)
            ctx.channels = 0 if options.background is None else count
            ctx.of_intrinsics = None if intrinsics is None else intrinsics.detach()  # for dtype and device
            ctx.save_for_backward(
                values, features, *(getattr(frame, name) for name in SAVED), *frame.images.values(), *tensors
            )
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(frame.radii)
        names = _image_names(options.transmittance)
        return (frame.radii, color, *(frame.images[name] for name in names[1:]))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        options: _CudaOptions = ctx.options
        values, features, *saved = ctx.saved_tensors
        tensors = saved[-len(ATTRIBUTES) :]
        images = dict(zip((*IMAGES, "final_T", "moments", *DEPTH), saved[len(SAVED) : -len(ATTRIBUTES)], strict=True))
        hidden = dict(zip(SAVED, saved[: len(SAVED)], strict=True))
        frame = ForwardState(view=options.view, images=images, **hidden)
        given = [None if g is None else g.detach().to(torch.float32).contiguous() for g in upstream[1:]]
        if not options.distortion:
            given[IMAGES.index("distortion")] = None  # a constant
        of_features = None
        if values is not None and given[0] is not None:
            filled = (0, values.shape[1] + 3 - given[0].shape[2])
            of_features = pad(given[0][..., 3:], filled).permute(2, 0, 1).contiguous()
            given[0] = given[0][..., :3].contiguous()
        want_probe, want_intrinsics, want_values, *want = ctx.needs_input_grad[1:]
        gradients = {
            name: torch.empty_like(t) if w else None for name, t, w in zip(ATTRIBUTES, tensors, want, strict=True)
        }
        device = tensors[0].device
        probe = torch.empty(ctx.probe_shape, dtype=torch.float32, device=device) if want_probe else None
        each = torch.zeros(len(tensors[0]), 4, dtype=torch.float32, device=device) if want_intrinsics else None
        wanted = RequestedGradients(
            {**gradients, "probe": probe, "intrinsics": each}, options.learns, bool(options.choices.deterministic)
        )
        by_name = {"depth_transmittance": None} | dict(zip(_image_names(options.transmittance), given, strict=True))
        to_values = torch.zeros_like(values) if want_values or of_features is not None else None
        further: Any = None if of_features is None else (values, options.background, features, of_features, to_values)
        backward(options.launcher, frame, tensors, by_name, wanted, further)
        total = None if each is None else each.sum(dim=0, dtype=torch.float64).to(ctx.of_intrinsics)
        to_values = None if to_values is None else to_values[:, : ctx.channels]
        return None, probe, total, to_values, *gradients.values()


def rasterize_with(
    launcher: Launcher,
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    screen_probe: Tensor | None = None,
    gradient_rows: Tensor | None = None,
    *,
    features: Features | None = None,
    choices: CudaChoices = CudaChoices(),
) -> RenderOutput:
    """Render one view with the CUDA kernels; the contract is in :mod:`gs2d.render.api`.

    Images are deterministic. Gradients are summed by atomic additions, so on a GPU their last digits vary from run to
    run, unless ``deterministic``. If only ``sh0`` and ``shN`` have gradients, a shorter backward pass runs.

    Parameters
    ----------
    launcher : Launcher
        Runs the kernels on the device of the tensors.
    splats : Splats
        float32.
    camera : Camera
    settings : RasterSettings
    screen_probe : Tensor [N, 2] or [N, 4], optional
        Zeros; its gradient is the densification signal.
    gradient_rows : Tensor [N] bool, optional
        Splats with gradients; all others get zeros.
    features : Features, optional
        Further channels; not with ``gradient_rows`` or depth by transmittance.
    choices : CudaChoices

    Raises
    ------
    ShapeError
        If a tensor is not float32, or sh_degree exceeds the stored coefficients.
    BackendError
        If there are too many splats or pairs, or only the reference backend supports a setting.
    """
    _check_tensors(splats, settings)
    if gradient_rows is not None:
        gradient_rows = gradient_rows.clone()  # it may change before the backward pass
    if choices.deterministic is None:
        choices = replace(choices, deterministic=torch.are_deterministic_algorithms_enabled())
    transmittance = settings.with_transmittance_depth
    chosen = (settings.with_distortion, transmittance, choices)
    values = background = None
    if features is not None:
        values, background = features.values, features.background.detach()
        background = pad(background, (0, -len(background) % CHANNELS))
    options = _CudaOptions(launcher, _view(camera, settings), *chosen, gradient_rows, background)
    learning = (screen_probe, camera.intrinsics, values)
    radii, *images = _CudaRasterize.apply(options, *learning, *(t for _, t in splats.items()))
    return RenderOutput(**dict(zip(_image_names(transmittance), images, strict=True)), radii=radii)


def splat_errors_with(
    launcher: Launcher,
    splats: Splats,
    camera: Camera,
    image: Tensor,
    settings: RasterSettings,
    mask: Tensor | None = None,
    occlusion: bool = False,
) -> Tensor:
    """Return the inner sum of the paper's E_i for one view [N]; rule 17 of the contract. Deterministic.

    Parameters
    ----------
    launcher, splats, camera, settings
        As for :func:`rasterize_with`.
    image : Tensor [H, W, 3] float32
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    occlusion : bool
        Count a pixel only until it has stopped. An error above 1e9 within 8x8 pixels counts as 1e9.
    """
    _check_tensors(splats, settings)
    parameters = [t.detach().contiguous() for _, t in splats.items()]
    image, mask = image.detach().contiguous(), None if mask is None else mask.contiguous()
    return errors(launcher, _view(camera, settings), parameters, image, mask, occlusion)
