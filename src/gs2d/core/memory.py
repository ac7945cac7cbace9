"""Freed memory: returned to the operating system between phases, kept by the C library within them.

The C library keeps freed memory for later requests. Fragmentation while images are decoded and separate heaps of
threads can multiply the memory use: 93 MB of images took 549 MB.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache
from typing import Any

__all__ = ["hold", "trim"]

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h
MAPPED_BYTES = 32 << 20  # larger blocks are mapped separately; the maximum of glibc
HELD_BYTES = 256 << 20  # free memory kept at the end of the heap; more than an iteration with 300,000 splats frees


@cache
def hold() -> bool:
    """Let the C library keep the memory that an iteration frees for the next one; ``trim`` still returns it.

    By default glibc returns the end of its heap when more than twice the largest block is free there. Then every
    iteration gets new, zeroed pages, which took a sixth of its time at 181,000 splats.

    Returns
    -------
    bool
        Whether it took effect: with glibc, unless the user configures malloc (MALLOC_...).
    """
    if any(name.startswith("MALLOC_") for name in os.environ) or "glibc.malloc" in os.environ.get("GLIBC_TUNABLES", ""):
        return False
    try:
        call = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(call(M_MMAP_THRESHOLD, MAPPED_BYTES) and call(M_TRIM_THRESHOLD, HELD_BYTES))


@cache
def _malloc_trim() -> Callable[[int], Any] | None:
    """Return glibc's ``malloc_trim``; None with another C library."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None


def trim() -> bool:
    """Return the free pages of the C library to the operating system.

    Returns
    -------
    bool
        Whether the C library supports it (glibc).
    """
    call = _malloc_trim()
    if call is not None:
        call(0)
    return call is not None
