"""Arrays of numpy on disk, ``.npy`` and ``.npz``, from foreign hands: numbers only, and no larger than their file says.

numpy's own reader takes its sizes from the header and evaluates that as Python; a broken one ends in any of a dozen
errors, or in an array of terabytes. Here the header is read in one place and its size compared with the bytes there.
"""

from __future__ import annotations

import ast
import io
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

from gs2d.core.growth import check_entries, check_growth
from gs2d.errors import DataError

_MAGIC = b"\x93NUMPY"
_MAX_HEADER = 10_000  # bytes, as numpy has it
_NUMBERS = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f(?:2|4|8))")
_PYTHON_2 = re.compile(r"(?<=\d)L\b")  # shapes were written as (3L, 4L)
_BROKEN_ZIP = (OSError, RuntimeError, ValueError, EOFError, LookupError, struct.error, zipfile.BadZipFile, zlib.error)


def read_npy(path: str | os.PathLike[str], what: str) -> np.ndarray:
    """Read a ``.npy`` file of booleans, whole numbers or floats.

    Raises
    ------
    DataError
        Missing, another kind of file, other things than numbers, or fewer bytes than its header announces.
    """
    name = f"{what} {os.fspath(path)}"
    try:
        with open(path, "rb") as file:
            return _array(file, os.fstat(file.fileno()).st_size, name)
    except FileNotFoundError as error:
        raise DataError(f"{name} does not exist") from error
    except OSError as error:
        raise DataError(f"{name} cannot be read: {error.strerror or error}") from error


def read_npz(path: str | os.PathLike[str], what: str, wanted: Callable[[str], bool]) -> dict[str, np.ndarray]:
    """Read the arrays of a ``.npz`` archive whose names are ``wanted``, of numbers as :func:`read_npy`.

    Raises
    ------
    DataError
        Missing, damaged, no such archive, or one that would grow beyond reason.
    """
    name = f"{what} {os.fspath(path)}"
    try:
        with open(path, "rb") as raw, zipfile.ZipFile(raw) as archive:
            entries = [e for e in check_entries(path, archive.infolist()) if wanted(e.filename.removesuffix(".npy"))]
            check_growth(path, Path(path).stat().st_size, sum(entry.file_size for entry in entries), "an archive")
            return {
                entry.filename.removesuffix(".npy"): _array(
                    io.BytesIO(archive.read(entry)), entry.file_size, f"{name}: {entry.filename}"
                )
                for entry in entries
            }
    except FileNotFoundError as error:
        raise DataError(f"{name} does not exist") from error
    except _BROKEN_ZIP as error:
        raise DataError(f"{name} must be a numpy archive (.npz), got: {error}; copy it again") from error


def _array(file: IO[bytes], size: int, name: str) -> np.ndarray:
    """Return the array of an open file of ``size`` bytes."""
    dtype, shape, fortran = _header(file, name)
    start = file.tell()
    need = math.prod(shape) * dtype.itemsize
    if need > size - start:
        raise DataError(f"{name} must hold the {need} bytes of its array, got {max(size - start, 0)}; copy it again")
    data = file.read(need)
    if len(data) < need:
        raise DataError(f"{name} must hold the {need} bytes of its array, got {len(data)}; copy it again")
    flat = np.frombuffer(bytearray(data), dtype)  # of its own, and writable
    return flat.reshape(shape, order="F" if fortran else "C").astype(dtype.newbyteorder("="), copy=False)


def _header(file: IO[bytes], name: str) -> tuple[np.dtype, tuple[int, ...], bool]:
    """Return dtype, shape and whether the first index runs fastest."""
    head = file.read(8)
    if len(head) < 8 or not head.startswith(_MAGIC) or head[6] not in (1, 2, 3):
        raise DataError(f"{name} must be an array of numpy, got other bytes; save it by numpy.save")
    layout = "<H" if head[6] == 1 else "<I"
    field = file.read(struct.calcsize(layout))
    length = struct.unpack(layout, field)[0] if len(field) == struct.calcsize(layout) else _MAX_HEADER + 1
    text = file.read(length) if length <= _MAX_HEADER else b""
    if len(text) < length:
        raise DataError(f"{name} must be an array of numpy, got a header that ends early; copy it again")
    try:
        entries = ast.literal_eval(_PYTHON_2.sub("", text.decode("utf-8" if head[6] == 3 else "latin-1")).strip())
        descr, fortran, shape = entries["descr"], entries["fortran_order"], entries["shape"]
    except (SyntaxError, ValueError, TypeError, KeyError, MemoryError, RecursionError) as error:
        raise DataError(f"{name} must be an array of numpy, got a header that is not understood") from error
    if not isinstance(descr, str) or not _NUMBERS.fullmatch(descr):
        raise DataError(f"{name} must be an array of numbers, got {str(descr)[:40]}")
    sizes = isinstance(shape, tuple) and all(isinstance(n, int) and 0 <= n < 1 << 48 for n in shape)
    if not sizes or len(shape) > 8 or not isinstance(fortran, bool):
        raise DataError(f"{name} must be an array of up to 8 dimensions, got the shape {str(shape)[:60]}")
    if 0 in shape and math.prod(n or 1 for n in shape) > 1 << 48:
        raise DataError(f"{name} must be an array that fits into memory, got the shape {str(shape)[:60]}")
    return np.dtype(descr), shape, fortran
