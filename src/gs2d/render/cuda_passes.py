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

from gs2d.core.camera import Camera
from gs2d.errors import BackendError
from gs2d.kernels.cuda.arguments import (
    BlendArguments,
    BlendColorsArguments,
    BlendVjpArguments,
    DepthArguments,
    EmitArguments,
    ErrorArguments,
    FeatureArguments,
    Features,
    OccludedArguments,
    OrderArguments,
    ProjectArguments,
    ProjectColorsArguments,
    ProjectVjpArguments,
    RangeArguments,
    SlotArguments,
    View,
)
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render.pair_budget import MAX_PAIRS, PairBudget, Rendering, room_for
from gs2d.render.types import NEAR_PLANE_POLICIES, RasterSettings

__all__ = [
    "CHANNELS",
    "DEPTH",
    "IMAGES",
    "PARAMETERS",
    "ForwardState",
    "Wanted",
    "backward",
    "blend_features",
    "errors",
    "forward",
    "view_of",
]

TILE = 16
THREADS = 128
ORDER_THREADS = 512  # order.cu
CHANNELS = 8  # pixels.h: further channels come in groups of these
PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
MAX_SPLATS = 1 << 24  # an entry holds the splat in 24 bits
MAX_SLOTTED = 1 << 30  # four slots each, counted in 32 bits
ERROR_UNIT = 2.0**-24  # occluded.cu
CAMERA_BYTES = View.near.offset  # pose and intrinsics: what tells views of a training apart
IMAGES = ("color", "alpha", "normal", "depth_mean", "depth_median", "distortion")
DEPTH = ("depth_transmittance", "slope")  # without pixels where that depth was not asked for


@dataclass(frozen=True, eq=False)
class ForwardState:
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
        The outputs, ``final_T`` [H, W], ``moments`` [H, W, 3], ``depth_transmittance`` and its ``slope`` [H, W].
    radii : Tensor [N] float32
    order : Tensor [N] int64
        Splats by depth.
    ends : Tensor [N] int64
        Running sum, in that order, of the pairs of splat and tile.
    permutation : Tensor [M] int64
        The pair that each entry was.
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
    order: Tensor
    ends: Tensor
    permutation: Tensor


@dataclass(frozen=True, eq=False)
class _Lists:
    """The splats of each tile, front to back; fields as in Frame."""

    entries: Tensor
    ranges: Tensor
    tiles: Tensor
    order: Tensor
    ends: Tensor
    permutation: Tensor


