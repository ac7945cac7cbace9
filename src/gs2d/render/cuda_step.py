"""A whole iteration on a GPU: projection, sorts, blending, losses, gradients, statistics and Adam by our kernels alone.

No autograd, no operation of torch, no memory asked for once it runs: what a rendering needs lies in an
:class:`Arena`, the arguments of every kernel stay filled, and from one iteration to the next only the camera, the
photograph, the room for pairs and the learning rates are written. So the launches are always the same ones, which a
launcher may start as a graph. The arithmetic is that of :mod:`gs2d.render.cuda_passes` and the losses of
:mod:`gs2d.kernels.cuda.losses`, kernel by kernel; without gradients that are added up by atomics the bits are too.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gs2d.core.splats import ATTRIBUTES
from gs2d.kernels.adam import bias_corrections_of
from gs2d.kernels.cuda import arguments as structures
from gs2d.kernels.cuda.launch import Launcher, Work
from gs2d.kernels.cuda.losses import NORMAL_H, NORMAL_W, strips
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
from gs2d.render.cuda_passes import CAMERA_BYTES, MAX_SPLATS, ORDER_THREADS, THREADS, view_of
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


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


class _Plan:
    """The launches of an iteration in their order, in two parts: until the number of pairs is known, and afterwards."""

    def __init__(self, arena: Arena, step: WholeStep, view: structures.View, room: int) -> None:
        self._arena, self._step = arena, step
        self._height, self._width, self._count = int(view.height), int(view.width), len(step.splats)
        self._tiles = int(view.tiles_x) * int(view.tiles_y)
        self._wide = 16 if self._tiles < 1 << 15 else 32
        self._passes = passes_of(self._tiles.bit_length())  # of tiles 0 .. tiles, the last of which is none
        self._with_view: list[ctypes.Structure] = []  # those that hold a View
        self._of_room: list[Callable[[int], None]] = []
        self.overflow = arena.get("overflow", 1, torch.int32)[:1].view(())
        self._only_colors = not set(step.learned) - {"sh0", "shN"}
        self._pairs(room)
        self._images()
        self._sums()
        self._scratch()
        self.until_known = [self._clear(), self._project(), *self._by_depth(), self._running()]
        self.afterwards = [self._emit(), *self._by_tile(), self._ranges(), self._order(), self._blend()]
        self.afterwards += [*self._losses(), *self._gradients(), self._adam()]

    # -- memory ------------------------------------------------------------------------------------------------------
    def _pairs(self, room: int) -> None:
        """Of splats and tiles: with some to spare, because the next view has more."""
        arena, key = self._arena, torch.int16 if self._wide == 16 else torch.int32
        entries = arena.get("entries", room, torch.int32)
        self.most_room = len(entries)
        self._buffers = {
            "keys": arena.get(f"keys_{self._wide}", self.most_room, key, spare=1),
            "more_keys": arena.get(f"more_keys_{self._wide}", self.most_room, key, spare=1),
            "payloads": arena.get("payloads", self.most_room, torch.int32, spare=1),
            "entries": entries,
            "seen": arena.get("seen", 8 * ((self.most_room >> 5) + self._tiles + 1), torch.int32),
        }

    def _images(self) -> None:
        pixels = self._height * self._width
        planes = {"color": 3, "alpha": 1, "normal": 3, "depth_mean": 1, "depth_median": 1, "final_T": 1}
        planes |= {"maps": 9, "g_color": 3}
        if self._has_normals:
            planes |= {"g_normal": 3, "g_depth": 1}
        if self._has_silhouette:
            planes |= {"g_alpha": 1}
        self._pixels = {name: self._arena.get(name, n * pixels) for name, n in planes.items()}

    @property
    def _has_normals(self) -> bool:
        return self._step.losses.normals is not None and not self._only_colors

    @property
    def _has_silhouette(self) -> bool:
        return self._step.losses.silhouette is not None and not self._only_colors

    def _sums(self) -> None:
        """Of gradients: rows of the splats, which the last reader clears."""
        self._gradient_rows = self._arena.get("gradient_rows", 16 * self._count, zeros=True)
        self._extras = self._arena.get("extras", 4 * self._count, zeros=True)

    def _scratch(self) -> None:
        """Lay out what is cleared when an iteration begins: one piece of memory, and where its parts begin."""
        tiles, pieces = self._tiles, pieces_of(self._count)
        ends = {"tickets": TICKETS, "depth_digits": MOST_PASSES * DIGITS, "tile_digits": MOST_PASSES * DIGITS}
        ends |= {"ranges": 4 * (tiles + 1), "running": -(-pieces // 4) * 4}
        ends |= {"depth_words": len(passes_of(DEPTH_BITS)) * pieces * DIGITS}
        at, self._parts = 0, {}
        for name, words in ends.items():
            self._parts[name] = at
            at += words
        self._parts["tile_words"] = at  # last: how many follows the room
        most = at + len(self._passes) * pieces_of(self.most_room) * DIGITS
        self._scratch_words = self._arena.get("scratch", most, torch.int32)

    def _part(self, name: str, words: int = 0) -> int:
        """Return the address of a part of the scratch memory, so many times 4 bytes on."""
        return self._scratch_words.data_ptr() + 4 * (self._parts[name] + words)

    # -- launches ----------------------------------------------------------------------------------------------------
    def _splat_blocks(self) -> int:
        return -(-self._count // THREADS)

    def _clear(self) -> Work:
        arguments = structures.ClearArguments(words=self._scratch_words.data_ptr())
        work = Work("clear_words", 1, SORT_THREADS, arguments)

        def of_room(room: int) -> None:
            words = self._parts["tile_words"] + len(self._passes) * pieces_of(room) * DIGITS
            arguments.count, work.blocks = words // 4, clear_blocks(words // 4)

        self._of_room.append(of_room)
        return work

    def _project(self) -> Work:
        n, arena = self._count, self._arena
        splats = self._step.splats
        arguments = structures.ProjectArguments(count=n, sh_rest=splats.shN.shape[1], errors=0, exact=1)
        structures.fill(arguments, **dict(splats.items()))
        self._projected = {
            "records": arena.get("records", 16 * n),
            "cull": arena.get("cull", 8 * n),
            "rects": arena.get("rects", 4 * n, torch.int16),
            "depth_keys": arena.get("depth_keys", n, torch.int32),
            "tile_counts": arena.get("tile_counts", n, torch.int32),
            "radii": arena.get("radii", n),
        }
        structures.fill(arguments, **self._projected)
        self._with_view.append(arguments)
        return Work("project_splats", self._splat_blocks(), THREADS, arguments)

    def _by_depth(self) -> list[Work]:
        """Splats by depth; keys go back and forth between two places, and the last pass leaves them out."""
        n, arena = self._count, self._arena
        keys = [arena.get("depth_keys", n, torch.int32), arena.get("more_depth_keys", n, torch.int32)]
        orders = [arena.get("order", n, torch.int32), arena.get("more_order", n, torch.int32)]
        counting = structures.DigitArguments(
            keys=keys[0].data_ptr(), count=n, passes=MOST_PASSES, digits=self._part("depth_digits")
        )
        works, plan = [Work("count_digits_32", digit_blocks(n), SORT_THREADS, counting)], passes_of(DEPTH_BITS)
        for number, (shift, bits) in enumerate(plan):
            source, target = number % 2, (number + 1) % 2
            arguments = structures.SortArguments(
                keys=keys[source].data_ptr(),
                payloads=None if number == 0 else orders[source].data_ptr(),
                sorted_keys=None if number == len(plan) - 1 else keys[target].data_ptr(),
                sorted_payloads=orders[target].data_ptr(),
                count=n,
                shift=shift,
                bits=bits,
                digits=self._part("depth_digits", number * DIGITS),
                ticket=self._part("tickets", number),
                words=self._part("depth_words", number * pieces_of(n) * DIGITS),
            )
            works.append(Work("sort_pass_32", pieces_of(n), SORT_THREADS, arguments))
        self._sorted = orders[len(plan) % 2]
        return works

    def _running(self) -> Work:
        n = self._count
        self._ends = self._arena.get("ends", n, torch.int32)
        self._counting = structures.RunningArguments(
            order=self._sorted.data_ptr(),
            tile_counts=self._projected["tile_counts"].data_ptr(),
            count=n,
            ends=self._ends.data_ptr(),
            ticket=self._part("tickets", 2 * MOST_PASSES),
            words=self._part("running"),
            overflow=self.overflow.data_ptr(),
        )
        return Work("running_counts", pieces_of(n), SORT_THREADS, self._counting)

    def _emit(self) -> Work:
        arguments = structures.EmitArguments(visible=self._count, exact=1)
        structures.fill(arguments, order=self._sorted, ends=self._ends)
        structures.fill(arguments, **{name: self._projected[name] for name in ("cull", "records", "rects")})
        structures.fill(arguments, keys=self._buffers["keys"], payloads=self._buffers["payloads"])
        arguments.width, arguments.height = self._width, self._height
        arguments.tiles_x, arguments.tiles_y = -(-self._width // 16), -(-self._height // 16)
        self._emitting = arguments
        work = Work(f"emit_sorted_{self._wide}", 1, THREADS, arguments)

        def of_room(room: int) -> None:
            arguments.candidates, work.blocks = room, -(-room // THREADS)

        self._of_room.append(of_room)
        return work

    def _by_tile(self) -> list[Work]:
        buffers = self._buffers
        keys, payloads = [buffers["keys"], buffers["more_keys"]], [buffers["payloads"], buffers["entries"]]
        counting = structures.DigitArguments(passes=len(self._passes), digits=self._part("tile_digits"))
        structures.fill(counting, keys=keys[0])
        works = [Work(f"count_digits_{self._wide}", 1, SORT_THREADS, counting)]
        passes = []
        for number, (shift, bits) in enumerate(self._passes):
            arguments = structures.SortArguments(shift=shift, bits=bits)
            structures.fill(arguments, keys=keys[number % 2], payloads=payloads[number % 2])
            structures.fill(arguments, sorted_keys=keys[(number + 1) % 2], sorted_payloads=payloads[(number + 1) % 2])
            arguments.digits = self._part("tile_digits", number * DIGITS)
            arguments.ticket = self._part("tickets", MOST_PASSES + number)
            passes.append(arguments)
            works.append(Work(f"sort_pass_{self._wide}", 1, SORT_THREADS, arguments))
        self._tile_keys, self._entries = keys[len(passes) % 2], payloads[len(passes) % 2]

        def of_room(room: int) -> None:
            counting.count, works[0].blocks = room, digit_blocks(room)
            for number, arguments in enumerate(passes):
                arguments.count, works[1 + number].blocks = room, pieces_of(room)
                arguments.words = self._part("tile_words", number * pieces_of(room) * DIGITS)

        self._of_room.append(of_room)
        return works

    def _ranges(self) -> Work:
        arguments = structures.RangeArguments(ranges=self._part("ranges"))
        structures.fill(arguments, keys=self._tile_keys)
        work = Work(f"find_ranges_{self._wide}", 1, THREADS, arguments)

        def of_room(room: int) -> None:
            arguments.candidates, work.blocks = room, -(-room // THREADS)

        self._of_room.append(of_room)
        return work

    def _order(self) -> Work:
        self._order_of_tiles = self._arena.get("tiles", self._tiles, torch.int32)
        arguments = structures.OrderArguments(tiles=self._tiles, ranges=self._part("ranges"))
        structures.fill(arguments, order=self._order_of_tiles)
        return Work("order_tiles", 1, ORDER_THREADS, arguments)

    def _fill_lists(self, arguments: ctypes.Structure) -> None:
        structures.fill(arguments, records=self._projected["records"], entries=self._entries)
        structures.fill(arguments, tiles=self._order_of_tiles, seen=self._buffers["seen"])
        arguments.ranges = self._part("ranges")

    def _blend(self) -> Work:
        arguments = structures.BlendArguments()
        self._fill_lists(arguments)
        outputs = ("color", "alpha", "normal", "depth_mean", "depth_median", "final_T")
        structures.fill(arguments, **{name: self._pixels[name] for name in outputs})
        self._with_view.append(arguments)
        return Work("blend_forward", self._tiles, THREADS, arguments)

    def _losses(self) -> list[Work]:
        """L1, SSIM and L2, whose values nobody asks for, and the gradients of all losses."""
        channels, blocks = self._step.photograph.shape[2], strips(self._height, self._width)
        kind = "rgb" if channels == 3 else "rgba"
        first = structures.PhotometricArguments(self._height, self._width)
        structures.fill(first, rendered=self._pixels["color"], maps=self._pixels["maps"])
        second = structures.PhotometricVjpArguments(self._height, self._width)
        structures.fill(second, rendered=self._pixels["color"], maps=self._pixels["maps"])
        structures.fill(second, gradient=self._pixels["g_color"])
        self._comparing = first, second
        for one in self._comparing:
            one.photograph.background[:] = self._step.background
        works = [
            Work(f"photometric_forward_{kind}", blocks, THREADS, first),
            Work(f"photometric_vjp_{kind}", blocks, THREADS, second),
        ]
        self._normals: structures.NormalArguments | None = None
        wanted = self._step.losses.normals
        if wanted is not None and not self._only_colors:
            normals = structures.NormalArguments(
                height=self._height, width=self._width, per_splat=0, at_camera=int(wanted.at_camera)
            )
            depth = self._pixels[f"depth_{wanted.depth}"]
            structures.fill(normals, normal=self._pixels["normal"], depth=depth, alpha=self._pixels["alpha"])
            structures.fill(normals, g_normal=self._pixels["g_normal"], g_depth=self._pixels["g_depth"])
            if wanted.of_object and channels == 3:
                structures.fill(normals, weights=self._pixels["alpha"])
            tiles = -(-self._width // NORMAL_W) * -(-self._height // NORMAL_H)
            works.append(Work("normal_consistency_vjp", tiles, THREADS, normals))
            self._normals = normals
        self._silhouette: structures.SilhouetteArguments | None = None
        if self._has_silhouette:
            silhouette = structures.SilhouetteArguments(pixels=self._height * self._width)
            structures.fill(silhouette, alpha=self._pixels["alpha"], g_alpha=self._pixels["g_alpha"])
            works.append(Work("silhouette_vjp", -(-silhouette.pixels // THREADS), THREADS, silhouette))
            self._silhouette = silhouette
        return works

    def _gradients(self) -> list[Work]:
        """Of the blending, by atomics, and of the parameters; with the densification signal."""
        step, n = self._step, self._count
        self._of_parameters = {
            name: self._arena.get(f"g_{name}", getattr(step.splats, name).numel()) for name in step.learned
        }
        if self._only_colors:
            return self._color_gradients()
        blend = structures.BlendVjpArguments()
        self._fill_lists(blend)
        images = ("color", "alpha", "normal", "depth_mean", "final_T")
        structures.fill(blend, **{name: self._pixels[name] for name in images}, g_color=self._pixels["g_color"])
        if step.losses.normals is not None:
            structures.fill(blend, g_normal=self._pixels["g_normal"])
            structures.fill(blend, **{f"g_depth_{step.losses.normals.depth}": self._pixels["g_depth"]})
        if self._has_silhouette:
            structures.fill(blend, g_alpha=self._pixels["g_alpha"])
        structures.fill(blend, gradients=self._gradient_rows, extras=self._extras, learns=step.rows)
        project = structures.ProjectVjpArguments(count=n, sh_rest=step.splats.shN.shape[1], clears=1)
        structures.fill(project, **dict(step.splats.items()))
        structures.fill(project, tile_counts=self._projected["tile_counts"], learns=step.rows)
        structures.fill(project, gradients=self._gradient_rows, extras=self._extras)
        structures.fill(project, **{f"g_{name}": tensor for name, tensor in self._of_parameters.items()})
        if step.gathered:
            names = {"signed_norms": "signed", "absolute_norms": "absolute", "counts": "count"}
            structures.fill(project.gathered, **{field: step.gathered.get(name) for field, name in names.items()})
            structures.fill(project.gathered, radii=self._projected["radii"], skip=self.overflow)
        self._with_view += [blend, project]
        kind = f"{'geometry' if self._has_normals else 'color'}{'_abs' if 'absolute' in step.gathered else ''}"
        return [
            Work(f"blend_vjp_{kind}", self._tiles, THREADS, blend),
            Work("project_splats_vjp", self._splat_blocks(), THREADS, project),
        ]

    def _color_gradients(self) -> list[Work]:
        step = self._step
        blend = structures.BlendColorsArguments()
        self._fill_lists(blend)
        structures.fill(blend, learns=step.rows, g_color=self._pixels["g_color"], gradients=self._extras)
        project = structures.ProjectColorsArguments(count=self._count, sh_rest=step.splats.shN.shape[1], clears=1)
        structures.fill(project, means=step.splats.means, sh0=step.splats.sh0, shN=step.splats.shN)
        structures.fill(project, tile_counts=self._projected["tile_counts"], learns=step.rows, gradients=self._extras)
        structures.fill(project, **{f"g_{name}": tensor for name, tensor in self._of_parameters.items()})
        self._with_view += [blend, project]
        return [
            Work("blend_vjp_learning", self._tiles, THREADS, blend),
            Work("project_colors_vjp", self._splat_blocks(), THREADS, project),
        ]

    def _adam(self) -> Work:
        beta1, beta2, eps = self._step.betas
        arguments = structures.AdamArguments(weight_1=1 - beta1, beta2=beta2, weight_2=1 - beta2, eps=eps)
        structures.fill(arguments, skip=self.overflow)
        blocks = 0
        self._adam_slots: dict[str, structures.AdamAttribute] = {}
        for name in ATTRIBUTES:
            one = self._step.learned.get(name)
            parameter = getattr(self._step.splats, name)
            if one is None or parameter.numel() == 0:
                continue
            slot = arguments.attributes[arguments.count]
            structures.fill(slot, parameter=parameter, mean=one.mean, square=one.square)
            structures.fill(slot, gradient=self._of_parameters[name], trained=one.trained)
            slot.elements, slot.first_block, slot.columns = parameter.numel(), blocks, math.prod(parameter.shape[1:])
            self._adam_slots[name] = slot
            arguments.count += 1
            blocks += -(-parameter.numel() // ADAM_ELEMENTS)
        return Work("adam_step", blocks, THREADS, arguments)

    # -- from one iteration to the next --------------------------------------------------------------------------------
    def set(self, step: WholeStep, view: structures.View, room: int, pairs: Tensor) -> None:
        """Write what differs: the camera, the photograph, the room, where the number of pairs goes, and the rates."""
        for arguments in self._with_view:
            arguments.view = view
        self._emitting.near = view.near
        self._counting.room, self._counting.pairs = room, pairs.data_ptr()
        for of_room in self._of_room:
            of_room(room)
        self._set_losses(step, view)
        beta1, beta2, _ = step.betas
        for name, slot in self._adam_slots.items():
            one = step.learned[name]
            slot.step_size, slot.root_2 = bias_corrections_of(one.rate, one.step, beta1, beta2)

    def _set_losses(self, step: WholeStep, view: structures.View) -> None:
        """Scales are products of float32 numbers, as where autograd multiplies them."""
        mask, photograph = _address(step.mask), step.photograph.data_ptr()
        for arguments in self._comparing:
            arguments.mask, arguments.photograph.bytes = mask, photograph
        one = np.float32(1 / max(3 * step.valid, 1))
        second = self._comparing[1]
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
