"""The passes of the CUDA kernels over torch tensors: projection, sorts, emission, blending, and their gradients.

Written against a launcher, which runs a kernel by name, so that the sequence of passes, not only the kernels, is tested
without a GPU. Memory is torch's; nothing waits for the device but for the number of pairs.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gs2d.camera import Camera
from gs2d.errors import BackendError
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
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render.types import RasterSettings

__all__ = ["IMAGES", "PARAMETERS", "Frame", "backward", "errors", "forward", "view_of"]

TILE = 16
THREADS = 128
PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
MOST_SPLATS = 1 << 24  # an entry holds the splat in 24 bits
MOST_CANDIDATES = 1 << 31
IMAGES = ("color", "alpha", "normal", "depth_mean", "depth_median", "distortion")


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


def view_of(camera: Camera, settings: RasterSettings) -> View:
    """The structure that every kernel takes.

    Raises
    ------
    BackendError
        A setting of the reference backend only.
    """
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


def errors(launcher: Launcher, view: View, parameters: Sequence[Tensor], image: Tensor, mask: Tensor | None) -> Tensor:
    """Splat errors [N] of one view; all tensors contiguous, image float32 [H, W, 3], mask bool [H, W]."""
    count = parameters[0].shape[0]
    projected = _project(launcher, view, parameters, errors=True)
    total = torch.empty(count, dtype=torch.float32, device=image.device)
    if count == 0:
        return total
    arguments = ErrorArguments(view=view, count=count)
    _fill(arguments, {name: getattr(projected, name) for name in ("records", "cull", "rects", "tile_counts")})
    _fill(arguments, {"image": image, "mask": mask, "errors": total})
    launcher.launch("splat_errors", _blocks(32 * count), THREADS, arguments)
    return total
