"""Read and write the compressed PLY of PlayCanvas and SuperSplat: 16 bytes per splat and one per SH coefficient.

Splats are grouped in chunks of 256 neighbours. A chunk stores the smallest and largest position, log scale and colour
of its splats; a splat stores fractions between them: position and log scales in 11, 10 and 11 bits, colour and opacity
in 8 bits each. Its rotation has 32 bits: the index of the largest component of (w, x, y, z), and 10 bits for each of
the others. SH coefficients have 256 steps from -4 to 4. Follows SplatTransform and SuperSplat (PlayCanvas, MIT).
"""

from __future__ import annotations

import math
import os
import warnings

import numpy as np

from gs2d.contrib.formats.quantised import logit_of_byte, morton_order, to_byte
from gs2d.core.sh import C0
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import register_format, register_splat_reader
from gs2d.io.gaussians import Gaussians, Warn, drawn_bands, sigmoid, unit_quats
from gs2d.io.ply_format import PlyElement, PlyFile, read_ply, write_ply
from gs2d.io.splat_ply import DISKS_COMMENT

_CHUNK = 256
_BITS = (11, 10, 11)
_SMALLEST = -40.0  # log scale, 4e-18 units; limits the range of a chunk, which has 1,023 steps
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SPAN = {
    "position": ("x", "y", "z"),
    "scale": ("scale_x", "scale_y", "scale_z"),
    "color": ("r", "g", "b"),
}


