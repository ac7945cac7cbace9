"""A whole training iteration on a GPU with our kernels alone, from projection to Adam.

It uses no autograd, no torch operations and no allocations. Memory lies in an :class:`Arena`, and the arguments of all
kernels stay filled; between iterations only the camera, the photograph, the room for pairs and the learning rates are
written. The launches are therefore always the same, and a launcher may run them as a graph. The kernels are those of
:mod:`gs2d.render.cuda_passes` and :mod:`gs2d.kernels.cuda.cuda_losses`; results differ only by the order of atomics.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.kernels.adam_update import AdamUpdate, bias_corrections
from gs2d.kernels.cuda.cuda_adam import adam_work
from gs2d.kernels.cuda.cuda_losses import MEAN_PIXELS, NORMAL_H, NORMAL_W, strips
from gs2d.kernels.cuda.kernel_arguments import fill, work_of
from gs2d.kernels.cuda.launch import Launcher, Work
from gs2d.kernels.cuda.sort import (
    DIGITS,
    MOST_PASSES,
    MOST_SORTED,
    SORT_THREADS,
    clear_blocks,
    digit_blocks,
    passes_of,
    pieces_of,
)
from gs2d.render.cuda_passes import MAX_SPLATS, PROJECTED, view_of
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
from gs2d.render.pair_budget import PairBudget, Rendering
from gs2d.render.whole_step import WholeStep

SPARE = 1.2  # allocated memory relative to the need, so that a few more splats or pairs fit
DEPTH_BITS = 32
TICKETS = 16  # counters; each pass of both sorts and the running sums take one
MOST_VIEWS = 1 << 12
MOST_PLANS = 8  # image sizes whose arguments stay filled


class Arena:
    """Persistent memory: flat tensors by name, which grow and are only freed together."""

    def __init__(self, device: torch.device) -> None:
        self.generation = 0  # incremented when a tensor moves, which invalidates addresses
        self._device = device
        self._tensors: dict[str, Tensor] = {}

    def get(
        self, name: str, count: int, dtype: torch.dtype = torch.float32, *, zeros: bool = False, spare: float = SPARE
    ) -> Tensor:
        """Return at least ``count`` elements: the existing memory, or new memory of ``spare`` times this size.

        With ``zeros`` new memory is zero, and users reset it to zero.
        """
        tensor = self._tensors.get(name)
        if tensor is None or len(tensor) < count:
            make: Callable[..., Tensor] = torch.zeros if zeros else torch.empty
            tensor = self._tensors[name] = make(math.ceil(spare * count), dtype=dtype, device=self._device)
            self.generation += 1
        return tensor

    def release(self) -> None:
        """Free all memory."""
        if self._tensors:
            self._tensors.clear()
            self.generation += 1


class Stepper:
    """Runs iterations of one training."""

    def __init__(self, launcher: Launcher, device: torch.device) -> None:
        self._launcher, self._device = launcher, device
        self._arena = Arena(device)
        self._plans: dict[tuple[object, ...], _Plan] = {}
        self._generation = -1
        self._views: dict[tuple[int, int], tuple[object, object, ctypes.Structure]] = {}

    def release(self) -> None:
        """Free the memory, since a rendering outside of whole steps needs as much."""
        self._plans.clear()
        self._arena.release()

    def run(self, step: WholeStep, budget: PairBudget) -> bool:
        """Run an iteration; False: it is not supported and nothing was done.

        If the budget's room is too small, the iteration changes no persistent tensor, and ``budget.overflowed`` is
        true.
        """
        count = len(step.splats)
        if not 0 < count < MAX_SPLATS or budget.overflow is not None or not _suits(step):
            return False
        view = self._view_of(step)
        rendering = Rendering(int(view.tiles_x) * int(view.tiles_y), count, bytes(view.camera))
        room = budget.room(rendering)
        if room is None or room > MOST_SORTED:
            return False
        plan = self._plan_of(step, view, max(room, 1))
        budget.overflow = plan.overflow
        plan.set(step, view, max(room, 1), budget.expect(rendering, max(room, 1), self._device))
        self._launcher.run(plan.until_counted)
        budget.record(self._device)
        self._launcher.run(plan.afterwards)
        return True

    def _view_of(self, step: WholeStep) -> ctypes.Structure:
        """Return the structure of a camera; cached, since cameras recur."""
        key = id(step.camera), id(step.settings)
        entry = self._views.get(key)
        if entry is None:
            if len(self._views) >= MOST_VIEWS:
                self._views.clear()
            # Keep the objects, so that their ids stay valid.
            entry = self._views[key] = step.camera, step.settings, view_of(step.camera, step.settings)
        return entry[2]

    def _plan_of(self, step: WholeStep, view: ctypes.Structure, room: int) -> _Plan:
        """Return the launches of such an iteration, with all constant arguments filled."""
        key = _key(step)
        plan = self._plans.get(key)
        if plan is not None and self._generation == self._arena.generation and room <= plan.most_room:
            return plan
        plan = _Plan(self._arena, step, view, room)
        if self._generation != self._arena.generation or len(self._plans) >= MOST_PLANS:
            self._plans.clear()  # their addresses are invalid
        self._generation = self._arena.generation
        self._plans[key] = plan
        return plan


def _suits(step: WholeStep) -> bool:
    """Whether all tensors are contiguous float32."""
    tensors = [tensor for _, tensor in step.splats.items()]
    tensors += [tensor for one in step.learned.values() for tensor in (one.mean, one.square)]
    return all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in tensors)


def _key(step: WholeStep) -> tuple[object, ...]:
    """Return the key of a plan: all that its arguments depend on, except what :meth:`_Plan.set` writes."""
    splats, height, width = step.splats, step.camera.height, step.camera.width
    return (
        height,
        width,
        len(splats),
        step.photograph.shape[2],
        step.losses.silhouette is not None,
        None if step.losses.normals is None else step.losses.normals[1:],  # without the weight
        step.losses.smooth_normals > 0,
        0 if step.rows is None else step.rows.data_ptr(),
        tuple([(name, tensor.data_ptr()) for name, tensor in step.gathered.items()]),
        tuple([tensor.data_ptr() for _, tensor in splats.items()]),
        tuple(
            [
                (name, one.mean.data_ptr(), one.square.data_ptr(), 0 if one.trained is None else one.trained.data_ptr())
                for name, one in step.learned.items()
            ]
        ),
    )


class _Sorting:
    """The launches that sort ``count`` splats by depth and ``room`` pairs by tile, and their scratch memory."""

    def __init__(self, arena: Arena, count: int, tiles: int, room: int) -> None:
        self._arena, self._count, self._tiles = arena, count, tiles
        self.bits = 16 if tiles < 1 << 15 else 32  # of the tile keys
        self._passes = len(passes_of(tiles.bit_length()))
        key = torch.int16 if self.bits == 16 else torch.int32
        entries = arena.get("entries", room, torch.int32)
        self.most_room = len(entries)  # pairs that fit into the allocated memory
        keys = [arena.get(f"{name}_{self.bits}", self.most_room, key, spare=1) for name in ("keys", "more_keys")]
        payloads = [arena.get("payloads", self.most_room, torch.int32, spare=1), entries]
        self._keys, self._payloads = keys, payloads
        self.keys, self.payloads = keys[0], payloads[0]
        last = self._passes % 2
        self.tile_keys, self.entries = keys[last], payloads[last]
        self.ends = arena.get("ends", count, torch.int32)
        self._scratch()

    def _scratch(self) -> None:
        """Lay out the scratch memory that is cleared at the start of an iteration."""
        pieces = pieces_of(self._count)
        ends = {"tickets": TICKETS, "depth_digits": MOST_PASSES * DIGITS, "tile_digits": MOST_PASSES * DIGITS}
        ends |= {"ranges": 4 * (self._tiles + 1), "running": -(-pieces // 4) * 4}
        ends |= {"depth_words": len(passes_of(DEPTH_BITS)) * pieces * DIGITS}
        at, self._parts = 0, {}
        for name, words in ends.items():
            self._parts[name] = at
            at += words
        self._parts["tile_words"] = at  # last, since its size depends on the room
        most = at + self._passes * pieces_of(self.most_room) * DIGITS
        self._words = self._arena.get("scratch", most, torch.int32)

    def part(self, name: str, words: int = 0) -> int:
        """Return the address of a part of the scratch memory, plus ``words`` times 4 bytes."""
        return self._words.data_ptr() + 4 * (self._parts[name] + words)

    def clear(self) -> Work:
        """Clear the scratch memory."""
        self._clearing = work_of("clear_words", 1, threads=SORT_THREADS, words=self.part("tickets"))
        return self._clearing

    def _sort(
        self, name: str, width: int, bits: int, keys: list[Tensor], payloads: list[Tensor], tickets: int
    ) -> list[Work]:
        """Return the launches of a sort by the lowest ``bits`` bits, which alternate between two buffers."""
        plan, digits = passes_of(bits), f"{name}_digits"
        counting = {"passes": len(plan), "keys": keys[0], "digits": self.part(digits)}
        works = [work_of(f"count_digits_{width}", 1, counting, threads=SORT_THREADS)]
        for number, (shift, of_digit) in enumerate(plan):
            source, target = number % 2, (number + 1) % 2
            buffers = {"keys": keys[source], "payloads": payloads[source]}
            buffers |= {"sorted_keys": keys[target], "sorted_payloads": payloads[target]}
            scratch = {"digits": self.part(digits, number * DIGITS), "ticket": self.part("tickets", tickets + number)}
            digit = {"shift": shift, "bits": of_digit}
            works.append(work_of(f"sort_pass_{width}", 1, buffers, scratch, digit, threads=SORT_THREADS))
        return works

    def _set_count(self, name: str, works: list[Work], count: int) -> None:
        """Write the number of keys into the launches of a sort."""
        first, *passes = works
        first.arguments.count, first.blocks = count, digit_blocks(count)
        for number, work in enumerate(passes):
            work.arguments.count, work.blocks = count, pieces_of(count)
            work.arguments.words = self.part(f"{name}_words", number * pieces_of(count) * DIGITS)

    def by_depth(self, depth_keys: Tensor) -> list[Work]:
        """Sort splats by depth; the first pass numbers them, and the last one does not write the keys."""
        n, arena = self._count, self._arena
        keys = [depth_keys, arena.get("more_depth_keys", n, torch.int32)]
        orders = [arena.get("order", n, torch.int32), arena.get("more_order", n, torch.int32)]
        works = self._sort("depth", 32, DEPTH_BITS, keys, orders, 0)
        works[1].arguments.payloads = works[-1].arguments.sorted_keys = None
        self._set_count("depth", works, n)
        self.order = orders[len(passes_of(DEPTH_BITS)) % 2]
        return works

    def running(self, tile_counts: Tensor, overflow: Tensor) -> Work:
        """Compute the running sums of pairs in depth order, their total, and whether it exceeds the room."""
        inputs = {"order": self.order, "tile_counts": tile_counts, "ends": self.ends, "overflow": overflow}
        scratch = {"ticket": self.part("tickets", 2 * MOST_PASSES), "words": self.part("running")}
        blocks = pieces_of(self._count)
        self._running = work_of("running_counts", blocks, inputs, scratch, threads=SORT_THREADS, count=self._count)
        return self._running

    def by_tile(self) -> list[Work]:
        """Sort pairs by tile."""
        bits = self._tiles.bit_length()  # keys 0 .. tiles; the last one marks unused pairs
        self._by_tile = self._sort("tile", self.bits, bits, self._keys, self._payloads, MOST_PASSES)
        return self._by_tile

    def set(self, room: int, pairs: Tensor) -> None:
        """Write the room for pairs and the address of their count."""
        words = self._parts["tile_words"] + self._passes * pieces_of(room) * DIGITS
        self._clearing.arguments.count, self._clearing.blocks = words // 4, clear_blocks(words // 4)
        fill(self._running.arguments, room=room, pairs=pairs)
        self._set_count("tile", self._by_tile, room)


class _Losses:
    """The launches of the losses, which compute gradients of images but no values.

    ``images`` are the blended images, "maps" for the SSIM, and the gradient "g_color". ``upstream`` are the gradients
    of the images besides colour, by name of the image: "alpha", "normal" and a depth.
    """

    def __init__(self, step: WholeStep, images: Mapping[str, Tensor], upstream: Mapping[str, Tensor]) -> None:
        height, width, channels = step.photograph.shape
        kind, blocks, size = (
            "rgb" if channels == 3 else "rgba",
            strips(height, width),
            {"height": height, "width": width},
        )
        compared = {"rendered": images["color"], "maps": images["maps"]}
        first = work_of(f"photometric_forward_{kind}", blocks, size, compared)
        second = work_of(f"photometric_vjp_{kind}", blocks, size, compared, gradient=images["g_color"])
        self._comparing = first.arguments, second.arguments
        for one in self._comparing:
            one.photograph.background[:] = step.background
        self.works = [first, second]
        self._normals = self._smooth = self._silhouette = None
        options = step.losses.normals
        if options is not None and "normal" in upstream:
            depth = f"depth_{options.depth}"
            named = {"normal": images["normal"], "depth": images[depth], "alpha": images["alpha"]}
            named |= {"g_normal": upstream["normal"], "g_depth": upstream[depth]}
            if options.of_object and channels == 3:
                named["weights"] = images["alpha"]
            tiles = -(-width // NORMAL_W) * -(-height // NORMAL_H)
            at_camera = int(options.at_camera)
            self._normals = self._add("normal_consistency_vjp", tiles, named, size, at_camera=at_camera)
        if step.losses.smooth_normals and "normal" in upstream:
            named = {"normal": images["normal"], "alpha": images["alpha"], "g_normal": upstream["normal"]}
            blocks = -(-height * width // MEAN_PIXELS)
            self._smooth = self._add("normal_smoothness", blocks, named, size, adds=1)  # to those of normal consistency
        if "alpha" in upstream:
            named, pixels = {"alpha": images["alpha"], "g_alpha": upstream["alpha"]}, height * width
            self._silhouette = self._add("silhouette_vjp", blocks_of(pixels), named, pixels=pixels)

    def _add(self, kernel: str, blocks: int, *named: Mapping[str, Any], **fields: Any) -> ctypes.Structure:
        """Append a launch and return its arguments."""
        self.works.append(work_of(kernel, blocks, *named, **fields))
        return self.works[-1].arguments

    def set(self, step: WholeStep, view: ctypes.Structure) -> None:
        """Write photograph, mask and weights. Scales are products in float32, as in autograd."""
        mask, photograph = None if step.mask is None else step.mask.data_ptr(), step.photograph.data_ptr()
        for arguments in self._comparing:
            arguments.mask, arguments.photograph.bytes = mask, photograph
        one, second = np.float32(1 / max(3 * step.valid, 1)), self._comparing[1]
        second.l1_scale = np.float32(step.losses.l1) * one
        second.ssim_scale = -np.float32(step.losses.ssim) * one
        second.l2_scale = np.float32(step.losses.l2) * one
        if self._normals is not None:
            normals, options = self._normals, step.losses.normals
            assert options is not None
            of_object = photograph if options.of_object and step.photograph.shape[2] == 4 else None
            fill(normals, mask=mask, object=of_object, flatness=step.flatness, flat_more=np.float32(options.flat - 1))
            fill(normals, **{name: getattr(view.camera, name) for name in ("fx", "fy", "cx", "cy")})
            normals.rotation = view.camera.R
            normals.scale = np.float32(options.weight) * np.float32(1 / max(step.valid, 1))
        if self._smooth is not None:
            assert step.flatness is not None
            scale = np.float32(step.losses.smooth_normals) * np.float32(1 / max(step.valid, 1))
            fill(self._smooth, mask=mask, flatness=step.flatness, scale=scale)
        if self._silhouette is not None:
            scale = np.float32(step.losses.silhouette or 0.0) / np.float32(max(step.valid, 1))
            fill(self._silhouette, mask=mask, object=photograph, scale=scale)


class _Plan:
    """The launches of an iteration in order, in two parts: up to the count of pairs, and after it."""

    def __init__(self, arena: Arena, step: WholeStep, view: ctypes.Structure, room: int) -> None:
        splats, count, tiles = dict(step.splats.items()), len(step.splats), int(view.tiles_x) * int(view.tiles_y)
        self.overflow = arena.get("overflow", 1, torch.int32)[:1].view(())
        self._sorting = sorting = _Sorting(arena, count, tiles, room)
        projected = {name: arena.get(name, n * count, dtype) for name, (n, dtype) in PROJECTED.items()}
        by_depth = sorting.by_depth(projected["depth_keys"])
        running = sorting.running(projected["tile_counts"], self.overflow)
        self.until_counted = [sorting.clear(), project(splats, projected), *by_depth, running]

        pointers = {name: projected[name] for name in ("cull", "records", "rects")}
        pointers |= {name: getattr(sorting, name) for name in ("order", "ends", "keys", "payloads")}
        ranges, heavy_first = sorting.part("ranges"), arena.get("tiles", tiles, torch.int32)
        self._of_room = [
            work_of(f"emit_sorted_{sorting.bits}", 1, pointers, visible=count, exact=1),
            work_of(f"find_ranges_{sorting.bits}", 1, keys=sorting.tile_keys, ranges=ranges),
        ]
        seen = arena.get("seen", 8 * ((sorting.most_room >> 5) + tiles + 1), torch.int32)
        lists: dict[str, Tensor | int | None] = {
            "records": projected["records"],
            "entries": sorting.entries,
            "ranges": ranges,
        }
        lists |= {"tiles": heavy_first, "seen": seen}
        words = piece_words(sorting.most_room)
        pieces = piece_buffers(arena.get("pieces", words, spare=1), words)
        images, upstream = _images(arena, step)
        drawn = {name: images[name] for name in ("color", "alpha", "normal", "depth_mean", "depth_median", "final_T")}
        self._losses = _Losses(step, images, upstream)
        self.afterwards = [
            self._of_room[0],
            *sorting.by_tile(),
            self._of_room[1],
            order_tiles(tiles, {"ranges": ranges, "order": heavy_first}, pieces),
            *blend(tiles, lists, drawn, pieces, distortion=False),
            *self._losses.works,
        ]

        sums: dict[str, Tensor | int | None] = {"learns": step.rows}
        sums["extras"] = arena.get("extras", 4 * count, zeros=True)
        if not _only_colors(step):
            sums["gradients"] = arena.get("gradient_rows", 16 * count, zeros=True)
        to_images = {"color": images["g_color"], **upstream}
        gradients = {name: arena.get(f"g_{name}", splats[name].numel()) for name in step.learned}
        blended = blend_gradients(tiles, lists, drawn, to_images, sums, pieces, absolute="absolute" in step.gathered)
        last = splat_gradients(splats, sums | {"tile_counts": projected["tile_counts"]}, gradients, clears=True)
        if step.gathered and not _only_colors(step):
            names = {"signed_norms": "signed", "absolute_norms": "absolute", "counts": "count"}
            gathered = last.arguments.gathered
            fill(gathered, **{field: step.gathered.get(name) for field, name in names.items()})
            fill(gathered, radii=projected["radii"], skip=self.overflow)
        beta1, beta2, eps = step.betas
        self._learned = [name for name, tensor in splats.items() if name in step.learned and tensor.numel() > 0]
        updates = [
            AdamUpdate(splats[name], gradient=gradients[name], **step.learned[name]._asdict()) for name in self._learned
        ]
        self._adam = adam_work(updates, beta1=beta1, beta2=beta2, eps=eps, skip=self.overflow)
        self.afterwards += [blended, last, self._adam]
        self._view_works = [work for work in (*self.until_counted, *self.afterwards) if takes_view(work)]

    @property
    def most_room(self) -> int:
        """Pairs that fit into the allocated memory."""
        return self._sorting.most_room

    def set(self, step: WholeStep, view: ctypes.Structure, room: int, pairs: Tensor) -> None:
        """Write what differs between iterations: camera, photograph, room, address of the count, and rates."""
        set_view(self._view_works, view)
        for work in self._of_room:
            work.arguments.candidates, work.blocks = room, blocks_of(room)
        self._sorting.set(room, pairs)
        self._losses.set(step, view)
        beta1, beta2, _ = step.betas
        for slot, name in zip(self._adam.arguments.attributes, self._learned, strict=False):
            one = step.learned[name]
            slot.step_size, slot.root_2 = bias_corrections(one.rate, one.step, beta1, beta2)


def _only_colors(step: WholeStep) -> bool:
    """Whether only colours are trained."""
    return not set(step.learned) - {"sh0", "shN"}


def _images(arena: Arena, step: WholeStep) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the images and other pixel buffers, and the gradients of images besides colour, by name."""
    pixels = step.camera.height * step.camera.width
    planes = {"color": 3, "alpha": 1, "normal": 3, "depth_mean": 1, "depth_median": 1, "final_T": 1}
    planes |= {"maps": 9, "g_color": 3}
    images = {name: arena.get(name, n * pixels) for name, n in planes.items()}
    upstream = {}
    normals = step.losses.normals
    if normals is not None and not _only_colors(step):
        upstream = {"normal": arena.get("g_normal", 3 * pixels)}
        upstream[f"depth_{normals.depth}"] = arena.get("g_depth", pixels)
    if step.losses.silhouette is not None and not _only_colors(step):
        upstream["alpha"] = arena.get("g_alpha", pixels)
    return images, upstream
