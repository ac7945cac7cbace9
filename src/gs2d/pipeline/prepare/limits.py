"""Limit CPU threads and memory of a command, and free memory between the phases of a run."""

from __future__ import annotations

import gc

import torch

from gs2d.core.memory import trim
from gs2d.core.memory_limit import CACHE_FRACTION, memory_limit, set_memory_budget
from gs2d.core.processes import available_cores
from gs2d.data import Scene
from gs2d.errors import DataError, RecipeError
from gs2d.kernels.library import available_variants, load

ITERATION_BYTES = 216  # of a pixel: images, gradients, losses, heap (docs/notebook/reliability.md)
CACHES = 2 * CACHE_FRACTION  # of the free memory: caches of photographs and of targets
DECODING_BYTES = 12  # of a pixel of a JPEG file while it is decoded
MAX_DOWNSCALE = 64
MAX_THREADS = 1024  # each has a stack; many more fail with misleading errors
LEAST_GIB = 0.5  # torch and the kernels need 0.4


def use_threads(threads: int | None, processes: int = 1) -> None:
    """Set the CPU threads of torch and of the kernels; ``processes`` of one machine share its cores."""
    if threads is not None:
        if not 1 <= threads <= MAX_THREADS:
            raise RecipeError(f"--threads must be a whole number from 1 to {MAX_THREADS}, got {threads}")
        torch.set_num_threads(threads)
    elif processes > 1:
        torch.set_num_threads(max(1, available_cores() // processes))


def use_memory(gib: float | None, processes: int = 1) -> None:
    """Limit memory to ``gib`` GiB; None: to half of this machine or container. ``processes`` of a machine share it."""
    if processes > 1:
        limit = memory_limit()
        total = gib if gib is not None else None if limit is None else limit.bytes / 2**30
        gib = None if total is None else total / processes
    if gib is not None and not LEAST_GIB <= gib < 1 << 20:
        raise RecipeError(f"--memory must be at least {LEAST_GIB:g} GiB, got {gib:g}")
    set_memory_budget(None if gib is None else int(gib * 2**30))


def check_memory(scene: Scene, downscale: int, *, on_host: bool) -> None:
    """Raise DataError if the photographs are too large to train on in the available memory.

    They are smaller than their files by ``downscale``. ``on_host``: the CPU trains; for other devices, this memory only
    decodes photographs.
    """
    fitting, need = least_downscale(scene, downscale, on_host=on_host)
    if fitting == downscale:
        return
    smaller = f"--downscale {fitting}" if fitting is not None else "smaller files of the photographs"
    raise DataError(f"{need}; use {smaller}, or raise the limit")


def least_downscale(scene: Scene, downscale: int, *, on_host: bool) -> tuple[int | None, str]:
    """Return the smallest downscale, from that of a scene on, at which training fits into memory.

    It is None if decoding does not fit at any. The text compares required and available memory.
    """
    limit = memory_limit()
    if limit is None:
        return downscale, ""
    pixels = max(view.camera.width * view.camera.height for view in (*scene.train, *scene.test))

    def need(factor: int) -> float:
        shrunk = pixels * (downscale / factor) ** 2
        return shrunk * ITERATION_BYTES * on_host + pixels * downscale**2 * DECODING_BYTES

    fits = need(downscale) <= limit.room
    factors = [downscale] if fits else range(downscale + 1, MAX_DOWNSCALE + 1)
    room = limit.room * (1 if fits else 1 - CACHES)  # if images shrink anyway, leave memory for the caches
    return next((f for f in factors if need(f) <= room), None), (
        f"photographs of up to {pixels / 1e6:.3g} megapixels need about {need(downscale) / 2**30:.2g} GiB to train on, "
        f"got {limit.room / 2**30:.2g} GiB available of {limit.bytes / 2**30:.2g} GiB ({limit.source})"
    )


def release(scene: Scene) -> None:
    """Free decoded images, reused buffers and garbage; images are decoded again when they are needed.

    A trainer and its listener refer to each other, so that targets and moments wait for the garbage collector.
    """
    scene.forget()
    release_buffers()


def release_buffers() -> None:
    """Free reused buffers and garbage."""
    gc.collect()
    if available_variants():
        load().pool.clear()
    trim()
