"""What a command takes of the machine: CPU threads, memory, and memory given back between the phases of a run."""

from __future__ import annotations

import gc
import os

import torch

from gs2d.core.memory import trim
from gs2d.core.memory_limit import CACHE_FRACTION, memory_limit, set_memory_budget
from gs2d.data import Scene
from gs2d.errors import DataError, RecipeError
from gs2d.kernels.library import available_variants, load

ITERATION_BYTES = 216  # of a pixel: images, gradients, losses, what the heap keeps (docs/notebook/reliability.md)
CACHES = 2 * CACHE_FRACTION  # of the room, that those of photographs and of targets take beside it
DECODING_BYTES = 12  # of a pixel of the file: what a JPEG is decoded through
MAX_DOWNSCALE = 64
MAX_THREADS = 1024  # each has a stack: far more of them end in errors that name anything but the cause
LEAST_GIB = 0.5  # torch and the kernels by themselves take 0.4


def use_threads(threads: int | None, processes: int = 1) -> None:
    """Set the CPU threads of torch and of the native kernels; several processes of a machine share its cores.

    Raises
    ------
    RecipeError
        Not a number from 1 to ``MAX_THREADS``.
    """
    if threads is not None:
        if not 1 <= threads <= MAX_THREADS:
            raise RecipeError(f"--threads must be a whole number from 1 to {MAX_THREADS}, got {threads}")
        torch.set_num_threads(threads)
    elif processes > 1:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        torch.set_num_threads(max(1, cores // processes))


def use_memory(gib: float | None) -> None:
    """Keep to so many GiB from now on; None: to half of what this machine or container has.

    Raises
    ------
    RecipeError
        Less than a command takes that does nothing.
    """
    if gib is not None and not LEAST_GIB <= gib < 1 << 20:
        raise RecipeError(f"--memory must be {LEAST_GIB:g} GiB or more, got {gib:g}")
    set_memory_budget(None if gib is None else int(gib * 2**30))


def check_memory(scene: Scene, downscale: int, *, on_host: bool) -> None:
    """Refuse to train on photographs that are too large for the memory that this process may have.

    Parameters
    ----------
    scene : Scene
    downscale : int
        By which its photographs were made smaller than their files.
    on_host : bool
        Whether training uses the CPU. For another device, photographs are only decoded in this memory.

    Raises
    ------
    DataError
        It cannot fit: the kernel would end the process without a word.
    """
    fitting, need = least_downscale(scene, downscale, on_host=on_host)
    if fitting == downscale:
        return
    smaller = f"--downscale {fitting}" if fitting is not None else "smaller files of the photographs"
    raise DataError(f"{need}; use {smaller}, or raise the limit")


def least_downscale(scene: Scene, downscale: int, *, on_host: bool) -> tuple[int | None, str]:
    """Return the downscale at which training fits into memory: the one that a scene has, or a larger one; and why.

    Returns
    -------
    (int or None, str)
        None: not even decoding fits. The words say what the given downscale would need and what there is.
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
    room = limit.room * (1 if fits else 1 - CACHES)  # what is shrunk anyway is to have its caches too
    return next((f for f in factors if need(f) <= room), None), (
        f"photographs of up to {pixels / 1e6:.3g} megapixels need about {need(downscale) / 2**30:.2g} GiB to train on, "
        f"got {limit.room / 2**30:.2g} GiB that this process may still have of {limit.bytes / 2**30:.2g} GiB "
        f"({limit.source})"
    )


def release(scene: Scene) -> None:
    """Drop decoded pictures, reused buffers and whatever waits for the garbage collector; nothing is lost by it.

    A trainer and its listener hold each other, so that targets and moments would stay until the collector happens by.
    Pictures are decoded again where somebody asks for one.
    """
    scene.forget()
    release_buffers()


def release_buffers() -> None:
    """Drop reused buffers and whatever waits for the garbage collector; decoded pictures stay."""
    gc.collect()
    if available_variants():
        load().pool.clear()
    trim()
