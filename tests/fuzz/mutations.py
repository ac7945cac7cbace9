"""Mutations of small valid files that know what they change: bytes, words, JSON, ZIP, gzip, PNG, the head of an array.

Every one takes a random generator and bytes and returns bytes. What is packed or carries a checksum is packed again
after the change, so that it reaches the parser behind the checksum; half of the time the packed bytes are changed too.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

Mutation = Callable[[Random, bytes], bytes]

_BYTES = (0x00, 0x01, 0x0A, 0x20, 0x22, 0x2D, 0x30, 0x39, 0x7F, 0x80, 0xB2, 0xFE, 0xFF)
_WHOLE = (0, 1, -1, 2, 255, 256, 65535, 65536, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**62, 2**63 - 1, -(2**63))
_REAL = (0.0, -0.0, 1.0, -1.0, 1e-38, 1e-45, 1e20, 3.4e38, -3.4e38, float("nan"), float("inf"), -float("inf"))
_WORDS = (
    *("0", "-1", "1", "1.5", "-0", "nan", "NaN", "-inf", "Infinity", "1e400", "1e38", "1e-400", "1_0", "0x10", "+3"),
    *("2147483648", "4294967296", "9223372036854775808", "9" * 30, "9" * 400, "7" * 5000, "", " ", "\0", "\u00b2"),
    *(
        "\u0663",
        "a",
        "null",
        "true",
        "[]",
        "{}",
        '""',
        "..",
        "/",
        "../../x",
        "/etc/passwd",
        "x" * 300,
        "\ud7ff",
        "\u202e",
    ),
    *("end_header", "property list float int a", "property list uchar int a", "element vertex 99999999999", "#", "%"),
)
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 0.5, 1e308, -1e308, float("nan"), float("inf"), 10**30, -(10**400), 2**63),
    *("", "a", "..", "../../x", "/etc/passwd", "\u00b2", "nan", "1", "x" * 300, "a\0b", "a\nb", "\x1b[31m", "\ud800"),
    *([], {}, [[]], [None], {"a": None}, [0] * 5, [[1, 0, 0, 0]] * 4, [1e300] * 4, ["a", "b"]),
)


def deep(value: Any, rng: Random) -> Any:
    """Nest a value."""
    for _ in range(rng.choice((1, 3, 100, 300))):
        value = [value] if rng.random() < 0.5 else {"a": value}
    return value


def of_bytes(rng: Random, data: bytes) -> bytes:
    """One to four changes anywhere."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(out) + 1) if rng.random() < 0.6 else min(len(out), int(rng.expovariate(1 / 40)))
        kind = rng.randrange(9)
        if kind == 0 and out:
            out[at % len(out)] ^= 1 << rng.randrange(8)
        elif kind == 1 and out:
            out[at % len(out)] = rng.choice(_BYTES)
        elif kind == 2:
            size = rng.choice((1, 2, 4, 8))
            out[at : at + size] = _whole(rng, size)
        elif kind == 3:
            code = rng.choice(("<f", "<d", ">f", ">d"))
            number = rng.choice(_REAL)
            out[at : at + struct.calcsize(code)] = struct.pack(code, number)
        elif kind == 4:
            del out[at:]
        elif kind == 5:
            del out[at : at + rng.choice((1, 2, 4, 8, 43))]
        elif kind == 6:
            out[at:at] = bytes(rng.choice(_BYTES) for _ in range(rng.choice((1, 2, 4, 8, 100))))
        elif kind == 7:
            start = rng.randrange(len(out) + 1)
            out[at:at] = out[start : start + rng.choice((1, 8, 64, 1000))]
        else:
            start = rng.randrange(len(out) + 1)
            piece = out[start : start + rng.choice((4, 8, 64))]
            out[at : at + len(piece)] = piece
    return bytes(out)


def _whole(rng: Random, size: int) -> bytes:
    number = rng.choice(_WHOLE) % (1 << (8 * size))
    return number.to_bytes(size, rng.choice(("little", "big")))


_TOKEN = re.compile(rb"[^\s,;:\[\]{}<>=\"'/]+")


def of_text(rng: Random, data: bytes) -> bytes:
    """Words become other words; lines are lost, doubled, exchanged or emptied."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        kind = rng.randrange(6)
        words = list(_TOKEN.finditer(data))
        if kind <= 2 and words:
            hit = rng.choice(words[:60] if rng.random() < 0.5 else words)
            word = rng.choice(_WORDS).encode("utf-8", "surrogatepass")
            data = data[: hit.start()] + word + data[hit.end() :]
            continue
        lines = data.split(b"\n")
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        if kind == 3:
            del lines[i]
        elif kind == 4:
            lines.insert(i, lines[j])
        else:
            lines[i], lines[j] = rng.choice((lines[j], b"", lines[i] * 2)), lines[i]
        data = b"\n".join(lines)
    return data


def of_json(rng: Random, data: bytes) -> bytes:
    """Values of another type, lost, renamed and doubled keys, lists that are too short or too long, deep nests."""
    try:
        document = json.loads(data)
    except ValueError:
        return of_text(rng, data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        document = _changed(rng, document)
    data = json.dumps(document).encode("utf-8", "surrogatepass")
    hits = list(_TOKEN.finditer(data))
    if hits and rng.random() < 0.02:  # deeper than Python's own writer goes
        hit, depth = rng.choice(hits), rng.choice((900, 100_000))
        data = data[: hit.start()] + b"[" * depth + b"]" * depth + data[hit.end() :]
    return data


def _changed(rng: Random, value: Any) -> Any:
    """Change one place in a document, reached by going down at random."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(sorted(value))
        kind = rng.randrange(12)
        rest = {k: v for k, v in value.items() if k != key}
        if kind == 0:
            return rest
        if kind == 1:
            return {**rest, rng.choice((key.upper(), key + "_", "a")): value[key]}
        if kind == 2:
            return {**value, key: value[rng.choice(sorted(value))]}
        return {**value, key: _changed(rng, value[key])}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = rng.randrange(len(value))
        kind = rng.randrange(12)
        if kind == 0:
            return value[:at] + value[at + 1 :]
        if kind == 1:
            return value[:at] + [value[at]] * 2 + value[at:]
        if kind == 2:
            return value[:at]
        return [*value[:at], _changed(rng, value[at]), *value[at + 1 :]]
    if isinstance(value, str) and value and rng.random() < 0.3:
        at = rng.randrange(len(value))
        return value[:at] + rng.choice(_WORDS) + value[at + rng.randrange(2) :]
    return deep(value, rng) if rng.random() < 0.05 else rng.choice(_VALUES)


