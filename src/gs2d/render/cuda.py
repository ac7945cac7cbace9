"""The passes of the CUDA kernels over torch tensors, as one differentiable function of a launcher.

A launcher runs a kernel by name: on the GPU it will hand the structure to the driver on torch's current stream; the
tests' one runs the same sources on the CPU. Everything else here (memory, sorts, order) is the same for both. No
launcher for a GPU exists yet, so ``get_backend("cuda")`` still refuses.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.camera import Camera
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.cuda.arguments import (
    BlendArguments,
    BlendVjpArguments,
    EmitArguments,
    ErrorArguments,
    ProjectArguments,
    ProjectVjpArguments,
    RangeArguments,
    View,
)
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.splats import Splats

__all__ = ["Launcher", "rasterize_with", "splat_errors_with"]

TILE = 16
THREADS = 128
PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
MOST_SPLATS = 1 << 24  # an entry holds the splat in 24 bits
MOST_CANDIDATES = 1 << 31
IMAGES = ("color", "alpha", "normal", "depth_mean", "depth_median", "distortion")


class Launcher(Protocol):
    """Runs one kernel; the structure's pointers are those of tensors that outlive the call."""

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None: ...


@dataclass(frozen=True, eq=False)
class Frame:
    """What the forward pass leaves for the backward pass.

    Attributes
    ----------
    view : View
    records : Tensor [N, 16] float32
        Screen records; rows of splats without tiles hold garbage.
    tile_counts : Tensor [N] int32
        Tiles in each splat's rectangle; 0 = not drawn.
    entries : Tensor [M] int32
        splat << 8 | mask of sub-blocks, tile by tile, front to back.
    ranges : Tensor [tiles + 1, 2] int64
        Each tile's part of ``entries``.
    tiles : Tensor [tiles] int32
        Tiles in the order in which blocks take them: longest first.
    seen : Tensor [words, 8] int32
        Who was seen by a live pixel, one bit per entry and sub-block.
    images : dict of Tensor
        The outputs, ``final_T`` [H, W] and ``moments`` [H, W, 3].
    radii : Tensor [N] float32
    """

    view: View
    records: Tensor
    tile_counts: Tensor
    entries: Tensor
    ranges: Tensor
    tiles: Tensor
    seen: Tensor
    images: dict[str, Tensor]
    radii: Tensor


def _view(camera: Camera, settings: RasterSettings) -> View:
    if settings.lowpass_depth != "center":
        raise BackendError(
            f"the cuda backend needs lowpass_depth 'center', got {settings.lowpass_depth!r}; use --backend reference"
        )
    view = View()
    view.R[:] = np.asarray(camera.rotation).ravel().tolist()
    view.t[:] = np.asarray(camera.T_cam_world[:3, 3]).tolist()
    view.center[:] = np.asarray(camera.center).tolist()
    view.background[:] = [float(c) for c in settings.background]
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        setattr(view, name, getattr(camera, name))
    for name in ("near", "lowpass_px", "alpha_max", "transmittance_min", "sh_degree"):
        setattr(view, name, getattr(settings, name))
    view.inv_lowpass2 = 1 / settings.lowpass_px**2
    view.log2_alpha_min = math.log2(settings.alpha_min)
    view.error_k2 = settings.error_cutoff**2
    view.distortion_scale = (settings.far * settings.near / (settings.far - settings.near)) ** 2
    view.tiles_x, view.tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    return view


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


def _fill(arguments: ctypes.Structure, tensors: dict[str, Tensor | None]) -> None:
    """Set the structure's pointers; None is a null pointer."""
    for name, tensor in tensors.items():
        setattr(arguments, name, None if tensor is None else tensor.data_ptr())


