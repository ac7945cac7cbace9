"""How the kernels of sort.cu are launched: blocks, pieces, and the digits of each pass."""

from __future__ import annotations

__all__ = [
    "DIGITS",
    "MOST_PASSES",
    "MOST_SORTED",
    "PIECE",
    "SORT_THREADS",
    "clear_blocks",
    "digit_blocks",
    "passes_of",
    "pieces_of",
]

SORT_THREADS, PIECE, DIGITS, MOST_PASSES = 256, 2048, 256, 4  # sort.cu has the same
MOST_SORTED = 1 << 29  # counts are said in 30 bits
MOST_BLOCKS = 2048  # of those that walk over memory: more than run at once on any GPU


def pieces_of(count: int) -> int:
    """Return the blocks of ``sort_pass`` and ``running_counts``."""
    return -(-count // PIECE)


def digit_blocks(count: int) -> int:
    """Return the blocks of ``count_digits``."""
    return min(pieces_of(count), MOST_BLOCKS)


def clear_blocks(count: int) -> int:
    """Return the blocks of ``clear_words`` for so many times 16 bytes."""
    return min(-(-count // SORT_THREADS), MOST_BLOCKS)


def passes_of(bits: int) -> tuple[tuple[int, int], ...]:
    """Return the digits of keys of so many bits, lowest first: where each begins, and its bits."""
    return tuple((shift, min(8, bits - shift)) for shift in range(0, bits, 8))
