"""Read and write the PLY container: a header with named elements, then their rows, in ASCII or binary.

A list property (the vertex indices of a face) becomes a ``PlyList``: counts and flat values.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.errors import DataError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}  # fmt: skip # noqa: E501
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_WORD = 64  # characters of a number
_HEADER_LIMIT = 1 << 20  # bytes


@dataclass(frozen=True, eq=False)
class PlyList:
    """A list property: ``counts`` [n] and the concatenated ``values`` [sum(counts)] of all rows."""

    counts: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class PlyElement:
    """One element: number of rows, and properties by name in file order."""

    count: int
    properties: Mapping[str, np.ndarray | PlyList]

    def scalar(self, name: str) -> np.ndarray:
        """Return an existing scalar property [count]."""
        column = self.properties[name]
        assert isinstance(column, np.ndarray), name
        return column

    def scalars(self, *names: str) -> np.ndarray | None:
        """Return scalar properties as float64 columns [count, len(names)], or None if one is missing."""
        columns = [self.properties.get(name) for name in names]
        arrays = [column for column in columns if isinstance(column, np.ndarray)]
        with np.errstate(invalid="ignore"):  # signalling NaN
            return np.stack(arrays, axis=1).astype(np.float64) if len(arrays) == len(names) else None

    def reals(self, path: object, name: str) -> np.ndarray:
        """Return a property [count] of real numbers as float64; 2-byte integers are read as half floats.

        PLY has no type for half floats, so programs that write them declare ``ushort``. Raises DataError if it has
        another integer type.
        """
        values = self.scalar(name)
        if values.dtype.kind in "iu" and values.dtype.itemsize != 2:
            raise DataError(
                f"{path}: expected the property {name} as float, or as ushort with half floats, got "
                f"{_NAMES[values.dtype.str[1:]]}; export the splats with float properties"
            )
        with np.errstate(invalid="ignore"):  # signalling NaN
            return (values if values.dtype.kind == "f" else values.view(np.float16)).astype(np.float64)

    def colors(self) -> np.ndarray | None:
        """Return colours [count, 3] as float64 in [0, 1], or None if there are none.

        Their names are ``red green blue``, ``diffuse_red ...`` or ``r g b``. The range is 65535 if a value exceeds 255,
        else 255 for integers or if a value exceeds 2, else 1.
        """
        for names in _COLORS:
            colors = self.scalars(*names)
            if colors is not None:
                break
        else:
            return None
        whole = any(self.scalar(name).dtype.kind in "iu" for name in names)
        largest = colors.max(initial=0.0, where=np.isfinite(colors))
        scale = 65535.0 if largest > 255 else 255.0 if whole or largest > 2 else 1.0
        return np.clip(np.nan_to_num(colors / scale), 0.0, 1.0)


@dataclass(frozen=True)
class PlyFile:
    """Elements by name in file order, and the comment lines."""

    elements: Mapping[str, PlyElement]
    comments: tuple[str, ...] = ()


@dataclass
class _Property:
    name: str
    dtype: str
    count_dtype: str | None = None  # for a list property


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


@dataclass
class _Header:
    order: str  # "" for ASCII, else numpy's byte-order mark
    elements: list[_Element]
    comments: tuple[str, ...]
    size: int  # bytes, including the end_header line


def read_ply(path: str | os.PathLike[str]) -> PlyFile:
    """Read all elements of a PLY file.

    Raises DataError if the file is missing, is no PLY, has a malformed header, or ends early.
    """
    data = _read(path)
    header = _parse_header(path, data)
    reader = _AsciiReader(path, data, header) if not header.order else _BinaryReader(path, data, header)
    return PlyFile({e.name: reader.element(e) for e in header.elements}, header.comments)


def _read(path: str | os.PathLike[str]) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError as error:
        raise DataError(f"{path}: expected a PLY file, but it cannot be read: {error.strerror}") from error


def _broken(path: object, what: str) -> DataError:
    return DataError(f"{path}: expected a valid PLY file, but {what}; export or copy the file again")


def _parse_header(path: object, data: bytes) -> _Header:
    if not data.startswith((b"ply\n", b"ply\r")):
        raise DataError(f"{path}: expected a PLY file, but it does not start with 'ply'; use a .ply file")
    end = data.find(b"end_header", 0, _HEADER_LIMIT)
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise _broken(path, "its header has no end_header line")
    order: str | None = None
    elements: list[_Element] = []
    comments: list[str] = []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] == "obj_info":
            continue
        try:
            if words[0] == "comment":
                comments.append(line.strip()[len("comment") :].strip())
            elif words[0] == "format":
                order = _FORMATS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
            elif words[0] == "property" and words[1] == "list":
                if _TYPES[words[2]][0] == "f":  # a list length must be an integer
                    raise ValueError
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
            else:
                raise KeyError(words[0])
        except (KeyError, IndexError, ValueError) as error:
            raise _broken(path, f"its header line {line.strip()!r} is invalid") from error
    if order is None:
        raise _broken(path, "its header has no format line")
    if any(e.count < 0 for e in elements):
        raise _broken(path, "its header has a negative count")
    most = max((e.count for e in elements), default=0)
    if most > len(data):  # a row has at least one byte
        raise _broken(path, f"it ends early ({str(most)[:20]} rows in a file of {len(data)} bytes)")
    if any(len({p.name for p in e.properties}) < len(e.properties) for e in elements):
        raise _broken(path, "its header names a property twice")
    return _Header(order, elements, tuple(comments), newline + 1)


class _BinaryReader:
    """Reads consecutive elements from the bytes after the header."""

    def __init__(self, path: object, data: bytes, header: _Header) -> None:
        self.path, self.data, self.order, self.offset = path, data, header.order, header.size

    def element(self, element: _Element) -> PlyElement:
        if not element.properties:
            return PlyElement(element.count, {})
        if all(p.count_dtype is None for p in element.properties):
            rows = self._rows(element, [(p.name, self.order + p.dtype) for p in element.properties])
            return PlyElement(element.count, {p.name: _native(rows[p.name]) for p in element.properties})
        return self._equal_lists(element) or self._ragged_lists(element)

    def _rows(self, element: _Element, fields: list[Any]) -> np.ndarray:
        dtype = np.dtype(fields)
        if element.count * dtype.itemsize > len(self.data) - self.offset:
            raise _broken(
                self.path,
                f"it ends early ({element.count} rows of {element.name!r} need "
                f"{element.count * dtype.itemsize} bytes, {len(self.data) - self.offset} are left)",
            )
        rows = np.frombuffer(self.data, dtype, element.count, self.offset)
        self.offset += rows.nbytes
        return rows

    def _equal_lists(self, element: _Element) -> PlyElement | None:
        """Read an element whose lists have equal lengths (all triangles) at once; None if the lengths differ."""
        if element.count == 0:
            empty = {p.name: _empty(p) for p in element.properties}
            return PlyElement(0, empty)
        start = self.offset
        lengths = self._first_row_lengths(element)
        fields: list[Any] = []
        row = 0  # bytes; summed here, because a broken count may exceed numpy's limit of 2 GiB per item
        for p in element.properties:
            row += np.dtype(p.dtype).itemsize * lengths.get(p.name, 1)
            if row > len(self.data):
                return None
            if p.count_dtype is None:
                fields.append((p.name, self.order + p.dtype))
            else:
                row += np.dtype(p.count_dtype).itemsize
                fields.append((f"{p.name} count", self.order + p.count_dtype))
                fields.append((p.name, self.order + p.dtype, (lengths[p.name],)))
        if element.count * row > len(self.data) - start:
            return None
        rows = self._rows(element, fields)
        if any((rows[f"{name} count"] != length).any() for name, length in lengths.items()):
            self.offset = start
            return None
        properties: dict[str, np.ndarray | PlyList] = {}
        for p in element.properties:
            values = _native(rows[p.name])
            counts = np.full(element.count, lengths.get(p.name, 1))
            properties[p.name] = values if p.count_dtype is None else PlyList(counts, values.reshape(-1))
        return PlyElement(element.count, properties)

    def _first_row_lengths(self, element: _Element) -> dict[str, int]:
        lengths, offset = {}, self.offset
        for p in element.properties:
            if p.count_dtype is not None:
                lengths[p.name] = self._scalar(p.count_dtype, offset)
                offset += np.dtype(p.count_dtype).itemsize
            offset += np.dtype(p.dtype).itemsize * lengths.get(p.name, 1)
        return lengths

    def _scalar(self, dtype: str, offset: int) -> int:
        if offset + np.dtype(dtype).itemsize > len(self.data):
            raise _broken(self.path, "it ends early")
        value = int(np.frombuffer(self.data, self.order + dtype, 1, offset)[0])
        if value < 0:
            raise _broken(self.path, "it has a list of negative length")
        return value

    def _ragged_lists(self, element: _Element) -> PlyElement:
        """Read rows of different lengths one by one."""
        starts: dict[str, list[int]] = {p.name: [] for p in element.properties}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties}
        offset = self.offset
        for _ in range(element.count):
            for p in element.properties:
                n = 1
                if p.count_dtype is not None:
                    n = self._scalar(p.count_dtype, offset)
                    offset += np.dtype(p.count_dtype).itemsize
                starts[p.name].append(offset)
                counts[p.name].append(n)
                offset += n * np.dtype(p.dtype).itemsize
            if offset > len(self.data):
                raise _broken(self.path, "it ends early")
        self.offset = offset
        properties: dict[str, np.ndarray | PlyList] = {}
        for p in element.properties:
            size = np.dtype(p.dtype).itemsize
            raw = b"".join(self.data[s : s + n * size] for s, n in zip(starts[p.name], counts[p.name], strict=True))
            values = _native(np.frombuffer(raw, self.order + p.dtype))
            properties[p.name] = values if p.count_dtype is None else PlyList(np.array(counts[p.name]), values)
        return PlyElement(element.count, properties)


class _AsciiReader:
    """Reads consecutive elements from the words after the header."""

    def __init__(self, path: object, data: bytes, header: _Header) -> None:
        self.path, self.words, self.at = path, data[header.size :].split(), 0

    def _take(self, count: int) -> np.ndarray:
        words = self.words[self.at : self.at + count]
        if len(words) < count:
            raise _broken(self.path, f"it ends early (expected {count} more numbers, got {len(words)})")
        if max(map(len, words), default=0) > _MAX_WORD:  # numpy allocates the longest length for every word
            raise _broken(self.path, f"it has a number of more than {_MAX_WORD} characters")
        self.at += count
        try:
            return np.array(words, dtype="S").astype(np.float64) if count else np.zeros(0)
        except ValueError as error:
            raise _broken(self.path, f"it has an invalid number ({error})") from error

    def _length(self) -> int:
        length = float(self._take(1)[0])
        if not (length >= 0 and length.is_integer()):
            raise _broken(self.path, f"it has a list of length {length:g}")
        return int(length)

    def _cast(self, values: np.ndarray, dtype: str) -> np.ndarray:
        """Convert numbers to the type in the header."""
        if dtype[0] in "iu":
            limits = np.iinfo(dtype)
            if not ((values >= limits.min) & (values <= limits.max)).all():
                raise _broken(self.path, f"it has a number out of the range of {_NAMES[dtype]}")
        with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
            return values.astype(dtype)

    def element(self, element: _Element) -> PlyElement:
        if all(p.count_dtype is None for p in element.properties):
            width = len(element.properties)
            table = self._take(element.count * width).reshape(element.count, width)
            return PlyElement(
                element.count, {p.name: self._cast(table[:, i], p.dtype) for i, p in enumerate(element.properties)}
            )
        values: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties}
        for _ in range(element.count):
            for p in element.properties:
                n = 1 if p.count_dtype is None else self._length()
                counts[p.name].append(n)
                values[p.name].append(self._take(n))
        properties: dict[str, np.ndarray | PlyList] = {}
        for p in element.properties:
            flat = self._cast(np.concatenate(values[p.name]), p.dtype) if element.count else np.zeros(0, p.dtype)
            properties[p.name] = flat if p.count_dtype is None else PlyList(np.array(counts[p.name], np.int64), flat)
        return PlyElement(element.count, properties)


def _native(values: np.ndarray) -> np.ndarray:
    """Return a contiguous, writable copy in native byte order."""
    return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("=")).copy()


def _empty(p: _Property) -> np.ndarray | PlyList:
    values = np.zeros(0, p.dtype)
    return values if p.count_dtype is None else PlyList(np.zeros(0, np.int64), values)


def write_ply(
    path: str | os.PathLike[str], elements: Mapping[str, np.ndarray], *, comments: tuple[str, ...] = ()
) -> None:
    """Write a binary little-endian PLY file atomically.

    ``elements`` (element name to structured array [n]): a field of shape (k,) becomes a list property of k items with a
    uchar count (k < 256). ``comments``: comment lines. Raises DiskError if the file could not be written.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    bodies = []
    for name, rows in elements.items():
        lines.append(f"element {name} {len(rows)}")
        fields: list[Any] = []
        names = rows.dtype.names or ()
        for key in names:
            base, shape = rows.dtype[key].base, rows.dtype[key].shape
            code = base.str[1:]
            if shape:
                lines.append(f"property list uchar {_NAMES[code]} {key}")
                fields += [(f"{key} count", "u1"), (key, "<" + code, shape)]
            else:
                lines.append(f"property {_NAMES[code]} {key}")
                fields.append((key, "<" + code))
        body = np.empty(len(rows), dtype=fields)
        for key in names:
            body[key] = rows[key]
            if rows.dtype[key].shape:
                body[f"{key} count"] = rows.dtype[key].shape[0]
        bodies.append(body)
    header = "\n".join([*lines, "end_header"]) + "\n"
    with atomic_write(path, mode="wb") as file:
        file.write(header.encode("ascii"))
        for body in bodies:
            file.write(body.tobytes())
