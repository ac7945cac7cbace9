"""OpenEXR files: scene-linear floats, of photographs and depth maps. Needs OpenEXR, of the extra ``exr``.

A header is read here, before anything is decoded: size and channels that it announces are compared with its bytes.
Layout: the OpenEXR file layout (https://openexr.com/en/latest/OpenEXRFileLayout.html).
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import struct
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from gs2d.core.extras import install
from gs2d.core.growth import check_growth
from gs2d.core.light import display_values
from gs2d.errors import DataError

SUFFIX = ".exr"
MAGIC = b"\x76\x2f\x31\x01"
PARTS, DEEP = 0x1000, 0x0800  # bits of the version
MOST_HEADER = 1 << 20  # bytes; a preview is among them
_SIZES = (4, 2, 4)  # bytes of whole numbers, halves and floats
_ONE = threading.Lock()
_SAID = re.compile(r"\(EXR_ERR_\w+\) (.*)|^Warning: (Exception raised .*)")  # its C library, and its bindings
_REMEDY = "write it again as one part of scan lines or tiles"


@dataclass(frozen=True)
class Header:
    """Size of a picture, px, and its channels by name: bytes of a pixel."""

    width: int
    height: int
    channels: Mapping[str, int]


def is_exr(path: str | os.PathLike[str]) -> bool:
    """Whether a file is called as one of OpenEXR."""
    return os.fspath(path).lower().endswith(SUFFIX)


def read_header(path: str | os.PathLike[str]) -> Header:
    """Return what a file announces.

    Raises
    ------
    DataError
        Missing, no OpenEXR file of one part of pixels, or one that announces more than its bytes can hold.
    """
    name = os.fspath(path)
    try:
        with open(path, "rb") as file:
            data, packed = file.read(MOST_HEADER), os.fstat(file.fileno()).st_size
    except FileNotFoundError as error:
        raise DataError(f"image {name} does not exist") from error
    except OSError as error:
        raise DataError(f"cannot read {name}: {error.strerror or error}") from error
    try:
        header = _parsed(data, name)
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        raise DataError(f"{name} must be an OpenEXR file, got: {error}; copy it again, or {_REMEDY}") from error
    pixels = header.width * header.height
    # Decoded floats of all channels, and the picture that is made of them.
    announced = f"an image ({header.width}x{header.height}, {len(header.channels)} channels)"
    check_growth(path, packed, pixels * 4 * (len(header.channels) + 4), announced)
    return header


def _parsed(data: bytes, name: str) -> Header:
    """Return the header in the first bytes of a file (ValueError, struct.error: it is none)."""
    if data[:4] != MAGIC:
        raise ValueError("other first bytes")
    flags = struct.unpack_from("<I", data, 4)[0]
    if flags & (PARTS | DEEP):
        raise DataError(f"{name} must be one part of plain pixels, got several or deep ones; {_REMEDY}")
    at, found = 8, dict[str, bytes]()
    while data[at] != 0:
        key, at = _word(data, at)
        _, at = _word(data, at)
        size = struct.unpack_from("<i", data, at)[0]
        if not 0 <= size <= len(data) - at - 4:
            raise ValueError(f"an attribute {key!r} of {size} bytes")
        found[key], at = data[at + 4 : at + 4 + size], at + 4 + size
    missing = [key for key in ("dataWindow", "displayWindow", "channels") if key not in found]
    if missing:
        raise ValueError(f"no {missing[0]} in its header")
    if found["dataWindow"] != found["displayWindow"]:
        raise DataError(f"{name} must show its whole display window, got another data window; write it again uncropped")
    left, top, right, bottom = struct.unpack("<4i", found["dataWindow"])
    if right < left or bottom < top:
        raise ValueError(f"a dataWindow from {left}, {top} to {right}, {bottom}")
    return Header(right - left + 1, bottom - top + 1, _channels(found["channels"]))


def _channels(data: bytes) -> dict[str, int]:
    """Return the channels of a list: bytes of a pixel by name."""
    at, found = 0, dict[str, int]()
    while data[at] != 0:
        name, at = _word(data, at)
        kind, _, across, down = struct.unpack_from("<iIii", data, at)
        if not 0 <= kind < len(_SIZES) or (across, down) != (1, 1):
            raise ValueError(f"a channel {name!r} of type {kind}, sampled every {across}x{down} pixels")
        found[name], at = _SIZES[kind], at + 16
    return found


def _word(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("utf-8"), end + 1


def read_channels(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Decode all channels of a file, each float32 [H, W], by name.

    Raises
    ------
    DataError
        As :func:`read_header`, OpenEXR is not installed, or the pixels do not decode.
    """
    header, name = read_header(path), os.fspath(path)
    library = _required(name)
    try:
        with _listening() as said:
            decoded: Mapping[str, Any] = library.File(name, separate_channels=True).channels()
        found = {key: np.asarray(channel.pixels, dtype=np.float32) for key, channel in decoded.items()}
    except Exception as error:  # whatever its bindings make of a damaged file
        raise DataError(f"image {name} does not decode: {_first_line(error)}; replace or remove the file") from error
    if said:  # the pixels that it gives then are not those of the file
        raise DataError(f"image {name} does not decode: {said[0]}; replace or remove the file")
    if {key: pixels.shape for key, pixels in found.items()} != dict.fromkeys(
        header.channels, (header.height, header.width)
    ):
        raise DataError(f"image {name} must hold the channels of its header, got others; replace or remove the file")
    return found


