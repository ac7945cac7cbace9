"""Read glTF 2.0 files: JSON, transforms of nodes, and arrays of accessors. Sizes are limited by those of the files."""

from __future__ import annotations

import base64
import binascii
import contextlib
import json
import math
import os
import struct
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.core.json_files import read_bytes
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DataError

_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_DEEPEST = 100  # nesting of nodes


@dataclass(frozen=True)
class GltfDocument:
    """The JSON of a file, and the buffer that a .glb contains."""

    path: Path
    json: dict[str, Any]
    inside: bytes | None
    size: int
    buffers: dict[int, bytes] = field(default_factory=dict)

    @contextlib.contextmanager
    def reading(self) -> Iterator[None]:
        """Convert errors of an invalid document to a DataError."""
        try:
            yield
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            words = " ".join(str(error).split())[:100]
            raise DataError(
                f"{self.path}: expected glTF 2.0, but its content is invalid ({type(error).__name__}: {words}); "
                "export the file again"
            ) from error

    def packed_bytes(self) -> int:
        """Return the size of the file with its external buffers, in bytes."""
        beside = [
            index
            for index, buffer in enumerate(self.json.get("buffers", []))
            if isinstance(buffer.get("uri"), str) and not buffer["uri"].startswith("data:")
        ]
        return self.size + sum(len(self._buffer(index)) for index in beside)

    def extra(self, key: str) -> Any:
        """Return an entry of the extras of the asset, or None."""
        asset = self.json.get("asset")
        extras = asset.get("extras") if isinstance(asset, dict) else None
        return extras.get(key) if isinstance(extras, dict) else None

    def bytes_of(self, index: int) -> int:
        """Return the size of an accessor as float32, in bytes."""
        accessor = self.json["accessors"][_whole(index)]
        return 4 * _whole(accessor["count"]) * _WIDTHS[accessor["type"]]

    def array(self, index: int, kind: str) -> np.ndarray:
        """Read an accessor of a type ("VEC3") as float32 [N, width]; integers are normalised if flagged.

        Raises DataError, or an error that ``reading`` converts to one.
        """
        accessor = self.json["accessors"][_whole(index)]
        if accessor["type"] != kind or "sparse" in accessor or "bufferView" not in accessor:
            raise DataError(
                f"{self.path}: expected plain accessors of the type {kind}, got number {index} of "
                f"{str(accessor['type'])[:20]!r}; export the file again"
            )
        view = self.json["bufferViews"][_whole(accessor["bufferView"])]
        dtype, width = np.dtype(_DTYPES[accessor["componentType"]]), _WIDTHS[kind]
        count, start = _whole(accessor["count"]), _whole(accessor.get("byteOffset", 0))
        stride = _whole(view.get("byteStride", 0)) or dtype.itemsize * width
        data = self._buffer(_whole(view["buffer"]))
        begin = _whole(view.get("byteOffset", 0))
        length = _whole(view["byteLength"])
        needed = start + stride * (count - 1) + dtype.itemsize * width if count else 0
        if begin + length > len(data) or needed > length or stride < dtype.itemsize * width:
            raise DataError(
                f"{self.path}: expected {needed} bytes for accessor {index}, got a view of {length} in a buffer "
                f"of {len(data)}; copy or export the file again"
            )
        shape, strides = (count, width), (stride, dtype.itemsize)
        values = np.ndarray(shape, dtype, data, begin + start, strides).astype(np.float32)
        if dtype.kind != "f" and accessor.get("normalized") is True:
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0))
        return values

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            self.buffers[index] = self._read_buffer(self.json["buffers"][index], index)
        return self.buffers[index]

    def _read_buffer(self, buffer: dict[str, Any], index: int) -> bytes:
        uri = buffer.get("uri")
        if uri is None and index == 0 and self.inside is not None:
            return self.inside
        if not isinstance(uri, str):
            raise DataError(f"{self.path}: buffer {index} has no data; export it again")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise DataError(f"{self.path}: expected buffer {index} in base64; export the file again") from error
        name = self.path.parent / urllib.parse.unquote(uri)
        home = Path(os.path.realpath(self.path)).parent
        if "\0" in uri or not Path(os.path.realpath(name)).is_relative_to(home):
            raise DataError(f"{self.path}: expected buffers in the folder of the file, got {uri[:80]!r}")
        return read_bytes(name)


