"""The arguments of the CUDA kernels, and launches with them."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from gs2d.kernels.c_structures import fill, source_of, structure
from gs2d.kernels.cuda.graph import Work

THREADS = 128  # per block of most kernels
KERNEL = re.compile(r"__global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\((\w+)")  # its name and its structure


def cuda_structure(name: str) -> type[ctypes.Structure]:
    """Return a structure of ``core/`` or ``cuda/``."""
    return structure(name, "cuda")


@cache
def _structures() -> dict[str, str]:
    """Return the structure that each kernel takes."""
    return dict(KERNEL.findall(source_of("cuda")))


def arguments_of(kernel: str, /, *named: Mapping[str, Any], **fields: Any) -> ctypes.Structure:
    """Return the arguments of a kernel with these fields; all others are 0 or null."""
    arguments = cuda_structure(_structures()[kernel])()
    for some in (*named, fields):
        fill(arguments, **some)
    return arguments


def work_of(kernel: str, blocks: int, /, *named: Mapping[str, Any], threads: int = THREADS, **fields: Any) -> Work:
    """Return a launch of a kernel with these fields in its arguments."""
    return Work(kernel, blocks, threads, arguments_of(kernel, *named, **fields))
