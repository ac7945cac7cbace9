"""Read and write SPZ, Niantic's compressed splats: versions 3 (gzip) and 4 (zstd); version 2 is read only.

From the format's documentation (github.com/nianticlabs/spz, README). All values are little-endian: magic, version,
count (u32 each), SH degree, fractional bits, flags, reserved (u8 each); then streams of positions (24-bit fixed point),
opacities, colours, log scales in 16ths above -10, rotations, SH coefficients (by coefficient, then r g b), 8 bits each.
Versions 2 and 3 compress header and streams together. Version 4 (extra ``spz4``) compresses each stream separately
after an uncompressed header, whose reserved byte is the number of streams, followed by the offset of the table of their
sizes (u32; u64 compressed and u64 uncompressed each) and 12 unused bytes.
The axes are right, up, back; those of PLY are right, down, front, so y and z change sign. With flag 0x2 there are
records (u32 type, u32 size, content) after the header of version 4, or after the streams of older versions. One type
states another coordinate system.
"""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from gs2d.contrib.formats.quantised import logit_of_byte, to_byte
from gs2d.contrib.formats.turned import mirrored, placed
from gs2d.core.atomic_files import atomic_write
from gs2d.core.extras import required
from gs2d.core.growth import check_growth
from gs2d.core.json_files import read_bytes
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import register_format, register_splat_reader
from gs2d.io.gaussians import THIN, Gaussians, Warn, drawn_bands, sigmoid, unit_quats, with_thickness