def _whole(number: Any) -> int:
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 1 << 53:
        raise ValueError(f"expected an integer >= 0, got {number!r:.40}")
    return number


def read_document(path: str | os.PathLike[str]) -> GltfDocument:
    """Read a .glb or .gltf file without its external files; raises DataError if it is missing or no glTF 2.0."""
    data, inside = read_bytes(path), None
    text = data
    if data[:4] == b"glTF":
        text, inside = _chunks(path, data)
    try:
        document = json.loads(text.decode("utf-8"))
        if not isinstance(document, dict) or str(document["asset"]["version"]) != "2.0":
            raise ValueError("expected version 2.0")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        words = " ".join(str(error).split())[:100]
        raise DataError(f"{os.fspath(path)}: expected glTF 2.0 ({words}); copy or export the file again") from error
    return GltfDocument(Path(path), document, inside, len(data))


def _chunks(path: str | os.PathLike[str], data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk, if there is one, of a .glb file."""
    chunks: list[tuple[bytes, bytes]] = []
    at = _HEADER.size
    while at + _CHUNK.size <= len(data) and len(chunks) < 2:
        length, kind = _CHUNK.unpack_from(data, at)
        chunk = data[at + _CHUNK.size : at + _CHUNK.size + length]
        if len(chunk) < length:
            raise DataError(
                f"{os.fspath(path)}: the file ends early ({length} more bytes expected, {len(chunk)} left); "
                "copy or export it again"
            )
        chunks.append((kind, chunk))
        at += _CHUNK.size + length
    if not chunks or chunks[0][0] != b"JSON" or _HEADER.unpack_from(data)[1] != 2:
        raise DataError(f"{os.fspath(path)}: expected glTF 2.0, but the chunks are invalid; export it again")
    return chunks[0][1], chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None


def node_matrices(document: GltfDocument) -> Iterator[tuple[np.ndarray, int]]:
    """Yield (transform to the scene [4, 4], mesh index) of all nodes with a mesh in the default scene."""
    nodes, scenes = document.json.get("nodes", []), document.json.get("scenes", [])
    roots = scenes[_whole(document.json.get("scene", 0))].get("nodes", []) if scenes else range(len(nodes))
    waiting = [(np.eye(4), _whole(node), 0) for node in roots]
    remaining = len(nodes) + 1  # a node has one parent
    while waiting:
        above, index, depth = waiting.pop()
        remaining -= 1
        if remaining < 0 or depth > _DEEPEST:
            raise DataError(f"{document.path}: expected nodes with one parent each; export the file again")
        node = nodes[index]
        matrix = above @ _matrix(node)
        waiting += [(matrix, _whole(child), depth + 1) for child in node.get("children", [])]
        if "mesh" in node:
            yield matrix, _whole(node["mesh"])


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the transform of a node to its parent."""
    if "matrix" in node:
        matrix = _numbers(node["matrix"], 16).reshape(4, 4).T  # columns
    else:
        quat = torch.from_numpy(_numbers(node.get("rotation", (0, 0, 0, 1)), 4)[[3, 0, 1, 2]])
        matrix = np.eye(4)
        matrix[:3, :3] = quats_to_matrices(quat[None])[0].numpy() * _numbers(node.get("scale", (1, 1, 1)), 3)
        matrix[:3, 3] = _numbers(node.get("translation", (0, 0, 0)), 3)
    return matrix


def _numbers(values: Any, count: int) -> np.ndarray:
    numbers = [float(value) for value in values]
    if len(numbers) != count or not all(math.isfinite(number) and abs(number) < 1e30 for number in numbers):
        raise ValueError(f"expected {count} finite numbers")
    return np.array(numbers)
