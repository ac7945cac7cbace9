"""Memory for large tensors that is used again.

The C library gives blocks above 32 MB back to the system as soon as they are free, and maps new ones for the next
tensor: a page costs more to get than to fill. Gradients of 300,000 splats would cost 13,000 pages a backward pass.
"""

from __future__ import annotations

import math
import weakref
from collections import deque
from collections.abc import Sequence
from threading import Lock

import numpy as np
import torch
from torch import Tensor

__all__ = ["MIN_BYTES", "BufferPool"]

MIN_BYTES = 32 << 20  # what glibc never keeps
LINE = 64  # bytes of a cache line
PATIENCE = 64  # requests for which a free block is kept; an iteration makes 13 at most


class BufferPool:
    """Hands out tensors and takes their memory back when nobody holds them, or a view of them, any more.

    A free block serves tensors of three quarters of its size and more. Where none fits, those of about that size are
    given up: splats were added or removed. Threads may share a pool.
    """

    def __init__(self, min_bytes: int = MIN_BYTES) -> None:
        self._least, self._requests = min_bytes, 0
        self._lock = Lock()  # guards all but `_returned`: a block may come back in the middle of anything
        self._free: list[tuple[int, np.ndarray]] = []  # with the number of the request since when
        self._returned: deque[np.ndarray] = deque()

    def clear(self) -> None:
        """Give up every block that nobody holds."""
        with self._lock:
            self._returned.clear()
            self._free.clear()

    def empty(self, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
        """Like ``torch.empty`` on the CPU: undefined contents, contiguous."""
        count = math.prod(shape)
        if count * dtype.itemsize < self._least:
            return torch.empty(tuple(shape), dtype=dtype)
        block = self._take(count * dtype.itemsize + LINE)
        lent = block[:]  # an array of its own: it dies with the tensor's storage
        weakref.finalize(lent, self._returned.append, block).atexit = False
        return torch.frombuffer(lent, dtype=dtype, count=count, offset=-block.ctypes.data % LINE).view(tuple(shape))

    @property
    def free_bytes(self) -> int:
        """Held for the next tensors."""
        with self._lock:
            self._collect()
            return sum(block.nbytes for _, block in self._free)

    def _collect(self) -> None:
        while self._returned:
            self._free.append((self._requests, self._returned.popleft()))

    def _take(self, size: int) -> np.ndarray:
        with self._lock:
            self._collect()
            self._requests += 1
            free = [(since, b) for since, b in self._free if self._requests - since <= PATIENCE]
            fitting = [b for _, b in free if size <= b.nbytes <= size + size // 3]
            if fitting:
                block = min(fitting, key=lambda b: b.nbytes)
                self._free = [(since, b) for since, b in free if b is not block]
                return block
            self._free = [(since, b) for since, b in free if not size <= 2 * b.nbytes <= 4 * size]
        return np.empty(size + size // 16, dtype=np.uint8)  # the next request may be a little larger
