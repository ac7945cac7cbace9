"""Other tools' files: what they begin with, and numbers of JSON or text, of any kind until they are checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.errors import DataError

_LARGEST = 1e300  # JSON has whole numbers of any size
_HEAD = 4096  # bytes in which a file says what it is


def head(path: Path) -> bytes:
    """Return the first bytes of a file; none of what is not there, a folder, or not ours to read."""
    try:
        with open(path, "rb") as file:
            return file.read(_HEAD)
    except OSError:
        return b""


def real(value: Any, where: str) -> float:
    """Return a finite number, which may be written as text.

    Raises
    ------
    DataError
        Anything else; names ``where``.
    """
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str) or not abs(float(value)) <= _LARGEST:
            raise ValueError
        return float(value)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{where} must be a finite number, got {str(value)[:40]!r}") from error


def reals(value: Any, count: int, where: str) -> np.ndarray:
    """So many finite numbers [count] of a list, or of a text with white space between them.

    Raises
    ------
    DataError
        Another count, or something that is no finite number.
    """
    items = value.split() if isinstance(value, str) else value
    if not isinstance(items, Sequence) or len(items) != count:
        got = f"{len(items)}" if isinstance(items, Sequence) else type(value).__name__
        raise DataError(f"{where} must be {count} numbers, got {got}")
    return np.array([real(item, where) for item in items])


def whole(value: Any, where: str) -> int:
    """Return a whole number that is not negative.

    Raises
    ------
    DataError
    """
    number = real(value, where)
    if number != int(number) or number < 0:
        raise DataError(f"{where} must be a whole number >= 0, got {str(value)[:40]!r}")
    return int(number)


def entries(value: Any, where: str) -> Mapping[str, Any]:
    """Return an object of JSON.

    Raises
    ------
    DataError
    """
    if not isinstance(value, dict):
        raise DataError(f"{where} must be an object, got {type(value).__name__}; is the file of another tool?")
    return value


def required(entry: Mapping[str, Any], key: str, where: str) -> Any:
    """Return the value of a key that must be there.

    Raises
    ------
    DataError
    """
    if key not in entry:
        raise DataError(f'{where} must have the key "{key}", got {sorted(map(str, entry))[:12]}')
    return entry[key]
