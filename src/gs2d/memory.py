"""Memory that was freed, given back to the system.

The C library keeps what is freed for the next request. Between the pictures of a capture, which stay, lie the holes of
the arrays that they were decoded through, and threads have heaps of their own: 93 MB of pictures took 549 MB.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

__all__ = ["trim"]


@cache
def _malloc_trim() -> Callable[[int], Any] | None:
    """The call of glibc that does it; None elsewhere."""
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
