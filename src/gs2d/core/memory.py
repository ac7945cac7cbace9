"""Freed memory: returned to the operating system between phases, retained by the C library within them.

The C library keeps freed memory for later requests. Fragmentation while images are decoded and separate heaps of
threads can multiply the memory use: 93 MB of images took 549 MB.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache
from typing import Any

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h
MAPPED_BYTES = 32 << 20  # larger blocks are mapped separately; the maximum of glibc
HELD_BYTES = 256 << 20  # free memory kept at the end of the heap; more than an iteration with 300,000 splats frees


@cache
def _function(name: str) -> Callable[..., Any] | None:
    """Return a function of glibc; None with another C library."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):
        return None


@cache
def hold() -> None:
    """Let the C library keep the memory that an iteration frees for the next one; ``trim`` still returns it.

    By default glibc returns the end of its heap when more than twice the largest block is free there. Then every
    iteration gets new, zeroed pages, which took a sixth of its time at 181,000 splats. Without effect with other C
    libraries, and if the user configures malloc (MALLOC_...).
    """
    if any(name.startswith("MALLOC_") for name in os.environ) or "glibc.malloc" in os.environ.get("GLIBC_TUNABLES", ""):
        return
    call = _function("mallopt")
    if call is not None and call(M_MMAP_THRESHOLD, MAPPED_BYTES):
        call(M_TRIM_THRESHOLD, HELD_BYTES)


def trim() -> None:
    """Return the free pages of the C library to the operating system, if it is glibc."""
    call = _function("malloc_trim")
    if call is not None:
        call(0)
