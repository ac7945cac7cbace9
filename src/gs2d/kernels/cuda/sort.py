"""Launch parameters of the kernels in sort.cu: blocks, pieces, and the digits of each pass."""

from __future__ import annotations

SORT_THREADS, PIECE, DIGITS, MOST_PASSES = 256, 2048, 256, 4  # sort.cu has the same
MOST_SORTED = 1 << 29  # counts are stored in 30 bits
MOST_BLOCKS = 2048  # of grid-stride kernels: more than any GPU runs at once


def pieces_of(count: int) -> int:
    """Return the number of blocks of ``sort_pass`` and ``running_counts``."""
    return -(-count // PIECE)


def digit_blocks(count: int) -> int:
    """Return the number of blocks of ``count_digits``."""
    return min(pieces_of(count), MOST_BLOCKS)


def clear_blocks(count: int) -> int:
    """Return the number of blocks of ``clear_words`` for ``count`` times 16 bytes."""
    return min(-(-count // SORT_THREADS), MOST_BLOCKS)


def passes_of(bits: int) -> tuple[tuple[int, int], ...]:
    """Return the digits of keys with ``bits`` bits, lowest first: first bit and number of bits of each."""
    return tuple((shift, min(8, bits - shift)) for shift in range(0, bits, 8))
