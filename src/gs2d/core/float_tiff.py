"""TIFF photographs of floats: linear light with 1 as white, as OpenEXR's. Needs tifffile, of the extra ``exr``.

Which files these are is read here from their first directory, before anything is decoded: size and samples that it
announces are compared with the file's bytes. Layout: TIFF 6.0, and BigTIFF, whose offsets are twice as long.
"""

from __future__ import annotations

import importlib
import logging
import os
import struct
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from gs2d.core.extras import install
from gs2d.core.growth import check_growth
from gs2d.core.light import display_values
from gs2d.errors import DataError

SUFFIXES = (".tif", ".tiff")
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _FORMAT = 256, 257, 258, 277, 339  # tags
_FLOATS = 3  # of _FORMAT
_MOST_TAGS = 1000
_TYPES = {3: "H", 4: "I", 16: "Q"}
_ASSOCIATED = 1  # alpha that the colours are multiplied by
_BRIGHT = 0.5  # of the values beyond white: then 1 is not white in this file


@dataclass(frozen=True)
class Header:
    """Size of a picture of floats, px, and how many samples of how many bytes a pixel has."""

    width: int
    height: int
    samples: int
    sample_bytes: int


def float_header(path: str | os.PathLike[str]) -> Header | None:
    """Return what a TIFF of floats announces, or None for any other file, damaged ones too."""
    if not os.fspath(path).lower().endswith(SUFFIXES):
        return None
    try:
        with open(path, "rb") as file:
            tags = _tags(file)
    except (OSError, struct.error, KeyError, ValueError):
        return None
    if tags.get(_FORMAT) != _FLOATS or not (tags.get(_WIDTH) and tags.get(_HEIGHT)):
        return None
    return Header(tags[_WIDTH], tags[_HEIGHT], tags.get(_SAMPLES, 1), max(1, tags.get(_BITS, 32) // 8))


def _tags(file: IO[bytes]) -> dict[int, int]:
    """Return the first value of each tag of whole numbers in the first directory (KeyError, ValueError: none)."""
    order = {b"II": "<", b"MM": ">"}[file.read(2)]
    (version,) = struct.unpack(order + "H", file.read(2))
    if version not in (42, 43):
        raise ValueError("no TIFF")
    big = version == 43
    if big:
        file.seek(8)
    (at,) = struct.unpack(order + ("Q" if big else "I"), file.read(8 if big else 4))
    file.seek(at)
    (count,) = struct.unpack(order + ("Q" if big else "H"), file.read(8 if big else 2))
    layout = order + ("HHQ8s" if big else "HHI4s")
    found: dict[int, int] = {}
    for entry in struct.iter_unpack(layout, file.read(min(count, _MOST_TAGS) * struct.calcsize(layout))):
        tag, kind, number, value = entry
        if (letter := _TYPES.get(kind)) is None or not number:
            continue
        size = struct.calcsize(letter)
        if number * size > len(value):  # they lie elsewhere
            file.seek(struct.unpack(order + ("Q" if big else "I"), value)[0])
            value = file.read(size)
        found[tag] = struct.unpack(order + letter, value[:size])[0]
    return found


def display_image(path: str | os.PathLike[str], header: Header) -> np.ndarray:
    """Decode a photograph of linear light: uint8 [H, W, 3], or [H, W, 4] with straight alpha, sRGB values.

    One sample (grey) or three, with alpha or without; else as :func:`gs2d.core.exr.display_image`.

    Raises
    ------
    DataError
        tifffile is not installed, the pixels do not decode, or most of them are beyond white.
    """
    name = os.fspath(path)
    pixels = header.width * header.height
    announced = f"an image ({header.width}x{header.height}, {header.samples} floats)"
    check_growth(path, os.stat(path).st_size, pixels * header.samples * max(4, header.sample_bytes), announced)
    values, associated = _decoded(name)
    if values.ndim != 3 or values.shape[:2] != (header.height, header.width) or values.shape[2] not in (1, 2, 3, 4):
        raise DataError(f"image {name} must have one or three colours and alpha at most, got {list(values.shape)}")
    colors = values.shape[2] - (values.shape[2] in (2, 4))
    light, alpha = values[..., :colors], values[..., colors] if values.shape[2] > colors else None
    if (light > 1).mean() > _BRIGHT:
        raise DataError(
            f"image {name} must be linear light with 1 as white, got floats up to {float(light.max()):.4g}, most of "
            "them beyond 1; divide them by the value of white, or write whole numbers of 16 bits"
        )
    return display_values(np.repeat(light, 3, axis=2) if colors == 1 else light, alpha, associated=associated)


def _decoded(name: str) -> tuple[np.ndarray, bool]:
    """Return float32 [H, W, samples] of the first picture, and whether its colours are multiplied by alpha."""
    try:
        library: Any = importlib.import_module("tifffile")
    except ImportError as error:
        raise DataError(f"{name} is a TIFF of floats and needs tifffile; {install('exr')}") from error
    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)  # it tells of each tag that it does not know
    try:
        with library.TiffFile(name) as file:
            page = file.pages[0]
            values = np.asarray(page.asarray(), dtype=np.float32)
            axes, extra = str(page.axes), tuple(page.extrasamples)
    except Exception as error:  # whatever it makes of a damaged file, or of a packing that it lacks a decoder for
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"image {name} does not decode: {why}; write it unpacked, or by Deflate without a predictor"
        ) from error
    if axes == "SYX":
        values = np.moveaxis(values, 0, -1)
    return values[..., None] if values.ndim == 2 else values, _ASSOCIATED in extra
