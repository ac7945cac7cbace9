"""Shape checks with named dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from gs2d.errors import ShapeError


@lru_cache(maxsize=256)
def _parsed(pattern: str) -> tuple[tuple[str, int | None], ...]:
    """Return the words of a pattern, with their values if they are numbers."""
    return tuple((word, int(word) if word.lstrip("-").isdigit() else None) for word in pattern.split())


def check_shapes(arrays: Mapping[str, tuple[Any, str]]) -> dict[str, int]:
    """Check arrays against shape patterns and return the size of each named dimension.

    ``arrays`` maps a name to an array, anything with a ``.shape``, and its pattern. A pattern is words: an integer must
    match exactly, a name must have the same size wherever it occurs, ``_`` matches any size. ``"N 3"`` is [N, 3];
    ``""`` is a scalar. A ShapeError names the first array that does not match, and the array that defined the
    dimension.

    >>> import numpy as np
    >>> check_shapes({"means": (np.zeros((5, 3)), "N 3"), "quats": (np.zeros((5, 4)), "N 4")})
    {'N': 5}
    """
    sizes: dict[str, int] = {}
    fixed_by: dict[str, str] = {}
    for name, (array, pattern) in arrays.items():
        if not hasattr(array, "shape"):
            raise ShapeError(f"{name} must be an array or a tensor, got {type(array).__name__}")
        words, shape = _parsed(pattern), tuple(array.shape)
        fits = len(words) == len(shape)
        for (word, number), size in zip(words, shape, strict=False):
            if word == "_":
                continue
            if number is not None:
                fits = fits and number == size
            elif word in sizes:
                fits = fits and sizes[word] == size
            elif fits:
                sizes[word], fixed_by[word] = size, name
        if not fits:
            names = [word for word, _ in words]
            valid = [f"{w}={sizes[w]} (from {fixed_by[w]})" for w in names if w in sizes and fixed_by[w] != name]
            context = f" with {', '.join(valid)}" if valid else ""
            raise ShapeError(f"{name} must be [{', '.join(names)}]{context}, got {list(shape)}")
    return sizes