def _blocks(count: int) -> int:
    return -(-count // THREADS)


@dataclass(frozen=True, eq=False)
class _Projected:
    """What project.cu writes; records, cull and rects of splats without tiles are garbage."""

    records: Tensor  # [N, 16] float32
    cull: Tensor  # [N, 8] float32
    rects: Tensor  # [N, 4] int16
    depth_keys: Tensor  # [N] int32
    tile_counts: Tensor  # [N] int32
    radii: Tensor  # [N] float32


def _project(launcher: Launcher, view: View, parameters: Sequence[Tensor], *, errors: bool) -> _Projected:
    """Records and footprints: those of blending, or with ``errors`` those of rho <= error_cutoff^2."""
    count, device = parameters[0].shape[0], parameters[0].device
    if count >= MOST_SPLATS:
        raise BackendError(f"the cuda backend takes fewer than {MOST_SPLATS} splats, got {count}")
    shapes = {"records": (count, 16), "cull": (count, 8), "rects": (count, 4)}
    types = {"rects": torch.int16, "depth_keys": torch.int32, "tile_counts": torch.int32}
    arrays = {
        field.name: torch.empty(
            shapes.get(field.name, (count,)), dtype=types.get(field.name, torch.float32), device=device
        )
        for field in fields(_Projected)
    }
    if count > 0:
        project = ProjectArguments(view=view, count=count, sh_rest=parameters[5].shape[1], errors=int(errors))
        _fill(project, dict(zip(PARAMETERS, parameters, strict=True)))
        _fill(project, dict(arrays))
        launcher.launch("project_splats", _blocks(count), THREADS, project)
    return _Projected(**arrays)


def forward(launcher: Launcher, view: View, parameters: Sequence[Tensor], *, exact: bool = True) -> Frame:
    """Render one view; ``exact=False`` turns off culling inside tiles (tests).

    The parameters are contiguous float32 tensors in the order of ``Splats``, all on the launcher's device.
    """
    device = parameters[0].device

    def floats(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.float32, device=device)

    projected = _project(launcher, view, parameters, errors=False)
    entries, ranges = _bin(launcher, view, projected, exact)
    tiles = torch.argsort(ranges[:-1, 1] - ranges[:-1, 0], descending=True, stable=True).to(torch.int32)
    words = (len(entries) >> 5) + len(tiles) + 1
    seen = torch.zeros(words, 8, dtype=torch.int32, device=device)
    H, W = int(view.height), int(view.width)
    images = {name: floats(H, W, 3) if name in ("color", "normal") else floats(H, W) for name in IMAGES}
    images |= {"final_T": floats(H, W), "moments": floats(H, W, 3)}
    blend = BlendArguments(view=view)
    _fill(
        blend,
        {"records": projected.records, "entries": entries, "ranges": ranges, "tiles": tiles, "seen": seen, **images},
    )
    launcher.launch("blend_forward_distortion", len(tiles), THREADS, blend)
    hidden = (entries, ranges, tiles, seen, images)
    return Frame(view, projected.records, projected.tile_counts, *hidden, projected.radii)


def _bin(launcher: Launcher, view: View, projected: _Projected, exact: bool) -> tuple[Tensor, Tensor]:
    """Entries and ranges: a stable sort by depth, emission of candidates, a stable sort by tile."""
    device = projected.records.device
    tiles = int(view.tiles_x) * int(view.tiles_y)
    order = torch.sort(projected.depth_keys, stable=True).indices
    ends = torch.cumsum(projected.tile_counts[order], 0, dtype=torch.int64)
    candidates = int(ends[-1]) if len(ends) else 0  # the one host synchronisation of an iteration
    if candidates >= MOST_CANDIDATES:
        raise BackendError(
            f"{candidates} pairs of splat and tile, expected fewer than 2^31: use fewer splats or pixels"
        )
    ranges = torch.zeros(tiles + 1, 2, dtype=torch.int64, device=device)
    entries = torch.empty(candidates, dtype=torch.int32, device=device)
    if candidates == 0:
        return entries, ranges
    bits = 16 if tiles < 1 << 15 else 32  # the sentinel is `tiles`
    keys = torch.empty(candidates, dtype=torch.int16 if bits == 16 else torch.int32, device=device)
    payloads = torch.empty(candidates, dtype=torch.int32, device=device)
    emit = EmitArguments(candidates=candidates, visible=len(order), exact=int(exact))
    for name in ("width", "height", "tiles_x", "tiles_y"):
        setattr(emit, name, getattr(view, name))
    _fill(emit, {"order": order, "ends": ends, "cull": projected.cull, "rects": projected.rects})
    _fill(emit, {"keys": keys, "payloads": payloads})
    launcher.launch(f"emit_entries_{bits}", _blocks(candidates), THREADS, emit)
    sorted_keys, permutation = torch.sort(keys, stable=True)
    find = RangeArguments(candidates=candidates)
    _fill(find, {"keys": sorted_keys, "permutation": permutation, "payloads": payloads})
    _fill(find, {"entries": entries, "ranges": ranges})
    launcher.launch(f"find_ranges_{bits}", _blocks(candidates), THREADS, find)
    return entries, ranges


def backward(
    launcher: Launcher,
    frame: Frame,
    parameters: Sequence[Tensor],
    upstream: dict[str, Tensor | None],
    wanted: dict[str, Tensor | None],
) -> None:
    """Fill the gradient tensors in ``wanted`` (of the parameters and ``probe``); None is not computed."""
    count, device = parameters[0].shape[0], parameters[0].device
    if count == 0:
        return
    probe = wanted["probe"]
    absolute = probe is not None and probe.shape[1] == 4
    kind = "color"
    if any(upstream[name] is not None for name in ("normal", "depth_mean", "depth_median")):
        kind = "geometry"
    if upstream["distortion"] is not None:
        kind = "distortion"
    gradients = torch.zeros(count, 16, dtype=torch.float32, device=device)
    extras = torch.zeros(count, 4, dtype=torch.float32, device=device)
    blend = BlendVjpArguments(view=frame.view)
    _fill(blend, {name: getattr(frame, name) for name in ("records", "entries", "ranges", "tiles", "seen")})
    _fill(blend, {name: image for name, image in frame.images.items() if name != "depth_median"})
    _fill(blend, {f"g_{name}": upstream[name] for name in IMAGES})
    _fill(blend, {"gradients": gradients, "extras": extras})
    launcher.launch(f"blend_vjp_{kind}{'_abs' if absolute else ''}", len(frame.tiles), THREADS, blend)

    project = ProjectVjpArguments(view=frame.view, count=count, sh_rest=parameters[5].shape[1])
    _fill(project, dict(zip(PARAMETERS, parameters, strict=True)))
    _fill(project, {"tile_counts": frame.tile_counts, "gradients": gradients, "extras": extras})
    _fill(project, {f"g_{name}": tensor for name, tensor in wanted.items()})
    project.probe_columns = 0 if probe is None else int(probe.shape[1])
    launcher.launch("project_splats_vjp", _blocks(count), THREADS, project)


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
    view, count = _view(camera, settings), len(splats)
    parameters = [t.detach().contiguous() for _, t in splats.items()]
    projected = _project(launcher, view, parameters, errors=True)
    errors = torch.empty(count, dtype=torch.float32, device=splats.device)
    if count == 0:
        return errors
    image, mask = image.detach().contiguous(), None if mask is None else mask.contiguous()
    arguments = ErrorArguments(view=view, count=count)
    _fill(arguments, {name: getattr(projected, name) for name in ("records", "cull", "rects", "tile_counts")})
    _fill(arguments, {"image": image, "mask": mask, "errors": errors})
    launcher.launch("splat_errors", _blocks(32 * count), THREADS, arguments)
    return errors