_MAGIC = 0x5053474E  # "NGSP"
_HEADER = struct.Struct("<IIIBBBB")
_HEADER_4 = struct.Struct("<IIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_WINDOW = 1 << 26  # bytes; largest window of a zstd stream
_LARGEST = (1 << 23) - 1  # largest signed 24-bit integer
_EXTENDED = 0x2  # flag: the file has records
_RECORD, _COORDINATES = struct.Struct("<II"), 0xADBE0003  # header of a record; type of the coordinate system
_RECORDS = 1 << 20  # bytes; largest size of all records
_RUB, _SYSTEMS = 4, 16
_DEGREES = 4  # highest SH degree of the format
_QUARTER = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # rotation by -90 degrees about x
_FINEST = 20  # fractional bits
_STEPS = 64  # steps of a position per size of a typical splat
_COLOR = 0.15  # scale of SH colours; leaves room beyond black and white
_SH1_STEP, _SH_STEP = 2, 4  # steps of 255: 7 bits for degree 1, 6 for higher ones; Niantic's library uses 5 and 4
_ROOT = np.sqrt(0.5)  # bound of all quaternion components but the largest
_WORDS = (1 << 9) - 1


def write_spz(path: str | os.PathLike[str], gaussians: Gaussians, *, version: int = 3) -> tuple[str, ...]:
    """Write SPZ of version 3 or 4, atomically and deterministically; returns messages about unrepresentable splats.

    The step of positions is at most a 64th of the median splat size, if the farthest position leaves enough bits.
    Raises DataError if a position exceeds 2^23 units, BackendError for version 4 without zstandard.
    """
    g = mirrored(gaussians, (1, -1, -1))
    farthest = float(np.abs(g.means).max()) if len(g) else 0.0
    bits = _fractional_bits(g, farthest)
    if farthest > _LARGEST:
        raise DataError(f"SPZ holds positions up to {_LARGEST} units, got {farthest:.4g}; use --format 3dgs")
    streams = [array.tobytes() for array in _streams(g, bits)]
    parts = _parts_4(g, bits, streams) if version == 4 else _parts_3(g, bits, streams)
    with atomic_write(path) as file:
        file.writelines(parts)
    return _losses(g)


def _parts_3(g: Gaussians, bits: int, streams: list[bytes]) -> Iterator[bytes]:
    packed = zlib.compressobj(9, zlib.DEFLATED, 16 + zlib.MAX_WBITS)  # gzip without a time stamp
    for part in (_HEADER.pack(_MAGIC, 3, len(g), g.sh_degree, bits, 0, 0), *streams):
        yield packed.compress(part)
    yield packed.flush()


def _parts_4(g: Gaussians, bits: int, streams: list[bytes]) -> list[bytes]:
    streams = streams if g.shN.shape[1] else streams[:-1]  # no empty stream, like Niantic's library
    compressor = required("spz4", "zstandard", "SPZ of version 4", "use version 3").ZstdCompressor(level=12)
    packed = [compressor.compress(stream) for stream in streams]
    header = _HEADER_4.pack(_MAGIC, 4, len(g), g.sh_degree, bits, 0, len(streams), _HEADER_4.size)
    table = [_SIZES.pack(len(a), len(b)) for a, b in zip(packed, streams, strict=True)]
    return [header, *table, *packed]


def _fractional_bits(g: Gaussians, farthest: float) -> int:
    size = float(np.median(g.log_scales.max(axis=1).astype(np.float64))) if len(g) else 0.0
    bits = int(np.clip(np.ceil((np.log(_STEPS) - size) / np.log(2.0)), 0, _FINEST))
    while bits and farthest * (1 << bits) > _LARGEST:
        bits -= 1
    return bits


def _streams(g: Gaussians, bits: int) -> list[np.ndarray]:
    """Return the quantized attributes in file order, uint8."""
    fixed = np.rint(g.means.astype(np.float64) * (1 << bits)).astype("<i4")
    positions = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    sh = np.rint(np.clip(g.shN, -2.0, 2.0) * 128.0).astype(np.int64) + 128
    step = np.where(np.arange(g.shN.shape[1]) < 3, _SH1_STEP, _SH_STEP)[:, None]
    sh = np.clip((sh + step // 2) // step * step, 0, 255).astype(np.uint8)
    return [
        np.ascontiguousarray(positions),
        to_byte(255.0 * sigmoid(g.opacity_logits)),
        to_byte(255.0 * (_COLOR * g.sh0.astype(np.float64) + 0.5)),
        to_byte((g.log_scales.astype(np.float64) + 10.0) * 16.0),
        _packed_quats(g.quats),
        sh,
    ]


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """Pack into 32 bits each [N]: index of the largest of (x, y, z, w), then sign and 9 bits of each of the others."""
    q = unit_quats(quats)[:, [1, 2, 3, 0]]
    rows, largest = np.arange(len(q)), np.abs(q).argmax(axis=1)
    q *= np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    word = largest.astype(np.uint32)
    for i in range(4):
        magnitude = np.minimum(np.floor(_WORDS * np.abs(q[:, i]) / _ROOT + 0.5), _WORDS).astype(np.uint32)
        field = ((q[:, i] < 0).astype(np.uint32) << np.uint32(9)) | magnitude
        word = np.where(largest == i, word, (word << np.uint32(10)) | field)
    return word.astype("<u4")


def _losses(g: Gaussians) -> tuple[str, ...]:
    """Return messages about splats that clamping changed by more than rounding."""
    thin = (g.log_scales[:, :2] < -10.0 - 1 / 32).any(axis=1)
    wide = (g.log_scales > 255 / 16 - 10.0 + 1 / 32).any(axis=1)
    vivid = (np.abs(_COLOR * g.sh0.astype(np.float64)) > 0.5 + 0.5 / 255).any(axis=1)
    steep = (np.abs(g.shN) > 1.0).any(axis=(1, 2)) if g.shN.size else np.zeros(len(g), bool)
    every = (
        (thin, "smaller than 4.5e-5 units"),
        (wide, "larger than 379 units"),
        (vivid, "colours far beyond black or white"),
        (steep, "colours that change too much with the view (SH beyond 1)"),
    )
    lines = []
    if clipped := int((thin | wide | vivid | steep).sum()):
        parts = ", ".join(f"{int(rows.sum()):,} {text}" for rows, text in every if rows.any())
        lines.append(f"{clipped:,} of {len(g):,} splats exceed the range of SPZ and were clipped: {parts}")
    if thick := int((g.log_scales[:, :2].max(axis=1, initial=-np.inf) + np.log(THIN) < -10.0).sum()):
        lines.append(
            f"{thick:,} of {len(g):,} disks are less than four times as wide as thick in SPZ (4.5e-5 units), so other "
            "programs do not show them flat; choose another format"
        )
    return tuple(lines)


def read_spz(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> tuple[Gaussians, int]:
    """Read SPZ of version 2, 3 or 4; returns (Gaussians, version).

    The smallest scale of SPZ, 4.5e-5 units, is read as the thickness of a disk if it is the third. ``warn`` receives a
    message if SH bands above degree 3 are dropped. Raises DataError if the file is missing, of another kind or version,
    or truncated, and BackendError for version 4 without zstandard.
    """
    packed = read_bytes(path)
    version, bits, system, parts = (_parts_of_4 if packed[:4] == b"NGSP" else _parts_of_3)(path, packed)
    return _in_our_axes(_gaussians(path, version, bits, parts, warn), system), version


def _in_our_axes(g: Gaussians, system: int) -> Gaussians:
    """Convert splats from a coordinate system of the format, 1 to 16, to right, down, front.

    The bits of the number minus 1 mean: right (else left), up (else down), front (else back). Numbers above 8 (LFD to
    RBU) are the first eight after a rotation by 90 degrees about x. It is applied after the signs, as in the format's
    library, which therefore differs by 180 degrees about x from the axes that LFD, RFD, LBU and RBU name.
    """
    right, up, front, turned = (system - 1 >> bit & 1 for bit in range(4))
    g = mirrored(g, (1 if right else -1, -1 if up else 1, 1 if front else -1))
    return placed(g, _QUARTER) if turned else g


def _system(path: str | os.PathLike[str], records: bytes) -> int:
    """Return the coordinate system in the records, or right, up, back; records of other types are ignored."""
    system, at = _RUB, 0
    while at + _RECORD.size <= len(records):
        kind, size = _RECORD.unpack_from(records, at)
        content = records[at + _RECORD.size : at + _RECORD.size + size]
        at += _RECORD.size + size
        if kind == _COORDINATES:
            system = int.from_bytes(content, "little") or _RUB
            if len(content) != 4 or system > _SYSTEMS:
                raise DataError(
                    f"{os.fspath(path)}: expected an SPZ coordinate system from 1 to {_SYSTEMS} in 4 bytes, got "
                    f"{system} in {len(content)}; export it again"
                )
    return system


def _sizes(version: int, degree: int) -> list[int]:
    """Return the bytes per splat of each stream."""
    return [9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((degree + 1) ** 2 - 1)]


def _parts_of_3(path: str | os.PathLike[str], tail: bytes) -> tuple[int, int, int, list[np.ndarray]]:
    """Return version, fractional bits, coordinate system and streams [N, bytes] of a gzip file."""
    unpack = zlib.decompressobj(16 + zlib.MAX_WBITS)
    header = _unpacked(path, unpack, tail, _HEADER.size)
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack(header)
    if magic != _MAGIC or version not in (2, 3) or degree > _DEGREES or bits > 23:
        raise DataError(
            f"{os.fspath(path)}: expected SPZ of version 2 or 3 with SH degree 0 to {_DEGREES}, got version {version}, "
            f"degree {degree}; convert it to PLY"
        )
    sizes = _sizes(version, degree)
    check_growth(path, len(tail), count * sum(sizes), f"a cloud of splats ({count:,} of them)")
    data = _unpacked(path, unpack, unpack.unconsumed_tail, count * sum(sizes))
    size = _RECORDS if flags & _EXTENDED else 1
    records = _unpacked(path, unpack, unpack.unconsumed_tail, size, or_end=True)  # also verifies gzip's checksum
    parts, at = [], 0
    for size in sizes:
        parts.append(np.frombuffer(data, np.uint8, count * size, at).reshape(count, size))
        at += count * size
    return int(version), bits, _system(path, records) if flags & _EXTENDED else _RUB, parts


def _parts_of_4(path: str | os.PathLike[str], data: bytes) -> tuple[int, int, int, list[np.ndarray]]:
    """Return version, fractional bits, coordinate system and streams [N, bytes] of a file of version 4."""
    header = data[: _HEADER_4.size].ljust(_HEADER_4.size, b"\0")
    _, version, count, degree, bits, flags, streams, at = _HEADER_4.unpack(header)
    sizes = _sizes(4, degree)[: 6 if degree else 5]
    if version != 4 or degree > _DEGREES or bits > 23 or streams not in (len(sizes), 6) or len(data) < _HEADER_4.size:
        raise DataError(
            f"{os.fspath(path)}: expected SPZ of version 2, 3 or 4 with SH degree 0 to {_DEGREES}, got version "
            f"{version}, degree {degree}, {streams} streams in {len(data)} bytes; convert it to PLY"
        )
    check_growth(path, len(data), count * sum(sizes), f"a cloud of splats ({count:,} of them)")
    system = _system(path, data[_HEADER_4.size : at]) if flags & _EXTENDED else _RUB
    begin, parts = at + streams * _SIZES.size, []
    for size in sizes:
        length, unpacked = _SIZES.unpack(data[at : at + _SIZES.size].ljust(_SIZES.size, b"\0"))
        stream = _unzstd(path, data[begin : begin + length], count * size)
        if unpacked != count * size or len(stream) != unpacked:
            raise DataError(
                f"{os.fspath(path)}: expected an SPZ stream of {count * size} bytes, got {len(stream)} with a stated "
                f"size of {unpacked}; copy or export it again"
            )
        parts.append(np.frombuffer(stream, np.uint8).reshape(count, size))
        at, begin = at + _SIZES.size, begin + length
    if not degree:
        parts.append(np.zeros((count, 0), np.uint8))
    return 4, bits, system, parts


def _unzstd(path: str | os.PathLike[str], packed: bytes, size: int) -> bytes:
    """Decompress at most ``size`` + 1 bytes of a stream."""
    zstandard = required("spz4", "zstandard", "SPZ of version 4", "use version 3")
    try:
        with zstandard.ZstdDecompressor(max_window_size=_WINDOW).stream_reader(packed) as reader:
            return bytes(reader.read(size + 1))
    except zstandard.ZstdError as error:
        raise DataError(f"{os.fspath(path)}: expected SPZ, but its zstd is broken ({error}); copy it again") from error


def _gaussians(path: str | os.PathLike[str], version: int, bits: int, parts: list[np.ndarray], warn: Warn) -> Gaussians:
    """Dequantize splats, in the coordinates of the file."""
    count = len(parts[0])
    positions, alphas, colors, scales, rotations, sh = parts
    low = positions.reshape(count, 3, 3).astype(np.int32)
    fixed = low[..., 0] | (low[..., 1] << 8) | (low[..., 2] << 16)
    fixed = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed)
    sh = drawn_bands(path, sh.reshape(count, sh.shape[1] // 3, 3), warn)
    log_scales = scales.astype(np.float32) / 16.0 - 10.0
    thinnest = scales[:, 2] == 0
    log_scales[thinnest] = with_thickness(log_scales[thinnest, :2])
    return Gaussians(
        (fixed / float(1 << bits)).astype(np.float32),
        _old_quats(rotations) if version == 2 else _quats(rotations),
        log_scales,
        logit_of_byte(alphas[:, 0]),
        ((colors.astype(np.float64) / 255.0 - 0.5) / _COLOR).astype(np.float32),
        (sh.astype(np.float32) - 128.0) / 128.0,
    )


def _unpacked(path: str | os.PathLike[str], unpack: Any, packed: bytes, size: int, *, or_end: bool = False) -> bytes:
    """Decompress the next ``size`` bytes, or fewer at the end of the file with ``or_end``."""
    try:
        data = bytes(unpack.decompress(packed, size)) if size else b""
    except zlib.error as error:
        raise DataError(f"{os.fspath(path)}: expected SPZ, but its gzip is broken ({error}); copy it again") from error
    if len(data) < size and not (or_end and unpack.eof):
        raise DataError(
            f"{os.fspath(path)}: expected SPZ, but the file ends early ({size} more bytes expected, {len(data)} left); "
            "copy or export it again"
        )
    return data


def _quats(rotations: np.ndarray) -> np.ndarray:
    word = rotations.copy().view("<u4")[:, 0].astype(np.uint32)
    largest = (word >> np.uint32(30)).astype(int)
    q = np.zeros((len(word), 4))
    for i in (3, 2, 1, 0):
        value = _ROOT * (word & np.uint32(_WORDS)) / _WORDS
        value = np.where((word >> np.uint32(9)) & np.uint32(1), -value, value)
        stored = largest != i
        q[stored, i] = value[stored]
        word = np.where(stored, word >> np.uint32(10), word)
    return _completed(q, largest)


def _old_quats(rotations: np.ndarray) -> np.ndarray:
    q = np.zeros((len(rotations), 4))
    q[:, :3] = rotations / 127.5 - 1.0
    return _completed(q, np.full(len(q), 3))


def _completed(q: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Complete (x, y, z, w) whose ``largest`` component is not stored, and return (w, x, y, z)."""
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(0.0, 1.0 - np.square(q).sum(axis=1)))
    return q[:, [3, 0, 1, 2]].astype(np.float32)


register_format("spz", ending=".spz")(lambda path, splats: write_spz(path, Gaussians.of(splats)))
register_format("spz4", ending=".spz")(lambda path, splats: write_spz(path, Gaussians.of(splats), version=4))


@register_splat_reader("spz", endings=(".spz",))
def _read(path: str | os.PathLike[str], warn: Warn) -> tuple[Gaussians, str]:
    gaussians, version = read_spz(path, warn)
    return gaussians, f"SPZ version {version}"
