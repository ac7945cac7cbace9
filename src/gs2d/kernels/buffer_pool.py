"""A pool of memory for large tensors.

The C library returns freed blocks above 32 MB to the system and maps new pages for the next tensor. Mapping a page
costs more than filling it; gradients of 300,000 splats would map 13,000 pages in each backward pass.
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

MIN_BYTES = 32 << 20  # glibc returns larger blocks to the system
LINE = 64  # bytes of a cache line
PATIENCE = 64  # requests after which a free block is dropped; an iteration makes at most 13


class BufferPool:
    """Allocates tensors and reuses their memory once neither they nor views of them are referenced.

    A free block serves tensors of at least three quarters of its size. If none fits, free blocks of similar size are
    dropped, since splats were added or removed. A pool is thread-safe.
    """

    def __init__(self, min_bytes: int = MIN_BYTES) -> None:
        self._least, self._requests = min_bytes, 0
        self._lock = Lock()  # guards all but `_returned`: a finalizer may run at any point
        self._free: list[tuple[int, np.ndarray]] = []  # with the request number at which it became free
        self._returned: deque[np.ndarray] = deque()

    def clear(self) -> None:
        """Drop all free blocks."""
        with self._lock:
            self._returned.clear()
            self._free.clear()

    def empty(self, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
        """Return an uninitialised contiguous tensor, like ``torch.empty`` on the CPU."""
        count = math.prod(shape)
        if count * dtype.itemsize < self._least:
            return torch.empty(tuple(shape), dtype=dtype)
        block = self._take(count * dtype.itemsize + LINE)
        lent = block[:]  # a separate array, freed with the tensor's storage
        weakref.finalize(lent, self._returned.append, block).atexit = False
        return torch.frombuffer(lent, dtype=dtype, count=count, offset=-block.ctypes.data % LINE).view(tuple(shape))

    @property
    def free_bytes(self) -> int:
        """Bytes of all free blocks."""
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
