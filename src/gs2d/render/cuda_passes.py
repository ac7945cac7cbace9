"""The passes of the CUDA kernels over torch tensors: projection, sorts, emission, blending, and their gradients.

They run kernels by name through a launcher, so that the sequence of passes, too, is tested without a GPU. torch
allocates the memory. The host waits for the device only for the number of pairs.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import IMAGES
from gs2d.errors import BackendError
from gs2d.kernels.c_structures import filled
from gs2d.kernels.cuda.kernel_arguments import cuda_structure, fill, work_of
from gs2d.kernels.cuda.launch import Launcher, Work
from gs2d.render.cuda_works import (
    blend,
    blend_gradients,
    blocks_of,
    order_tiles,
    piece_buffers,
    piece_words,
    project,
    set_view,
    splat_gradients,
    takes_view,
)
from gs2d.render.pair_budget import MAX_PAIRS, PairBudget, Rendering, room_for
from gs2d.render.types import NEAR_PLANE_POLICIES, RasterSettings

TILE = 16
CHANNELS = 8  # pixels.h: further channels are padded to a multiple of this
MAX_SPLATS = 1 << 24  # an entry stores the splat in 24 bits
MAX_SLOTTED = 1 << 30  # four slots each, indexed with 32 bits
ERROR_UNIT = 2.0**-24  # occluded.cu
DEPTH = ("depth_transmittance", "slope")  # empty unless that depth was requested
HIDDEN = ("final_T", "moments", *DEPTH)  # images that are not always returned
SAVED = ("records", "tile_counts", "entries", "ranges", "tiles", "pieces", "seen", "order", "ends", "permutation")
LISTS = ("records", "entries", "ranges", "tiles", "seen")
PROJECTED = {
    "records": (16, torch.float32),
    "cull": (8, torch.float32),
    "rects": (4, torch.int16),
    "depth_keys": (1, torch.int32),
    "tile_counts": (1, torch.int32),
    "radii": (1, torch.float32),
}
"""Columns and dtypes of the outputs of project.cu, one row per splat."""


@dataclass(frozen=True, eq=False)
class ForwardState:
    """State of a forward pass for the backward pass."""

    view: ctypes.Structure  # ``View`` of common.h
    records: Tensor  # [N, 16] float32 screen records; undefined for splats without tiles
    tile_counts: Tensor  # [N] int32, tiles in each splat's rectangle; 0 = not drawn
    entries: Tensor  # [M] int32, splat << 8 | mask of sub-blocks, tile by tile, front to back
    ranges: Tensor  # [tiles + 1, 2] int64, each tile's range of ``entries``
    tiles: Tensor  # [tiles] int32, in the order of processing: most entries first
    pieces: Tensor  # [words] float32, memory of the pieces of long lists
    seen: Tensor  # [words, 8] int32, one bit each: whether a live pixel of a sub-block uses an entry
    # Outputs, ``final_T`` [H, W], ``moments`` [H, W, 3], ``depth_transmittance`` and ``slope`` [H, W].
    images: dict[str, Tensor]
    radii: Tensor  # [N] float32
    order: Tensor  # [N] int64, splats by depth
    ends: Tensor  # [N] int64, running sum, in that order, of the pairs of splat and tile
    permutation: Tensor  # [M] int64, index of each entry's pair before the sort by tile

    @property
    def lists(self) -> dict[str, Tensor]:
        """The tensors that all blending kernels take."""
        return {name: getattr(self, name) for name in LISTS}


def view_of(camera: Camera, settings: RasterSettings) -> ctypes.Structure:
    """Return the view structure of the kernels."""
    view = cuda_structure("View")()
    view.camera.R[:] = np.asarray(camera.rotation).ravel().tolist()
    view.camera.t[:] = np.asarray(camera.T_cam_world[:3, 3]).tolist()
    view.camera.center[:] = np.asarray(camera.center).tolist()
    view.background[:] = [float(c) for c in settings.background]
    fill(view.camera, **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")})
    view.width, view.height = camera.width, camera.height
    constants = ("near", "mip_px", "alpha_max", "transmittance_min", "sh_degree")
    fill(view, **{name: getattr(settings, name) for name in constants})
    view.lowpass_px, view.inv_lowpass2 = settings.clamp_px, 1 / settings.clamp_px**2
    view.log2_alpha_min = math.log2(settings.alpha_min)
    view.error_k2, view.near_plane_policy = (
        settings.error_cutoff**2,
        NEAR_PLANE_POLICIES.index(settings.near_plane_policy),
    )
    view.inv_depth_width = 1 / settings.depth_width(camera)
    view.distortion_scale = (settings.far * settings.near / (settings.far - settings.near)) ** 2
    view.tiles_x, view.tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    return view


def _run(launcher: Launcher, view: ctypes.Structure, work: Work) -> None:
    """Run a launch for a view."""
    if takes_view(work):
        set_view([work], view)
    launcher.launch(work.name, work.blocks, work.threads, work.arguments)


def _project(
    launcher: Launcher, view: ctypes.Structure, splats: Mapping[str, Tensor], *, errors: bool, exact: bool = True
) -> dict[str, Tensor]:
    """Return the outputs of project.cu; records, cull and rects of splats without tiles are undefined."""
    count, device = len(splats["means"]), splats["means"].device
    if count >= MAX_SPLATS:
        raise BackendError(f"the cuda backend takes fewer than {MAX_SPLATS} splats, got {count}")
    projected = {
        name: torch.empty((count, columns) if columns > 1 else (count,), dtype=dtype, device=device)
        for name, (columns, dtype) in PROJECTED.items()
    }
    if count > 0:
        _run(launcher, view, project(splats, projected, errors=errors, exact=exact))
    return projected


def forward(
    launcher: Launcher,
    view: ctypes.Structure,
    splats: Mapping[str, Tensor],
    *,
    exact: bool = True,
    distortion: bool = True,
    transmittance: bool = False,
    whole_lists: bool = False,
    budget: PairBudget | None = None,
) -> ForwardState:
    """Render one view.

    The six parameters are contiguous float32 tensors on the launcher's device. Without
    ``distortion`` that image is NaN, which saves a tenth of the blending. Without ``transmittance`` the depth by
    transmittance is empty. ``exact=False`` disables culling inside tiles and of splats without an ellipse (tests).
    ``whole_lists`` cuts no list into pieces, as further channels need it.
    """
    device = splats["means"].device

    def floats(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.float32, device=device)

    projected = _project(launcher, view, splats, errors=False, exact=exact)
    binned = _bin(launcher, view, projected, exact, budget, whole_lists=whole_lists)
    words = (len(binned["entries"]) >> 5) + len(binned["tiles"]) + 1
    binned |= {"records": projected["records"], "seen": torch.empty(words, 8, dtype=torch.int32, device=device)}
    H, W, tiles = int(view.height), int(view.width), len(binned["tiles"])
    images = {name: floats(H, W, 3) if name in ("color", "normal") else floats(H, W) for name in IMAGES}
    images |= {"final_T": floats(H, W), "moments": floats(H, W, 3) if distortion else floats(0)}
    if not distortion:
        images["distortion"].fill_(math.nan)
    lists = {name: binned[name] for name in LISTS}
    pieces = piece_buffers(binned["pieces"], len(binned["pieces"]))
    for work in blend(tiles, lists, images, pieces, distortion=distortion):
        _run(launcher, view, work)
    images |= {name: floats(H, W) if transmittance else floats(0) for name in DEPTH}
    if transmittance:
        more = {"alpha": images["alpha"], "median": images["depth_median"], "slope": images["slope"]}
        more |= {"depth": images["depth_transmittance"]}
        _run(launcher, view, work_of("transmittance_depth", tiles, lists, more))
    per_splat = {name: projected[name] for name in ("tile_counts", "radii")}
    return ForwardState(view=view, images=images, **binned, **per_splat)


def _features(
    values: Tensor, background: Tensor, images: Tensor, upstream: Tensor | None = None, gradients: Tensor | None = None
) -> ctypes.Structure:
    """Return the structure of further channels; their number is a multiple of ``CHANNELS``, tensors are contiguous."""
    tensors = {"values": values, "background": background, "images": images}
    return filled(cuda_structure("Features"), **tensors, upstream=upstream, gradients=gradients, count=values.shape[1])


def blend_features(launcher: Launcher, frame: ForwardState, values: Tensor, background: Tensor) -> Tensor:
    """Return the images [F, H, W] of further channels [N, F] over a background [F], for the view of ``frame``."""
    final_T = frame.images["final_T"]
    images = final_T.new_empty(values.shape[1], *final_T.shape)
    features = _features(values, background, images)
    work = work_of("features_forward", len(frame.tiles), frame.lists, final_T=final_T, features=features)
    _run(launcher, frame.view, work)
    return images


def _bin(
    launcher: Launcher,
    view: ctypes.Structure,
    projected: dict[str, Tensor],
    exact: bool,
    budget: PairBudget | None = None,
    *,
    whole_lists: bool,
) -> dict[str, Tensor]:
    """Return the splats of each tile: stable sort by depth, emission of candidate pairs, stable sort by tile."""
    device = projected["records"].device
    tiles = int(view.tiles_x) * int(view.tiles_y)
    order = torch.sort(projected["depth_keys"], stable=True).indices
    ends = torch.cumsum(projected["tile_counts"][order], 0, dtype=torch.int64)
    rendering = Rendering(tiles, len(order), bytes(view.camera))
    candidates = room_for(ends[-1], rendering, budget) if len(ends) else 0
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
        inputs = {name: projected[name] for name in ("cull", "records", "rects")}
        inputs |= {"order": order, "ends": ends, "keys": keys, "payloads": payloads}
        sizes = {"candidates": candidates, "visible": len(order), "exact": int(exact)}
        _run(launcher, view, work_of(f"emit_entries_{bits}", blocks_of(candidates), inputs, sizes))
        sorted_keys, permutation = torch.sort(keys, stable=True)
        inputs = {"keys": sorted_keys, "permutation": permutation, "payloads": payloads}
        inputs |= {"entries": entries, "ranges": ranges}
        _run(launcher, view, work_of(f"find_ranges_{bits}", blocks_of(candidates), inputs, candidates=candidates))
    heavy_first = torch.empty(tiles, dtype=torch.int32, device=device)
    words = piece_words(0 if whole_lists else candidates)
    pieces = torch.empty(words, dtype=torch.float32, device=device)
    _run(launcher, view, order_tiles(tiles, {"ranges": ranges, "order": heavy_first}, piece_buffers(pieces, words)))
    lists = {"entries": entries, "ranges": ranges, "tiles": heavy_first, "pieces": pieces}
    return lists | {"order": order, "ends": ends, "permutation": permutation}


def backward(
    launcher: Launcher,
    frame: ForwardState,
    splats: Mapping[str, Tensor],
    upstream: Mapping[str, Tensor | None],
    outputs: Mapping[str, Tensor | None],
    *,
    learns: Tensor | None = None,
    deterministic: bool = False,
    features: Sequence[Tensor] | None = None,
) -> None:
    """Compute gradients.

    ``upstream`` are the gradients of the images by name. ``outputs`` are the output tensors by name of the parameter,
    "probe" and "intrinsics" [N, 4]; None is not computed. Splats outside of ``learns`` [N] bool get zeros.
    ``deterministic`` sums without atomics: 320 bytes for each pair of splat and tile, and one more pass.

    ``features`` are the values [N, F], background [F] and images [F, H, W] of further channels, the gradients of these
    images, and zeros [N, F] for the gradients of the values. They exclude ``learns`` and a gradient of the depth by
    transmittance.
    """
    if len(splats["means"]) == 0:
        return
    only_colors = features is None and all(
        tensor is None for name, tensor in outputs.items() if name not in ("sh0", "shN")
    )
    if only_colors and upstream["color"] is None:
        for tensor in outputs.values():
            if tensor is not None:
                tensor.zero_()
        return
    probe = outputs["probe"]
    sums = _Sums(frame, deterministic, columns=0 if only_colors else 16)
    further = None
    if features is not None:
        values, background, blended_values, gradients_of_images, to_values = features
        further = _features(values, background, blended_values, gradients_of_images, sums.of_features(to_values))
    blended = blend_gradients(
        len(frame.tiles),
        frame.lists,
        frame.images,
        upstream,
        {"gradients": sums.gradients, "extras": sums.extras, "slots": sums.slots, "learns": learns},
        piece_buffers(frame.pieces, len(frame.pieces)),
        absolute=probe is not None and probe.shape[1] == 4,
        features=further,
    )
    _run(launcher, frame.view, blended)
    gradients, extras = sums.of_splats(launcher)
    inputs = {"tile_counts": frame.tile_counts, "learns": learns, "gradients": gradients, "extras": extras}
    _run(launcher, frame.view, splat_gradients(splats, inputs, outputs))


class _Sums:
    """Sums of the blending's gradients: one row per splat, or one slot per entry and warp for fixed order."""

    def __init__(self, frame: ForwardState, deterministic: bool, *, columns: int) -> None:
        if deterministic and len(frame.permutation) >= MAX_SLOTTED:
            raise BackendError(
                f"{len(frame.permutation)} pairs of splat and tile, expected fewer than 2^30 for deterministic "
                "gradients: use fewer splats or pixels, or torch.use_deterministic_algorithms(False)"
            )
        self.frame = frame
        self.slots = frame.permutation if deterministic else None  # [M] int64
        rows = len(frame.records) if self.slots is None else 4 * len(self.slots)
        # One allocation, cleared at once; the rows of 64 bytes come first, so that they are aligned to lines.
        both = torch.zeros(rows * (columns + 4), dtype=torch.float32, device=frame.records.device)
        self.extras = both[rows * columns :].view(rows, 4)
        self.gradients = both[: rows * columns].view(rows, columns) if columns else None
        self._features: tuple[Tensor, Tensor] | None = None  # slots [4 M, F] and the sums [N, F]

    def of_features(self, gradients: Tensor) -> Tensor:
        """Return the tensor to which the blending adds the gradients of features, whose sums are ``gradients``."""
        if self.slots is None:
            return gradients
        slots = gradients.new_zeros(4 * len(self.slots), gradients.shape[1])
        self._features = slots, gradients
        return slots

    def of_splats(self, launcher: Launcher) -> tuple[Tensor | None, Tensor]:
        """Return the sums per splat, [N, columns] and [N, 4]."""
        if self.slots is None:
            return self.gradients, self.extras
        count = len(self.frame.records)
        extras = self.extras.new_empty(count, 4)
        gradients = None if self.gradients is None else self.gradients.new_empty(count, self.gradients.shape[1])
        inputs = {"order": self.frame.order, "ends": self.frame.ends, "gradients": gradients, "extras": extras}
        sizes = {"count": count, "candidates": len(self.slots)}
        slots = {"slots": self.gradients, "extra_slots": self.extras}
        if self._features is not None:
            slots["feature_slots"], inputs["features"] = self._features
            sizes["channels"] = self._features[1].shape[1]
        _run(launcher, self.frame.view, work_of("sum_slots", blocks_of(32 * count), sizes, inputs, slots))
        return gradients, extras