def view_of(camera: Camera, settings: RasterSettings) -> View:
    """Return the structure that every kernel takes.

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
    view.error_k2, view.near_plane_policy = (
        settings.error_cutoff**2,
        NEAR_PLANE_POLICIES.index(settings.near_plane_policy),
    )
    view.inv_depth_width = 1 / settings.depth_width(camera)
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


PROJECTED = tuple(field.name for field in fields(_Projected))


def _project(
    launcher: Launcher, view: View, parameters: Sequence[Tensor], *, errors: bool, exact: bool = True
) -> _Projected:
    """Return records and footprints: those of blending, or with ``errors`` those of rho <= error_cutoff^2."""
    count, device = parameters[0].shape[0], parameters[0].device
    if count >= MAX_SPLATS:
        raise BackendError(f"the cuda backend takes fewer than {MAX_SPLATS} splats, got {count}")
    shapes = {"records": (count, 16), "cull": (count, 8), "rects": (count, 4)}
    types = {"rects": torch.int16, "depth_keys": torch.int32, "tile_counts": torch.int32}
    arrays = {
        name: torch.empty(shapes.get(name, (count,)), dtype=types.get(name, torch.float32), device=device)
        for name in PROJECTED
    }
    if count > 0:
        project = ProjectArguments(view=view, count=count, sh_rest=parameters[5].shape[1])
        project.errors, project.exact = int(errors), int(exact)
        _fill(project, dict(zip(PARAMETERS, parameters, strict=True)))
        _fill(project, dict(arrays))
        launcher.launch("project_splats", _blocks(count), THREADS, project)
    return _Projected(**arrays)


def forward(
    launcher: Launcher,
    view: View,
    parameters: Sequence[Tensor],
    *,
    exact: bool = True,
    distortion: bool = True,
    transmittance: bool = False,
    budget: PairBudget | None = None,
) -> ForwardState:
    """Render one view; ``exact=False`` turns off culling inside tiles, and all of what has no ellipse (tests).

    The parameters are contiguous float32 tensors in the order of ``Splats``, all on the launcher's device. Without
    ``distortion`` that image is NaN: it is a tenth of the blending, and few recipes want it. The depth by
    ``transmittance`` has no pixels without it.
    """
    device = parameters[0].device

    def floats(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.float32, device=device)

    projected = _project(launcher, view, parameters, errors=False, exact=exact)
    lists = _bin(launcher, view, projected, exact, budget)
    words = (len(lists.entries) >> 5) + len(lists.tiles) + 1
    seen = torch.empty(words, 8, dtype=torch.int32, device=device)
    H, W = int(view.height), int(view.width)
    images = {name: floats(H, W, 3) if name in ("color", "normal") else floats(H, W) for name in IMAGES}
    images |= {"final_T": floats(H, W), "moments": floats(H, W, 3) if distortion else floats(0)}
    if not distortion:
        images["distortion"].fill_(math.nan)
    blend = BlendArguments(view=view)
    _fill(blend, {"records": projected.records, "seen": seen, **images})
    _fill(blend, {name: getattr(lists, name) for name in ("entries", "ranges", "tiles")})
    launcher.launch(f"blend_forward{'_distortion' if distortion else ''}", len(lists.tiles), THREADS, blend)
    images |= {name: floats(H, W) if transmittance else floats(0) for name in DEPTH}
    if transmittance:
        find = DepthArguments(view=view)
        _fill(find, {"records": projected.records, "seen": seen, "alpha": images["alpha"]})
        _fill(find, {"median": images["depth_median"], "depth": images["depth_transmittance"]})
        _fill(
            find, {"slope": images["slope"], **{name: getattr(lists, name) for name in ("entries", "ranges", "tiles")}}
        )
        launcher.launch("transmittance_depth", len(lists.tiles), THREADS, find)
    return ForwardState(
        view=view,
        records=projected.records,
        tile_counts=projected.tile_counts,
        entries=lists.entries,
        ranges=lists.ranges,
        tiles=lists.tiles,
        seen=seen,
        images=images,
        radii=projected.radii,
        order=lists.order,
        ends=lists.ends,
        permutation=lists.permutation,
    )


def _features(
    values: Tensor, background: Tensor, images: Tensor, upstream: Tensor | None = None, gradients: Tensor | None = None
) -> Features:
    """Return the structure of further channels, a multiple of ``CHANNELS``; all tensors are contiguous."""
    features = Features(count=values.shape[1])
    _fill(features, {"values": values, "background": background, "images": images})
    _fill(features, {"upstream": upstream, "gradients": gradients})
    return features


def blend_features(launcher: Launcher, frame: ForwardState, values: Tensor, background: Tensor) -> Tensor:
    """Return images [F, H, W] of further channels [N, F] over a background [F]: those of the view of ``frame``."""
    final_T = frame.images["final_T"]
    images = final_T.new_empty(values.shape[1], *final_T.shape)
    blend = FeatureArguments(view=frame.view, features=_features(values, background, images))
    _fill(blend, {name: getattr(frame, name) for name in ("records", "entries", "ranges", "tiles", "seen")})
    _fill(blend, {"final_T": final_T})
    launcher.launch("features_forward", len(frame.tiles), THREADS, blend)
    return images


def _bin(
    launcher: Launcher, view: View, projected: _Projected, exact: bool, budget: PairBudget | None = None
) -> _Lists:
    """Return a stable sort by depth, emission of candidates, a stable sort by tile."""
    device = projected.records.device
    tiles = int(view.tiles_x) * int(view.tiles_y)
    order = torch.sort(projected.depth_keys, stable=True).indices
    ends = torch.cumsum(projected.tile_counts[order], 0, dtype=torch.int64)
    camera = bytes(view)[:CAMERA_BYTES]
    candidates = room_for(ends[-1], Rendering(tiles, len(order), camera), budget) if len(ends) else 0
    if candidates > MAX_PAIRS:
        raise BackendError(
            f"{candidates} pairs of splat and tile, expected fewer than 2^31: use fewer splats or pixels"
        )
    ranges = torch.zeros(tiles + 1, 2, dtype=torch.int64, device=device)
    entries = torch.empty(candidates, dtype=torch.int32, device=device)
    permutation = torch.empty(0, dtype=torch.int64, device=device)
    if candidates > 0:
        bits = 16 if tiles < 1 << 15 else 32  # the sentinel is `tiles`
        keys = torch.empty(candidates, dtype=torch.int16 if bits == 16 else torch.int32, device=device)
        payloads = torch.empty(candidates, dtype=torch.int32, device=device)
        emit = EmitArguments(candidates=candidates, visible=len(order), exact=int(exact))
        for name in ("width", "height", "tiles_x", "tiles_y", "near"):
            setattr(emit, name, getattr(view, name))
        _fill(emit, {"order": order, "ends": ends})
        _fill(emit, {name: getattr(projected, name) for name in ("cull", "records", "rects")})
        _fill(emit, {"keys": keys, "payloads": payloads})
        launcher.launch(f"emit_entries_{bits}", _blocks(candidates), THREADS, emit)
        sorted_keys, permutation = torch.sort(keys, stable=True)
        find = RangeArguments(candidates=candidates)
        _fill(find, {"keys": sorted_keys, "permutation": permutation, "payloads": payloads})
        _fill(find, {"entries": entries, "ranges": ranges})
        launcher.launch(f"find_ranges_{bits}", _blocks(candidates), THREADS, find)
    heavy_first = torch.empty(tiles, dtype=torch.int32, device=device)
    arrange = OrderArguments(tiles=tiles)
    _fill(arrange, {"ranges": ranges, "order": heavy_first})
    launcher.launch("order_tiles", 1, ORDER_THREADS, arrange)
    return _Lists(entries, ranges, heavy_first, order, ends, permutation)


@dataclass(frozen=True, eq=False)
class Wanted:
    """Which gradients a backward pass is to compute.

    Attributes
    ----------
    parameters : dict of Tensor or None
        To be filled, by name of the parameter, ``probe`` and ``intrinsics`` [N, 4]; None is not computed.
    learns : Tensor [N] bool, optional
        The splats that have gradients; all others get zeros.
    deterministic : bool
        Nothing is added up by atomics: 320 bytes for each pair of splat and tile, and one more pass.
    """

    parameters: dict[str, Tensor | None]
    learns: Tensor | None = None
    deterministic: bool = False

    @property
    def only_colors(self) -> bool:
        """Whether nothing but colours learns."""
        return all(tensor is None for name, tensor in self.parameters.items() if name not in ("sh0", "shN"))


def backward(
    launcher: Launcher,
    frame: ForwardState,
    parameters: Sequence[Tensor],
    upstream: dict[str, Tensor | None],
    wanted: Wanted,
    features: Sequence[Tensor] | None = None,
) -> None:
    """Fill the gradient tensors in ``wanted``.

    ``features`` are the values [N, F], background [F] and images [F, H, W] of further channels, the gradients of these
    images, and zeros [N, F] for those of the values; then ``wanted`` is not deterministic, for all splats and without
    depth by transmittance.
    """
    if len(parameters[0]) == 0:
        return
    if wanted.only_colors and features is None:
        return _backward_colors(launcher, frame, parameters, upstream["color"], wanted)
    probe = wanted.parameters["probe"]
    absolute = probe is not None and probe.shape[1] == 4
    kind = "color"
    if any(upstream[name] is not None for name in ("normal", "depth_mean", "depth_median")):
        kind = "geometry"
    if upstream["distortion"] is not None:
        kind = "distortion"
    if upstream["depth_transmittance"] is not None:
        kind = "distortion_transmittance" if kind == "distortion" else "transmittance"
    sums = _Sums(frame, wanted.deterministic, columns=16)
    blend = BlendVjpArguments(view=frame.view)
    _fill(blend, {name: getattr(frame, name) for name in ("records", "entries", "ranges", "tiles", "seen")})
    _fill(blend, {name: image for name, image in frame.images.items() if name != "depth_median"})
    _fill(blend, {f"g_{name}": upstream[name] for name in (*IMAGES, "depth_transmittance")})
    _fill(blend, {"gradients": sums.gradients, "extras": sums.extras, "slots": sums.slots, "learns": wanted.learns})
    kernel = f"blend_vjp_{kind}"
    if features is not None:
        blend.features = _features(*features)
        kernel = f"features_vjp{'_distortion' if kind == 'distortion' else ''}"
    launcher.launch(f"{kernel}{'_abs' if absolute else ''}", len(frame.tiles), THREADS, blend)
    gradients, extras = sums.of_splats(launcher)

    project = ProjectVjpArguments(view=frame.view, count=len(parameters[0]), sh_rest=parameters[5].shape[1])
    _fill(project, dict(zip(PARAMETERS, parameters, strict=True)))
    _fill(project, {"tile_counts": frame.tile_counts, "learns": wanted.learns})
    _fill(project, {"gradients": gradients, "extras": extras})
    _fill(project, {f"g_{name}": tensor for name, tensor in wanted.parameters.items()})
    project.probe_columns = 0 if probe is None else int(probe.shape[1])
    launcher.launch("project_splats_vjp", _blocks(len(parameters[0])), THREADS, project)


def _backward_colors(
    launcher: Launcher, frame: ForwardState, parameters: Sequence[Tensor], g_color: Tensor | None, wanted: Wanted
) -> None:
    """Of sh0 and shN alone: no geometry, and no work behind the last splat that learns."""
    means, *_, sh0, shN = parameters
    g_sh0, g_shN = wanted.parameters["sh0"], wanted.parameters["shN"]
    if g_color is None:
        for tensor in (g_sh0, g_shN):
            if tensor is not None:
                tensor.zero_()
        return
    sums = _Sums(frame, wanted.deterministic, columns=0)
    blend = BlendColorsArguments(view=frame.view)
    _fill(blend, {name: getattr(frame, name) for name in ("records", "entries", "ranges", "tiles", "seen")})
    _fill(blend, {"learns": wanted.learns, "g_color": g_color, "slots": sums.slots, "gradients": sums.extras})
    launcher.launch("blend_vjp_learning", len(frame.tiles), THREADS, blend)
    _, gradients = sums.of_splats(launcher)
    project = ProjectColorsArguments(view=frame.view, count=len(means), sh_rest=shN.shape[1])
    _fill(project, {"means": means, "sh0": sh0, "shN": shN, "tile_counts": frame.tile_counts})
    _fill(project, {"learns": wanted.learns, "gradients": gradients, "g_sh0": g_sh0, "g_shN": g_shN})
    launcher.launch("project_colors_vjp", _blocks(len(means)), THREADS, project)


class _Sums:
    """Where the blending's gradients are added up: rows of the splats, or a slot for each (entry, warp)."""

    def __init__(self, frame: ForwardState, deterministic: bool, *, columns: int) -> None:
        if deterministic and len(frame.permutation) >= MAX_SLOTTED:
            raise BackendError(
                f"{len(frame.permutation)} pairs of splat and tile, expected fewer than 2^30 for deterministic "
                "gradients: use fewer splats or pixels, or torch.use_deterministic_algorithms(False)"
            )
        self.frame = frame
        self.slots = frame.permutation if deterministic else None  # [M] int64
        rows = len(frame.records) if self.slots is None else 4 * len(self.slots)
        # one piece of memory, which is cleared at once; 64 bytes a row first, so that they begin where lines do
        both = torch.zeros(rows * (columns + 4), dtype=torch.float32, device=frame.records.device)
        self.extras = both[rows * columns :].view(rows, 4)
        self.gradients = both[: rows * columns].view(rows, columns) if columns else None

    def of_splats(self, launcher: Launcher) -> tuple[Tensor | None, Tensor]:
        """[N, columns] and [N, 4]."""
        if self.slots is None:
            return self.gradients, self.extras
        count = len(self.frame.records)
        extras = self.extras.new_empty(count, 4)
        gradients = None if self.gradients is None else self.gradients.new_empty(count, self.gradients.shape[1])
        slots = SlotArguments(count=count, candidates=len(self.slots))
        _fill(slots, {"order": self.frame.order, "ends": self.frame.ends})
        _fill(slots, {"slots": self.gradients, "extra_slots": self.extras, "gradients": gradients, "extras": extras})
        launcher.launch("sum_slots", _blocks(32 * count), THREADS, slots)
        return gradients, extras