def of_json_lines(rng: Random, data: bytes) -> bytes:
    """A log: one of its lines changes as JSON, or all of it as text."""
    if rng.random() < 0.3:
        return of_text(rng, data)
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at] = of_json(rng, lines[at]) if lines[at] else b"{}"
    return b"\n".join(lines)


def of_gzip(rng: Random, data: bytes) -> bytes:
    """What is inside changes, and is packed again; sometimes it becomes a bomb."""
    inside = of_bytes(rng, gzip.decompress(data))
    if rng.random() < 0.05:
        inside += bytes(rng.choice((1 << 20, 20 << 20)))
    return gzip.compress(inside, 1)


def of_zip(inside: Mutation) -> Mutation:
    """Members change by ``inside``; so do names, methods of packing, and the number of members."""

    def mutate(rng: Random, data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            members = [(info, file.read(info)) for info in file.infolist()]
        method = members[0][0].compress_type
        victim, kind = rng.randrange(len(members)), rng.randrange(12)
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", method) as file:
            for at, (info, content) in enumerate(members):
                new = zipfile.ZipInfo(info.filename)
                new.compress_type, new.external_attr = method, info.external_attr
                if at == victim:
                    if kind == 0:
                        continue
                    if kind == 1:
                        stem, _, end = info.filename.rpartition("/")
                        new.filename = rng.choice(
                            (
                                f"../{end}",
                                f"/tmp/{end}",
                                f"C:\\{end}",
                                "..",
                                ".",
                                "a\\b",
                                f"{stem}/\u00b2",
                                "x" * 300,
                                " ",
                                "con",
                                "a/" * 500,
                            )
                        )
                    elif kind == 2:
                        new.compress_type = rng.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_DEFLATED))
                    elif kind == 3:
                        new.external_attr = rng.choice((0o120777 << 16, 0o060777 << 16, 0o040000 << 16, 0xFFFFFFFF))
                    elif kind == 4 and rng.random() < 0.1:
                        new.compress_type, content = zipfile.ZIP_DEFLATED, bytes(30 << 20)
                    else:
                        content = inside(rng, content)
                file.writestr(new, content)
        packed = out.getvalue()
        return of_bytes(rng, packed) if rng.random() < 0.2 else packed

    return mutate


def of_glb(rng: Random, data: bytes) -> bytes:
    """The JSON changes, with the right lengths before it, or the bytes behind it."""
    if not data.startswith(b"glTF") or rng.random() < 0.3:
        return of_bytes(rng, data)
    (length,) = struct.unpack_from("<I", data, 12)
    text = of_json(rng, data[20 : 20 + length])
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def of_npy(rng: Random, data: bytes) -> bytes:
    """The header's text changes, with the right length before it."""
    if not data.startswith(b"\x93NUMPY") or rng.random() < 0.3:
        return of_bytes(rng, data)
    (length,) = struct.unpack_from("<H", data, 8)
    text = of_text(rng, data[10 : 10 + length]) if rng.random() < 0.7 else of_bytes(rng, data[10 : 10 + length])
    return data[:8] + struct.pack("<H", min(len(text), 65535)) + text + data[10 + length :]


def of_png(rng: Random, data: bytes) -> bytes:
    """A chunk changes, with the right checksum behind it; sizes in the header become larger than the pixels."""
    if not data.startswith(b"\x89PNG") or rng.random() < 0.2:
        return of_bytes(rng, data)
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    victim = rng.randrange(len(chunks))
    kind = rng.randrange(8)
    out = bytearray(data[:8])
    for index, (name, content) in enumerate(chunks):
        if index == victim and kind == 0:
            continue
        if index == victim and kind == 1:
            name = rng.choice((b"tRNS", b"PLTE", b"IDAT", b"IEND", b"zTXt", b"iCCP", b"acTL", b"fcTL", b"eXIf"))
        elif name == b"IHDR" and kind == 2:
            content = struct.pack(">II", rng.choice((1, 9000, 40000, 2**31 - 1)), rng.choice((1, 9000))) + content[8:]
        elif index == victim:
            content = (
                of_bytes(rng, content) if name != b"IDAT" else zlib.compress(of_bytes(rng, zlib.decompress(content)))
            )
        out += struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
    return bytes(out)


def of_ply(rng: Random, data: bytes) -> bytes:
    """The header's words change, or the bytes behind it."""
    end = data.find(b"end_header\n") + 11
    if rng.random() < 0.5:
        return of_text(rng, data[:end]) + data[end:]
    body = of_text(rng, data[end:]) if b"format ascii" in data[:end] else of_bytes(rng, data[end:])
    return data[:end] + body


def either(*mutations: Mutation) -> Mutation:
    """One of several, at random."""

    def mutate(rng: Random, data: bytes) -> bytes:
        return rng.choice(mutations)(rng, data)

    return mutate