def errors(
    launcher: Launcher,
    view: ctypes.Structure,
    splats: Mapping[str, Tensor],
    image: Tensor,
    mask: Tensor | None,
    occlusion: bool = False,
) -> Tensor:
    """Return the splat errors [N] of one view; image float32 [H, W, 3] and mask bool [H, W] are contiguous."""
    count = len(splats["means"])
    projected = _project(launcher, view, splats, errors=True)
    if count == 0:
        return torch.empty(0, dtype=torch.float32, device=image.device)
    inputs: dict[str, Tensor | None] = {"image": image, "mask": mask}
    if occlusion:
        lists = _bin(launcher, view, projected, True, whole_lists=True)
        units = torch.zeros(count, dtype=torch.int64, device=image.device)
        inputs |= {name: lists[name] for name in ("entries", "ranges", "tiles")}
        inputs |= {"records": projected["records"], "errors": units}
        _run(launcher, view, work_of("splat_errors_occluded", len(lists["tiles"]), inputs))
        return (units.to(torch.float64) * ERROR_UNIT).to(torch.float32)
    total = torch.empty(count, dtype=torch.float32, device=image.device)
    inputs |= {name: projected[name] for name in ("records", "cull", "rects", "tile_counts")} | {"errors": total}
    _run(launcher, view, work_of("splat_errors", blocks_of(32 * count), inputs, count=count))
    return total