def errors(
    launcher: Launcher,
    view: View,
    parameters: Sequence[Tensor],
    image: Tensor,
    mask: Tensor | None,
    occlusion: bool = False,
) -> Tensor:
    """Splat errors [N] of one view; all tensors contiguous, image float32 [H, W, 3], mask bool [H, W]."""
    count = parameters[0].shape[0]
    projected = _project(launcher, view, parameters, errors=True)
    if count == 0:
        return torch.empty(0, dtype=torch.float32, device=image.device)
    if occlusion:
        lists = _bin(launcher, view, projected, True)
        units = torch.zeros(count, dtype=torch.int64, device=image.device)
        occluded = OccludedArguments(view=view)
        _fill(occluded, {name: getattr(lists, name) for name in ("entries", "ranges", "tiles")})
        _fill(occluded, {"records": projected.records, "image": image, "mask": mask, "errors": units})
        launcher.launch("splat_errors_occluded", len(lists.tiles), THREADS, occluded)
        return (units.to(torch.float64) * ERROR_UNIT).to(torch.float32)
    total = torch.empty(count, dtype=torch.float32, device=image.device)
    arguments = ErrorArguments(view=view, count=count)
    _fill(arguments, {name: getattr(projected, name) for name in ("records", "cull", "rects", "tile_counts")})
    _fill(arguments, {"image": image, "mask": mask, "errors": total})
    launcher.launch("splat_errors", _blocks(32 * count), THREADS, arguments)
    return total
