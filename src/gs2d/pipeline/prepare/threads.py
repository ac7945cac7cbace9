"""How many CPU threads a command uses."""

from __future__ import annotations

import os

import torch

from gs2d.errors import RecipeError

MAX_THREADS = 1024  # each has a stack: far more of them end in errors that name anything but the cause


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