def write_compressed_ply(path: str | os.PathLike[str], gaussians: Gaussians) -> tuple[str, ...]:
    """Write a compressed PLY, atomically, in Morton order; return messages about unrepresentable values."""
    n = len(gaussians)
    g = gaussians.rows(morton_order(gaussians.means))
    chunks = -(-n // _CHUNK)
    values = {
        "position": g.means.astype(np.float64),
        "scale": np.clip(g.log_scales.astype(np.float64), _SMALLEST, 20.0),
        "color": 0.5 + C0 * g.sh0.astype(np.float64),
    }
    ends = [f"{end}_{x}" for names in _SPAN.values() for end in ("min", "max") for x in names]
    chunk = np.zeros(chunks, dtype=[(end, "<f4") for end in ends])
    fractions = {}
    for what, names in _SPAN.items():
        low, high, fractions[what] = _fractions(values[what], chunks)
        for axis, x in enumerate(names):
            chunk[f"min_{x}"], chunk[f"max_{x}"] = low[:, axis], high[:, axis]
    vertex = np.zeros(n, dtype=[(name, "<u4") for name in _PACKED])
    vertex["packed_position"] = _pack(fractions["position"], _BITS)
    vertex["packed_rotation"] = _packed_quats(g.quats)
    vertex["packed_scale"] = _pack(fractions["scale"], _BITS)
    opacity = sigmoid(g.opacity_logits)[:, None]
    vertex["packed_color"] = _pack(np.concatenate([fractions["color"], opacity], axis=1), (8, 8, 8, 8))
    elements = {"chunk": chunk, "vertex": vertex}
    if g.shN.shape[1]:
        rest = g.shN.transpose(0, 2, 1).reshape(n, 3 * g.shN.shape[1])  # by channel, as in a plain PLY
        sh = np.zeros(n, dtype=[(f"f_rest_{i}", "u1") for i in range(rest.shape[1])])
        for i in range(rest.shape[1]):
            sh[f"f_rest_{i}"] = np.clip(np.floor((np.clip(rest[:, i], -8.0, 8.0) / 8.0 + 0.5) * 256.0), 0, 255)
        elements["sh"] = sh
    write_ply(path, elements, comments=("written by gs2d", DISKS_COMMENT))
    steep = int((np.abs(g.shN) > 4.0).any(axis=(1, 2)).sum()) if g.shN.size else 0
    return (f"{steep} of {n} splats have SH coefficients beyond 4, the limit of the format",) if steep else ()


def _fractions(values: np.ndarray, chunks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the smallest and largest values [C, 3] of chunks, and fractions [N, 3] in [0, 1] between them."""
    starts = np.arange(chunks) * _CHUNK
    if not chunks:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    low = np.minimum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    at = np.arange(len(values)) // _CHUNK
    span = (high - low)[at]
    fraction = (values - low[at]) / np.where(span > 0, span, 1.0)
    return low, high, np.clip(fraction, 0.0, 1.0)


def _pack(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Quantize columns in [0, 1] to ``bits`` each, and pack them into one word [N], the first in the highest bits."""
    word = np.zeros(len(fractions), np.uint32)
    for column, count in zip(fractions.T, bits, strict=True):
        most = (1 << count) - 1
        word = (word << np.uint32(count)) | np.clip(np.floor(column * most + 0.5), 0, most).astype(np.uint32)
    return word


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    q = unit_quats(quats)
    rows, largest = np.arange(len(q)), np.abs(q).argmax(axis=1)
    q *= np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    word = largest.astype(np.uint32)
    for i in range(4):
        field = np.clip(np.floor((q[:, i] * np.sqrt(0.5) + 0.5) * 1023.0 + 0.5), 0, 1023).astype(np.uint32)
        word = np.where(largest == i, word, (word << np.uint32(10)) | field)
    return np.asarray(word)


def read_compressed_ply(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> Gaussians:
    """Read a compressed PLY, in file order; ``warn`` receives a message if SH bands are dropped.

    Raises DataError if the file is broken, no PLY, or has inconsistent elements.
    """
    file = read_ply(path)
    vertex, chunk = _elements(path, file)
    n = vertex.count
    packed = [_words(path, vertex, name) for name in _PACKED]
    at = np.arange(n) // _CHUNK
    position = _between(path, chunk, "position", _unpack(packed[0], _BITS), at)
    scale = _between(path, chunk, "scale", _unpack(packed[2], _BITS), at)
    rgba = _unpack(packed[3], (8, 8, 8, 8))
    color = _between(path, chunk, "color", rgba[:, :3], at) if "min_r" in chunk.properties else rgba[:, :3]
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
        return Gaussians(
            position.astype(np.float32),
            _quats(packed[1]),
            scale.astype(np.float32),
            logit_of_byte(to_byte(255.0 * rgba[:, 3])),
            ((color - 0.5) / C0).astype(np.float32),
            drawn_bands(str(path), _sh(path, file.elements.get("sh"), n), warn),
        )


def _elements(path: object, file: PlyFile) -> tuple[PlyElement, PlyElement]:
    vertex, chunk = file.elements.get("vertex"), file.elements.get("chunk")
    if vertex is None or chunk is None:
        raise DataError(f"{path}: expected a compressed PLY with chunks and vertices, got {sorted(file.elements)}")
    if chunk.count != -(-vertex.count // _CHUNK):
        raise DataError(
            f"{path}: expected {-(-vertex.count // _CHUNK)} chunks for {vertex.count} splats, got {chunk.count}; "
            "export the file again"
        )
    return vertex, chunk


def _column(path: object, element: PlyElement, name: str) -> np.ndarray:
    values = element.properties.get(name)
    if not isinstance(values, np.ndarray):
        raise DataError(f"{path}: the property {name} of a compressed PLY is missing; export the file again")
    return values


def _real(path: object, element: PlyElement, name: str) -> np.ndarray:
    _column(path, element, name)
    return element.reals(path, name)


def _words(path: object, vertex: PlyElement, name: str) -> np.ndarray:
    """Return the packed words of a property of any integer type."""
    words = _column(path, vertex, name)
    if words.dtype.kind not in "iu":
        raise DataError(f"{path}: expected integers as {name}, got {words.dtype}; export the file again")
    return words.astype(np.uint32)


def _between(path: object, chunk: PlyElement, what: str, fractions: np.ndarray, at: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):  # NaN and infinite ends; values are checked later
        low, high = (
            np.stack([_real(path, chunk, f"{end}_{x}") for x in _SPAN[what]], axis=1) for end in ("min", "max")
        )
        between = low[at] * (1.0 - fractions) + high[at] * fractions
        # At 0 and 1 the ends are used directly, because 0 times infinity (a scale of 0) is NaN.
        return np.where(fractions == 0, low[at], np.where(fractions == 1, high[at], between))


def _unpack(word: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    columns = []
    for count in reversed(bits):
        most = np.uint32((1 << count) - 1)
        columns.append((word & most) / float(most))
        word = word >> np.uint32(count)
    return np.stack(columns[::-1], axis=1)


def _quats(word: np.ndarray) -> np.ndarray:
    largest = (word >> np.uint32(30)).astype(int)
    q = np.zeros((len(word), 4))
    for i in (3, 2, 1, 0):
        stored = largest != i
        value = ((word & np.uint32(1023)) / 1023.0 - 0.5) / np.sqrt(0.5)
        q[stored, i] = value[stored]
        word = np.where(stored, word >> np.uint32(10), word)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(0.0, 1.0 - np.square(q).sum(axis=1)))
    return q.astype(np.float32)


def _sh(path: object, element: PlyElement | None, n: int) -> np.ndarray:
    """Dequantize SH coefficients [N, K-1, 3]: bytes are centres of steps, except for the ends 0 and 255."""
    if element is None:
        return np.zeros((n, 0, 3), np.float32)
    count = sum(name.startswith("f_rest_") for name in element.properties)
    if not count or count % 3 or math.isqrt(1 + count // 3) ** 2 != 1 + count // 3 or element.count != n:
        raise DataError(
            f"{path}: expected 9, 24 or 45 SH coefficients for {n} splats, got {count} for {element.count}; "
            "export the file again"
        )
    columns = [_column(path, element, f"f_rest_{i}") for i in range(count)]
    if any(c.dtype.kind not in "iu" or (c.size and (c.min() < 0 or c.max() > 255)) for c in columns):
        raise DataError(
            f"{path}: expected integers from 0 to 255 (uchar) as f_rest_* of a compressed PLY, got "
            f"{columns[0].dtype}; export the file again"
        )
    rest = np.stack(columns, axis=1).astype(np.float64)
    fraction = np.where(rest == 0, 0.0, np.where(rest == 255, 1.0, (rest + 0.5) / 256.0))
    return ((fraction - 0.5) * 8.0).astype(np.float32).reshape(n, 3, count // 3).transpose(0, 2, 1)


_register = register_format("compressed", ending=".compressed.ply")
_register(lambda path, splats: write_compressed_ply(path, Gaussians.of(splats)))


@register_splat_reader("compressed", ply_kind="compressed")
def _read(path: str | os.PathLike[str], warn: Warn) -> tuple[Gaussians, str]:
    return read_compressed_ply(path, warn), "compressed PLY"
