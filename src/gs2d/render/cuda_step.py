"""A whole iteration on a GPU: projection, sorts, blending, losses, gradients, statistics and Adam by our kernels alone.

No autograd, no operation of torch, no memory asked for once it runs: what a rendering needs lies in an
:class:`Arena`, the arguments of every kernel stay filled, and from one iteration to the next only the camera, the
photograph, the room for pairs and the learning rates are written. So the launches are always the same ones, which a
launcher may start as a graph. The arithmetic is that of :mod:`gs2d.render.cuda_passes` and the losses of
:mod:`gs2d.kernels.cuda.cuda_losses`, kernel by kernel; without gradients that are added up by atomics the bits are too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from gs2d.kernels.cuda import kernel_arguments as structures
from gs2d.kernels.cuda.cuda_losses import NORMAL_H, NORMAL_W, strips
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
from gs2d.kernels.native_adam import bias_corrections
from gs2d.render.cuda_passes import CAMERA_BYTES, MAX_SPLATS, PROJECTED, view_of
from gs2d.render.cuda_works import (
    THREADS,
    blend,
    blend_gradients,
    blocks_of,
    emit,
    find_ranges,
    order_tiles,
    project,
    see,
    splat_gradients,
    takes_view,
)
from gs2d.render.pair_budget import PairBudget, Rendering
from gs2d.render.whole_step import WholeStep

__all__ = ["Arena", "Stepper"]

SPARE = 1.2  # memory in what is needed, so that a few splats or pairs more find room
ADAM_ELEMENTS = 512  # of a block: adam.cu
DEPTH_BITS = 32
TICKETS = 16  # counters; the passes of both sorts and the running sums take one each
MOST_VIEWS = 1 << 12
MOST_PLANS = 8  # sizes of images whose arguments stay filled


class Arena:
    """Memory that is asked for once: flat tensors by name, which grow and are only let go all together.

    Attributes
    ----------
    generation : int
        Counts the times that something moved: addresses of before are no more.
    """

    def __init__(self, device: torch.device) -> None:
        self.generation = 0
        self._device = device
        self._held: dict[str, Tensor] = {}

    def get(
        self, name: str, count: int, dtype: torch.dtype = torch.float32, *, zeros: bool = False, spare: float = SPARE
    ) -> Tensor:
        """Return at least ``count`` elements, the same memory as before where that is enough, else ``spare`` times it.

        ``zeros``: they are 0 when they are new; whoever uses them leaves zeros.
        """
        held = self._held.get(name)
        if held is None or len(held) < count:
            make: Callable[..., Tensor] = torch.zeros if zeros else torch.empty
            held = self._held[name] = make(math.ceil(spare * count), dtype=dtype, device=self._device)
            self.generation += 1
        return held

    def release(self) -> None:
        """Let everything go."""
        if self._held:
            self._held.clear()
            self.generation += 1


class Stepper:
    """Does iterations of one training.

    Parameters
    ----------
    launcher : Launcher
    device : torch.device
    """

    def __init__(self, launcher: Launcher, device: torch.device) -> None:
        self._launcher, self._device = launcher, device
        self._arena = Arena(device)
        self._plans: dict[tuple[object, ...], _Plan] = {}
        self._generation = -1
        self._views: dict[tuple[int, int], tuple[object, object, structures.View, bytes]] = {}

    def release(self) -> None:
        """Let the memory go: another way of rendering is about to need as much."""
        self._plans.clear()
        self._arena.release()

    def run(self, step: WholeStep, budget: PairBudget) -> bool:
        """Do an iteration; False: it is not for here, and nothing was done.

        Where the room that the budget gives is too little, nothing that lasts is changed on the device, and
        ``budget.overflowed`` will say so.
        """
        count = len(step.splats)
        if not 0 < count < MAX_SPLATS or budget.overflow is not None or not _suits(step):
            return False
        view, camera = self._view_of(step)
        rendering = Rendering(int(view.tiles_x) * int(view.tiles_y), count, camera)
        room = budget.room(rendering)
        if room is None or room > MOST_SORTED:
            return False
        plan = self._plan_of(step, view, max(room, 1))
        budget.overflow = plan.overflow
        plan.set(step, view, max(room, 1), budget.expect(rendering, max(room, 1), self._device))
        self._launcher.run(plan.until_known)
        budget.asked(self._device)
        self._launcher.run(plan.afterwards)
        return True

    def _view_of(self, step: WholeStep) -> tuple[structures.View, bytes]:
        """Return the structure of a camera, and what it is known by; kept, because they come again."""
        key = id(step.camera), id(step.settings)
        known = self._views.get(key)
        if known is None:
            if len(self._views) >= MOST_VIEWS:
                self._views.clear()
            view = view_of(step.camera, step.settings)
            # the objects too, so that their numbers stay theirs
            known = self._views[key] = step.camera, step.settings, view, bytes(view)[:CAMERA_BYTES]
        return known[2], known[3]

    def _plan_of(self, step: WholeStep, view: structures.View, room: int) -> _Plan:
        """Return the launches of such an iteration, with everything filled that stays."""
        key = _key(step)
        plan = self._plans.get(key)
        if plan is not None and self._generation == self._arena.generation and room <= plan.most_room:
            return plan
        plan = _Plan(self._arena, step, view, room)
        if self._generation != self._arena.generation or len(self._plans) >= MOST_PLANS:
            self._plans.clear()  # their addresses are no more
        self._generation = self._arena.generation
        self._plans[key] = plan
        return plan


def _suits(step: WholeStep) -> bool:
    """Whether kernels can take the tensors as they lie."""
    tensors = [tensor for _, tensor in step.splats.items()]
    tensors += [tensor for one in step.learned.values() for tensor in (one.mean, one.square)]
    return all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in tensors)


def _key(step: WholeStep) -> tuple[object, ...]:
    """Return what arguments depend on, but for what :meth:`_Plan.set` writes."""
    splats, height, width = step.splats, step.camera.height, step.camera.width
    return (
        height,
        width,
        len(splats),
        step.photograph.shape[2],
        step.losses.silhouette is not None,
        None if step.losses.normals is None else step.losses.normals[1:],  # without the weight
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
    """The launches that sort splats by depth and pairs by tile, and the memory that is cleared for them.

    Parameters
    ----------
    arena : Arena
    count : int
        Splats.
    tiles : int
    room : int
        Pairs of splat and tile; with some to spare, because the next view has more.

    Attributes
    ----------
    most_room : int
        Pairs that there is memory for.
    bits : int
        Of the keys of tiles.
    order, ends, keys, payloads, tile_keys, entries : Tensor
        Splats by depth, the running sum of their pairs, what emission writes, and the same sorted.
    """

    def __init__(self, arena: Arena, count: int, tiles: int, room: int) -> None:
        self._arena, self._count, self._tiles = arena, count, tiles
        self.bits = 16 if tiles < 1 << 15 else 32
        self._passes = passes_of(tiles.bit_length())  # of tiles 0 .. tiles, the last of which is none
        key = torch.int16 if self.bits == 16 else torch.int32
        entries = arena.get("entries", room, torch.int32)
        self.most_room = len(entries)
        keys = [arena.get(f"{name}_{self.bits}", self.most_room, key, spare=1) for name in ("keys", "more_keys")]
        payloads = [arena.get("payloads", self.most_room, torch.int32, spare=1), entries]
        self._keys, self._payloads = keys, payloads
        self.keys, self.payloads = keys[0], payloads[0]
        last = len(self._passes) % 2
        self.tile_keys, self.entries = keys[last], payloads[last]
        self.ends = arena.get("ends", count, torch.int32)
        self._scratch()

    def _scratch(self) -> None:
        """Lay out what is cleared when an iteration begins: one piece of memory, and where its parts begin."""
        pieces = pieces_of(self._count)
        ends = {"tickets": TICKETS, "depth_digits": MOST_PASSES * DIGITS, "tile_digits": MOST_PASSES * DIGITS}
        ends |= {"ranges": 4 * (self._tiles + 1), "running": -(-pieces // 4) * 4}
        ends |= {"depth_words": len(passes_of(DEPTH_BITS)) * pieces * DIGITS}
        at, self._parts = 0, {}
        for name, words in ends.items():
            self._parts[name] = at
            at += words
        self._parts["tile_words"] = at  # last: how many follows the room
        most = at + len(self._passes) * pieces_of(self.most_room) * DIGITS
        self._words = self._arena.get("scratch", most, torch.int32)

    def part(self, name: str, words: int = 0) -> int:
        """Return the address of a part of the scratch memory, so many times 4 bytes on."""
        return self._words.data_ptr() + 4 * (self._parts[name] + words)

    def clear(self) -> Work:
        """Fill the scratch memory with zeros."""
        self._clearing = Work("clear_words", 1, SORT_THREADS, structures.ClearArguments(words=self.part("tickets")))
        return self._clearing

    def by_depth(self, depth_keys: Tensor) -> list[Work]:
        """Sort splats by depth; keys go back and forth between two places, and the last pass leaves them out."""
        n, arena = self._count, self._arena
        keys = [depth_keys, arena.get("more_depth_keys", n, torch.int32)]
        orders = [arena.get("order", n, torch.int32), arena.get("more_order", n, torch.int32)]
        counting = structures.DigitArguments(count=n, passes=MOST_PASSES, digits=self.part("depth_digits"))
        structures.fill(counting, keys=keys[0])
        works, plan = [Work("count_digits_32", digit_blocks(n), SORT_THREADS, counting)], passes_of(DEPTH_BITS)
        for number, (shift, bits) in enumerate(plan):
            source, target = number % 2, (number + 1) % 2
            arguments = structures.SortArguments(count=n, shift=shift, bits=bits)
            structures.fill(
                arguments,
                keys=keys[source],
                payloads=None if number == 0 else orders[source],
                sorted_keys=None if number == len(plan) - 1 else keys[target],
                sorted_payloads=orders[target],
                digits=self.part("depth_digits", number * DIGITS),
                ticket=self.part("tickets", number),
                words=self.part("depth_words", number * pieces_of(n) * DIGITS),
            )
            works.append(Work("sort_pass_32", pieces_of(n), SORT_THREADS, arguments))
        self.order = orders[len(plan) % 2]
        return works

    def running(self, tile_counts: Tensor, overflow: Tensor) -> Work:
        """Add up pairs by depth: running sums, their number, and whether there is room for them."""
        self._counting = structures.RunningArguments(count=self._count)
        structures.fill(self._counting, order=self.order, tile_counts=tile_counts, ends=self.ends, overflow=overflow)
        structures.fill(self._counting, ticket=self.part("tickets", 2 * MOST_PASSES), words=self.part("running"))
        return Work("running_counts", pieces_of(self._count), SORT_THREADS, self._counting)

    def by_tile(self) -> list[Work]:
        """Sort pairs by tile."""
        keys, payloads = self._keys, self._payloads
        counting = structures.DigitArguments(passes=len(self._passes), digits=self.part("tile_digits"))
        structures.fill(counting, keys=keys[0])
        self._by_tile = [Work(f"count_digits_{self.bits}", 1, SORT_THREADS, counting)]
        for number, (shift, bits) in enumerate(self._passes):
            source, target = number % 2, (number + 1) % 2
            arguments = structures.SortArguments(shift=shift, bits=bits)
            structures.fill(arguments, keys=keys[source], payloads=payloads[source])
            structures.fill(arguments, sorted_keys=keys[target], sorted_payloads=payloads[target])
            arguments.digits = self.part("tile_digits", number * DIGITS)
            arguments.ticket = self.part("tickets", MOST_PASSES + number)
            self._by_tile.append(Work(f"sort_pass_{self.bits}", 1, SORT_THREADS, arguments))
        return self._by_tile

    def set(self, room: int, pairs: Tensor) -> None:
        """Write the room for pairs, and where their number goes."""
        pieces = pieces_of(room)
        words = self._parts["tile_words"] + len(self._passes) * pieces * DIGITS
        self._clearing.arguments.count, self._clearing.blocks = words // 4, clear_blocks(words // 4)
        self._counting.room, self._counting.pairs = room, pairs.data_ptr()
        first, *passes = self._by_tile
        first.arguments.count, first.blocks = room, digit_blocks(room)
        for number, work in enumerate(passes):
            work.arguments.count, work.blocks = room, pieces
            work.arguments.words = self.part("tile_words", number * pieces * DIGITS)


class _Losses:
    """The launches of the losses: gradients of images; L1, SSIM and L2 without their values.

    Parameters
    ----------
    step : WholeStep
    images : mapping of str to Tensor
        What blending writes, "maps" for the SSIM, and places for gradients: "g_color" and those of ``upstream``.
    upstream : mapping of str to Tensor
        Gradients of the images besides colour, by name of the image: "alpha", "normal" and a depth.
    """

    def __init__(self, step: WholeStep, images: Mapping[str, Tensor], upstream: Mapping[str, Tensor]) -> None:
        height, width, channels = step.photograph.shape
        kind, blocks = "rgb" if channels == 3 else "rgba", strips(height, width)
        first = structures.PhotometricArguments(height, width)
        second = structures.PhotometricVjpArguments(height, width)
        for one in (first, second):
            structures.fill(one, rendered=images["color"], maps=images["maps"])
            one.photograph.background[:] = step.background
        structures.fill(second, gradient=images["g_color"])
        self._comparing = first, second
        self.works = [
            Work(f"photometric_forward_{kind}", blocks, THREADS, first),
            Work(f"photometric_vjp_{kind}", blocks, THREADS, second),
        ]
        self._normals: structures.NormalArguments | None = None
        wanted = step.losses.normals
        if wanted is not None and "normal" in upstream:
            depth = f"depth_{wanted.depth}"
            normals = structures.NormalArguments(height=height, width=width, at_camera=int(wanted.at_camera))
            structures.fill(normals, normal=images["normal"], depth=images[depth], alpha=images["alpha"])
            structures.fill(normals, g_normal=upstream["normal"], g_depth=upstream[depth])
            if wanted.of_object and channels == 3:
                structures.fill(normals, weights=images["alpha"])
            tiles = -(-width // NORMAL_W) * -(-height // NORMAL_H)
            self.works.append(Work("normal_consistency_vjp", tiles, THREADS, normals))
            self._normals = normals
        self._silhouette: structures.SilhouetteArguments | None = None
        if "alpha" in upstream:
            silhouette = structures.SilhouetteArguments(pixels=height * width)
            structures.fill(silhouette, alpha=images["alpha"], g_alpha=upstream["alpha"])
            self.works.append(Work("silhouette_vjp", blocks_of(height * width), THREADS, silhouette))
            self._silhouette = silhouette

    def set(self, step: WholeStep, view: structures.View) -> None:
        """Write photograph, mask and weights. Scales are products of float32 numbers, as of autograd."""
        mask, photograph = None if step.mask is None else step.mask.data_ptr(), step.photograph.data_ptr()
        for arguments in self._comparing:
            arguments.mask, arguments.photograph.bytes = mask, photograph
        one, second = np.float32(1 / max(3 * step.valid, 1)), self._comparing[1]
        second.l1_scale = np.float32(step.losses.l1) * one
        second.ssim_scale = -np.float32(step.losses.ssim) * one
        second.l2_scale = np.float32(step.losses.l2) * one
        if self._normals is not None:
            normals, wanted = self._normals, step.losses.normals
            assert wanted is not None
            normals.mask = mask
            normals.object = photograph if wanted.of_object and step.photograph.shape[2] == 4 else None
            normals.fx, normals.fy, normals.cx, normals.cy = view.fx, view.fy, view.cx, view.cy
            normals.rotation = view.R
            normals.scale = np.float32(wanted.weight) * np.float32(1 / max(step.valid, 1))
        if self._silhouette is not None:
            self._silhouette.mask, self._silhouette.object = mask, photograph
            self._silhouette.scale = np.float32(step.losses.silhouette or 0.0) / np.float32(max(step.valid, 1))


class _Adam:
    """The launch of Adam."""

    def __init__(self, step: WholeStep, gradients: Mapping[str, Tensor], overflow: Tensor) -> None:
        beta1, beta2, eps = step.betas
        arguments = structures.AdamArguments(weight_1=1 - beta1, beta2=beta2, weight_2=1 - beta2, eps=eps)
        structures.fill(arguments, skip=overflow)
        blocks = 0
        self._slots: dict[str, structures.AdamAttribute] = {}
        for name, parameter in step.splats.items():
            one = step.learned.get(name)
            if one is None or parameter.numel() == 0:
                continue
            slot = arguments.attributes[arguments.count]
            structures.fill(slot, parameter=parameter, mean=one.mean, square=one.square)
            structures.fill(slot, gradient=gradients[name], trained=one.trained)
            slot.elements, slot.first_block, slot.columns = parameter.numel(), blocks, math.prod(parameter.shape[1:])
            self._slots[name] = slot
            arguments.count += 1
            blocks += -(-parameter.numel() // ADAM_ELEMENTS)
        self.work = Work("adam_step", blocks, THREADS, arguments)

    def set(self, step: WholeStep) -> None:
        """Write the rates."""
        beta1, beta2, _ = step.betas
        for name, slot in self._slots.items():
            one = step.learned[name]
            slot.step_size, slot.root_2 = bias_corrections(one.rate, one.step, beta1, beta2)


class _Plan:
    """The launches of an iteration in their order, in two parts: until the number of pairs is known, and afterwards."""

    def __init__(self, arena: Arena, step: WholeStep, view: structures.View, room: int) -> None:
        splats, count, tiles = dict(step.splats.items()), len(step.splats), int(view.tiles_x) * int(view.tiles_y)
        self.overflow = arena.get("overflow", 1, torch.int32)[:1].view(())
        self._sorting = sorting = _Sorting(arena, count, tiles, room)
        projected = {name: arena.get(name, n * count, dtype) for name, (n, dtype) in PROJECTED.items()}
        by_depth = sorting.by_depth(projected["depth_keys"])
        running = sorting.running(projected["tile_counts"], self.overflow)
        self.until_known = [sorting.clear(), project(splats, projected), *by_depth, running]

        pointers = {name: projected[name] for name in ("cull", "records", "rects")}
        pointers |= {name: getattr(sorting, name) for name in ("order", "ends", "keys", "payloads")}
        ranges, heavy_first = sorting.part("ranges"), arena.get("tiles", tiles, torch.int32)
        self._of_room = [
            emit(f"emit_sorted_{sorting.bits}", room, count, pointers),
            find_ranges(sorting.bits, room, {"keys": sorting.tile_keys, "ranges": ranges}),
        ]
        seen = arena.get("seen", 8 * ((sorting.most_room >> 5) + tiles + 1), torch.int32)
        lists: dict[str, Tensor | int | None] = {
            "records": projected["records"],
            "entries": sorting.entries,
            "ranges": ranges,
        }
        lists |= {"tiles": heavy_first, "seen": seen}
        images, upstream = _images(arena, step)
        kept = {name: images[name] for name in ("color", "alpha", "normal", "depth_mean", "depth_median", "final_T")}
        self._losses = _Losses(step, images, upstream)
        self.afterwards = [
            self._of_room[0],
            *sorting.by_tile(),
            self._of_room[1],
            order_tiles(tiles, {"ranges": ranges, "order": heavy_first}),
            blend(tiles, lists, kept, distortion=False),
            *self._losses.works,
        ]

        sums: dict[str, Tensor | int | None] = {"learns": step.rows}
        sums["extras"] = arena.get("extras", 4 * count, zeros=True)
        if not _only_colors(step):
            sums["gradients"] = arena.get("gradient_rows", 16 * count, zeros=True)
        found = {"color": images["g_color"], **upstream}
        gradients = {name: arena.get(f"g_{name}", splats[name].numel()) for name in step.learned}
        blended = blend_gradients(tiles, lists, kept, found, sums, absolute="absolute" in step.gathered)
        last = splat_gradients(splats, sums | {"tile_counts": projected["tile_counts"]}, gradients, clears=True)
        if step.gathered and not _only_colors(step):
            names = {"signed_norms": "signed", "absolute_norms": "absolute", "counts": "count"}
            gathered = last.arguments.gathered
            structures.fill(gathered, **{field: step.gathered.get(name) for field, name in names.items()})
            structures.fill(gathered, radii=projected["radii"], skip=self.overflow)
        self._adam = _Adam(step, gradients, self.overflow)
        self.afterwards += [blended, last, self._adam.work]
        self._seeing = [work for work in (*self.until_known, *self.afterwards) if takes_view(work)]

    @property
    def most_room(self) -> int:
        """Pairs that there is memory for."""
        return self._sorting.most_room

    def set(self, step: WholeStep, view: structures.View, room: int, pairs: Tensor) -> None:
        """Write what differs: the camera, the photograph, the room, where the number of pairs goes, and the rates."""
        see(self._seeing, view)
        for work in self._of_room:
            work.arguments.candidates, work.blocks = room, blocks_of(room)
        self._sorting.set(room, pairs)
        self._losses.set(step, view)
        self._adam.set(step)


def _only_colors(step: WholeStep) -> bool:
    """Whether nothing but colours learns."""
    return not set(step.learned) - {"sh0", "shN"}


def _images(arena: Arena, step: WholeStep) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return images and what else lies by pixel, and the gradients of the images besides colour, by their names."""
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
