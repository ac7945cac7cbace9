"""From an AVIF image sequence to an MP4 film, without compressing again.

Both are AV1 in the container of ISO/IEC 14496-12 ("boxes"): a sequence is a track of pictures ('pict') in a file of
brand 'avis', a film a track of handler 'vide'. The compressed frames are the same, so only the tables are written anew,
as "AV1 Codec ISO Media File Format Binding" (AOM) has them in its sections 2 and 3.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from gs2d.errors import BackendError

_DELIMITER = b"\x12\x00"  # an OBU that stands before every frame in AV1, and is left out in MP4
_UNITS = 1000  # of time in a frame
_MATRIX = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)  # as it is: no turn, no mirror
_ENTRY = 78  # bytes of a picture's sample entry before its boxes


@dataclass(frozen=True)
class Film:
    """Compressed frames.

    Attributes
    ----------
    width, height : int
        px.
    config : bytes
        The boxes av1C and colr: how to decode, and what the numbers mean.
    samples : list of bytes
        A frame each.
    keys : list of int
        Numbers, from 1, of the frames that need no other.
    """

    width: int
    height: int
    config: bytes
    samples: list[bytes]
    keys: list[int]


def read_sequence(data: bytes) -> Film:
    """Take an AVIF image sequence of one track apart.

    Raises
    ------
    BackendError
        It is laid out in a way that is not known here.
    """
    try:
        table = _children(data)
        for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            table = _children(table[kind])
        entry = _children(table[b"stsd"][8:])[b"av01"]
        width, height = struct.unpack(">HH", entry[24:28])
        inside = _children(entry[_ENTRY:])
        config = b"".join(_box(kind, inside[kind]) for kind in (b"av1C", b"colr"))
        same, count = struct.unpack(">II", table[b"stsz"][4:12])
        sizes = [same] * count if same else list(struct.unpack(f">{count}I", table[b"stsz"][12:]))
        chunks, offset = struct.unpack(">II", table[b"stco"][4:12])
        keys = [key for (key,) in struct.iter_unpack(">I", table[b"stss"][8:])]
        if chunks != 1 or offset + sum(sizes) > len(data):
            raise ValueError(f"{chunks} chunks of {sum(sizes)} bytes from {offset} on in a file of {len(data)}")
    except (KeyError, ValueError, struct.error) as error:
        raise BackendError(
            f"this Pillow writes image sequences in a way that is not known here ({error!r}); name a .webp file instead"
        ) from error
    samples = []
    for size in sizes:
        samples.append(data[offset : offset + size].removeprefix(_DELIMITER))
        offset += size
    return Film(width, height, config, samples, keys)


def film_header(film: Film, fps: float) -> bytes:
    """Everything of an MP4 file that comes before the frames, which follow one after the other."""
    brands = _box(b"ftyp", b"isom", struct.pack(">I", 512), b"isom", b"iso6", b"av01", b"mp41")
    start = len(brands) + len(_tables(film, fps, 0)) + 8
    size = sum(map(len, film.samples))
    return brands + _tables(film, fps, start) + struct.pack(">I4s", 8 + size, b"mdat")


def _tables(film: Film, fps: float, start: int) -> bytes:
    """The box moov; the first frame is ``start`` bytes into the file."""
    count, scale = len(film.samples), round(_UNITS * fps)  # units a second
    length = count * _UNITS
    sizes = struct.pack(f">{count}I", *map(len, film.samples))
    described = _box(b"stsd", struct.pack(">II", 0, 1), _sample_entry(film))
    samples = _box(
        b"stbl",
        described,
        _box(b"stts", struct.pack(">IIII", 0, 1, count, _UNITS)),
        _box(b"stss", struct.pack(f">II{len(film.keys)}I", 0, len(film.keys), *film.keys)),
        _box(b"stsc", struct.pack(">IIIII", 0, 1, 1, count, 1)),
        _box(b"stsz", struct.pack(">III", 0, 0, count), sizes),
        _box(b"stco", struct.pack(">III", 0, 1, start)),
    )
    here = _box(b"dinf", _box(b"dref", struct.pack(">II", 0, 1), _box(b"url ", struct.pack(">I", 1))))
    information = _box(b"minf", _box(b"vmhd", struct.pack(">IQ", 1, 0)), here, samples)
    media = _box(
        b"mdia",
        _box(b"mdhd", struct.pack(">IIIIIHH", 0, 0, 0, scale, length, 0x55C4, 0)),  # language: undetermined
        _box(b"hdlr", struct.pack(">II4s12x", 0, 0, b"vide"), b"gs2d\0"),
        information,
    )
    track = _box(
        b"tkhd",
        struct.pack(">IIIIII8xHHHH", 3, 0, 0, 1, 0, length, 0, 0, 0, 0),  # 3: enabled, in the presentation
        _MATRIX,
        struct.pack(">II", film.width << 16, film.height << 16),
    )
    movie = struct.pack(">IIIIIIH10x", 0, 0, 0, scale, length, 0x10000, 0x100) + _MATRIX + struct.pack(">24xI", 2)
    return _box(b"moov", _box(b"mvhd", movie), _box(b"trak", track, media))


def _sample_entry(film: Film) -> bytes:
    """How the frames are compressed."""
    head = struct.pack(
        ">6xH16xHHIIIH", 1, film.width, film.height, 0x480000, 0x480000, 0, 1
    )  # 72 dpi, 1 frame a sample
    return _box(b"av01", head, bytes([4]) + b"gs2d".ljust(31, b"\0"), struct.pack(">Hh", 24, -1), film.config)


def _box(kind: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def _children(data: bytes) -> dict[bytes, bytes]:
    """Boxes side by side: kind to content."""
    return dict(_boxes(data))


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    start = 0
    while start < len(data):
        size, kind = struct.unpack(">I4s", data[start : start + 8])
        if size < 8:  # 0: to the end, 1: 64 bits; neither is written for files of this size
            raise ValueError(f"a box {kind!r} of {size} bytes")
        yield kind, data[start + 8 : start + size]
        start += size