def _required(name: str) -> Any:
    """Return OpenEXR; lazily, because it is optional."""
    try:
        return importlib.import_module("OpenEXR")
    except ImportError as error:
        raise DataError(f"{name} needs OpenEXR, which is not installed; {install('exr')}") from error


@contextlib.contextmanager
def _listening() -> Iterator[list[str]]:
    """Take what the library says on the terminal: that is all it does about pixels that it cannot decode.

    Its C library writes to stderr, its bindings to Python's stdout. Both are those of the whole process: one picture
    at a time, and what others say meanwhile is said afterwards.
    """
    said: list[str] = []
    with _ONE, _scratch() as file:
        words = io.StringIO()
        kept = None
        with contextlib.suppress(OSError):  # closed
            kept = os.dup(2)
            os.dup2(file.fileno(), 2)
        try:
            with contextlib.redirect_stdout(words):
                yield said
        finally:
            if kept is not None:
                os.dup2(kept, 2)
                os.close(kept)
            file.seek(0)
            errors = file.read().decode("utf-8", "surrogateescape")
            for text, say in ((errors, _say_error), (words.getvalue(), _say)):
                for line in text.splitlines(keepends=True):
                    match = _SAID.search(line)
                    if match is None:
                        say(line)
                    else:
                        said.append(match[1] or match[2])


def _say(line: str) -> None:
    if sys.stdout is not None:
        sys.stdout.write(line)


def _say_error(line: str) -> None:
    os.write(2, line.encode("utf-8", "surrogateescape"))


def _scratch() -> IO[bytes]:
    """Return a file in memory, where the system has such."""
    if hasattr(os, "memfd_create"):
        return open(os.memfd_create("exr"), "w+b")
    return tempfile.TemporaryFile()


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def display_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode a photograph of linear light: uint8 [H, W, 3], or [H, W, 4] with straight alpha, sRGB values.

    R, G, B (or Y alone) are linear with 1 as white: what is brighter is clipped, what is below 0 or no number is black.
    Colours lie premultiplied by A in the file. Primaries are taken to be those of sRGB.

    Raises
    ------
    DataError
        As :func:`read_channels`, or there is no R, G and B and no Y.
    """
    channels = read_channels(path)
    names = ("R", "G", "B") if {"R", "G", "B"} <= channels.keys() else ("Y",) * 3
    if names[0] not in channels:
        have = ", ".join(sorted(channels)) or "none"
        raise DataError(f"{os.fspath(path)} must have the channels R, G and B, or Y, got {have}; export colours")
    return display_values(np.stack([channels[name] for name in names], axis=-1), channels.get("A"), associated=True)


def grey_values(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the numbers of a map, float32 [H, W], as they are: the channel Z, else Y, else the only one.

    Raises
    ------
    DataError
        As :func:`read_channels`, or there are several channels and neither Z nor Y.
    """
    channels = read_channels(path)
    of_depth: list[str] = [key for key in ("Z", "Y") if key in channels]
    names = of_depth or list[str](channels)
    if not of_depth and len(names) != 1:
        have = ", ".join(sorted(channels)) or "none"
        raise DataError(f"{os.fspath(path)} must have a channel Z or Y, or a single one, got {have}; export depths")
    return channels[names[0]]
