"""TIFF photographs of floats: linear light with 1 as white, as OpenEXR's.

Pillow, which cannot decode them, reads their tags; tifffile, of the extra ``exr``, decodes.
"""

from __future__ import annotations

import importlib
import logging
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import TiffImagePlugin

from gs2d.core.extras import install
from gs2d.core.growth import check_growth
from gs2d.core.light import display_values
from gs2d.core.text import first_line
from gs2d.errors import DataError

SUFFIXES = (".tif", ".tiff")
_WIDTH, _HEIGHT, _SAMPLES, _FORMAT = 256, 257, 277, 339  # tags
_FLOATS = 3  # of _FORMAT
_ASSOCIATED = 1  # alpha that the colours are multiplied by
_BRIGHT = 0.5  # of the values beyond white: then 1 is not white in this file


@dataclass(frozen=True)
class Header:
    """Size of an image of floats, px, and how many samples a pixel has."""

    width: int
    height: int
    samples: int


def float_header(path: str | os.PathLike[str]) -> Header | None:
    """Return what the first directory of a TIFF of floats announces, or None for any other file, damaged ones too."""
    if not os.fspath(path).lower().endswith(SUFFIXES):
        return None
    try:
        with open(path, "rb") as file:
            head = file.read(8)
            head += file.read(8) if head[2:3] == b"+" else b""  # BigTIFF
            tags = TiffImagePlugin.ImageFileDirectory_v2(head)
            file.seek(tags.next)
            tags.load(file)
        width, height, samples = (int(tags.get(tag, 1)) for tag in (_WIDTH, _HEIGHT, _SAMPLES))
        floats = tags.get(_FORMAT, (0,))[0] == _FLOATS
    except Exception:  # whatever Pillow makes of a damaged file; whoever decodes it says what is wrong
        return None
    return Header(width, height, samples) if floats and min(width, height) > 0 else None


def display_image(path: str | os.PathLike[str], header: Header) -> np.ndarray:
    """Decode a photograph of linear light: uint8 [H, W, 3], or [H, W, 4] with straight alpha, sRGB values.

    One sample (grey) or three, with alpha or without; else as :func:`gs2d.data.exr.display_image`.

    Raises
    ------
    DataError
        tifffile is not installed, the pixels do not decode, or most of them are beyond white.
    """
    name = os.fspath(path)
    pixels = header.width * header.height
    announced = f"an image ({header.width}x{header.height}, {header.samples} floats)"
    check_growth(path, os.stat(path).st_size, pixels * header.samples * 8, announced)
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
        why = first_line(error)
        raise DataError(
            f"image {name} does not decode: {why}; write it unpacked, or by Deflate without a predictor"
        ) from error
    if axes == "SYX":
        values = np.moveaxis(values, 0, -1)
    return values[..., None] if values.ndim == 2 else values, _ASSOCIATED in extra
