"""Memory that was freed: given back to the system between phases, kept within them.

The C library keeps what is freed for the next request. Between the pictures of a capture, which stay, lie the holes of
the arrays that they were decoded through, and threads have heaps of their own: 93 MB of pictures took 549 MB.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache
from typing import Any

__all__ = ["hold", "trim"]

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h
MAPPED_BYTES = 32 << 20  # from which a block is mapped for itself: the most that glibc takes
HELD_BYTES = 256 << 20  # free at the end of the heap: what an iteration at 300,000 splats frees, and more


@cache
def hold() -> bool:
    """Let the C library keep what an iteration frees for the next one; ``trim`` still gives it back.

    By itself glibc gives the end of its heap back as soon as more than twice the largest block is free there. An
    iteration frees 100 MB of gradients and images, so at some sizes each one gets its pages anew, zeroed: 12,000 of
    them and a sixth of its time at 181,000 splats.

    Returns
    -------
    bool
        Whether this platform has a way to say so (glibc), and the user has not said something else (MALLOC_...).
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
    """Return the call of glibc that does it; None elsewhere."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None


def trim() -> bool:
    """Give all free pages of the C library's heaps back to the system.

    Returns
    -------
    bool
        Whether this platform has a way to do so (glibc). Nothing else needs one: without it, memory is used again.
    """
    call = _malloc_trim()
    if call is not None:
        call(0)
    return call is not None
