"""Arrays of numbers in MATLAB 5 files, as DTU's masks and planes are.

scipy's reader trusts the sizes in a file and ends the process on a damaged one; the few things needed here are read by
the published layout (MAT-File Level 5), every size compared with the bytes there.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from gs2d.core.growth import check_growth
from gs2d.errors import DataError

_HEADER = 128  # bytes
_SMALL = 256 << 20  # bytes that any variable may have unpacked; observation masks are mostly air
_CHUNK = 1 << 20
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}


def read_matlab(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the real arrays of these names, as far as the file has them; other variables are passed over.

    Raises
    ------
    DataError
        Missing, no MATLAB 5 file, cut short, or one that would grow beyond reason.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise DataError(f"{path} must be a MATLAB 5 file, got other bytes; copy it again")
    found = {}
    try:
        for kind, content in _elements(data, _HEADER, order):
            if kind == _COMPRESSED:
                packed = _unpacked(path, content, len(data))
                kind, content = next(_elements(packed, 0, order), (0, b""))
            if kind == _MATRIX:
                name, array = _array(content, order, names)
                if array is not None:
                    found[name] = array
    except (struct.error, zlib.error, ValueError, IndexError) as error:
        raise DataError(f"{path} must be a MATLAB 5 file, got: {error}; copy it again") from error
    return found


def _elements(data: bytes, at: int, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield (type, content) of one element after the other."""
    while at < len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        at += 8
        if kind >> 16:  # a small one has its content in its tag
            kind, size, start = kind & 0xFFFF, kind >> 16, at - 4
            if size > 4:
                raise ValueError(f"a small element of {size} bytes")
            yield kind, data[start : start + size]
            continue
        if size > len(data) - at:
            raise ValueError(f"it ends early ({size} bytes were announced, {len(data) - at} are left)")
        yield kind, data[at : at + size]
        at += size if kind == _COMPRESSED else size + -size % 8


def _unpacked(path: Path, content: bytes, file_size: int) -> bytes:
    """Return what a compressed variable holds, piece by piece, and no more than a scan's may."""
    unpack, parts, total = zlib.decompressobj(), [], 0
    while content and not unpack.eof:
        parts.append(unpack.decompress(content, _CHUNK))
        content, total = unpack.unconsumed_tail, total + len(parts[-1])
        check_growth(path, file_size, total, "a variable", small=_SMALL)
    return b"".join(parts)


def _array(content: bytes, order: str, names: Collection[str]) -> tuple[str, np.ndarray | None]:
    """Return a variable's name, and its numbers where it is wanted and a real array."""
    parts = _elements(content, 0, order)
    (_, flags), (_, sizes), (_, label) = next(parts, (0, b"")), next(parts, (0, b"")), next(parts, (0, b""))
    name = label.decode("latin-1").rstrip("\0")
    (word,) = struct.unpack_from(order + "I", flags)
    if name not in names or word & 0xFF not in _CLASSES:
        return name, None
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes)
    kind, data = next(parts, (0, b""))
    if kind not in _TYPES:
        raise ValueError(f"{name} of the data type {kind}")
    dtype = np.dtype(order + _TYPES[kind])
    if not 2 <= len(shape) <= 8 or min(shape) < 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"{name} of the shape {list(shape)} in {len(data)} bytes")
    with np.errstate(invalid="ignore", over="ignore"):
        return name, np.frombuffer(data, dtype).astype(_CLASSES[word & 0xFF]).reshape(shape, order="F")
