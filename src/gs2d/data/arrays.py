"""NumPy files, ``.npy`` and ``.npz``: numbers only, with a guard against decompression bombs."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from gs2d.core.growth import check_entries, check_growth
from gs2d.core.text import first_line
from gs2d.errors import DataError


def read_npy(path: str | os.PathLike[str], what: str) -> np.ndarray:
    """Read a ``.npy`` file of booleans, integers or floats.

    ``what``: description of the file, for messages. Raises DataError if the file is missing, damaged, or holds anything
    but numbers.
    """
    name = f"{what} {os.fspath(path)}"
    with _one_line(name, "npy"), open(path, "rb") as file:
        return _array(file, name)


def read_npz(path: str | os.PathLike[str], what: str, include: Callable[[str], bool]) -> dict[str, np.ndarray]:
    """Read the arrays of a ``.npz`` archive whose names satisfy ``include``.

    Raises DataError if the file is missing, damaged, or implausibly large when unpacked.
    """
    name = f"{what} {os.fspath(path)}"
    with _one_line(name, "npz"), zipfile.ZipFile(path) as archive:
        entries = [e for e in check_entries(path, archive.infolist()) if include(e.filename.removesuffix(".npy"))]
        check_growth(path, Path(path).stat().st_size, sum(entry.file_size for entry in entries), "an archive")
        arrays = {}
        for entry in entries:
            with archive.open(entry) as file:
                arrays[entry.filename.removesuffix(".npy")] = _array(file, f"{name}: {entry.filename}")
        return arrays


def _array(file: IO[bytes], name: str) -> np.ndarray:
    """Read an array of numbers, in native byte order."""
    array: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    if array.dtype.kind not in "biuf":
        raise DataError(f"{name} must be an array of numbers, got {array.dtype}; save it again as floats")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


@contextlib.contextmanager
def _one_line(name: str, kind: str) -> Iterator[None]:
    """Convert errors of NumPy and zipfile to DataError."""
    try:
        yield
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(f"{name} does not exist") from error
    except Exception as error:
        why = first_line(error)
        raise DataError(f"{name} must be a numpy file of numbers (.{kind}), got: {why}; copy it again") from error
