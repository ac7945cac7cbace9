"""OpenEXR files: scene-linear floats, of photographs and depth maps. Needs OpenEXR, of the extra ``exr``."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from gs2d.core.extras import install
from gs2d.core.growth import check_growth
from gs2d.core.light import display_values
from gs2d.errors import DataError

SUFFIX = ".exr"
_ONE = threading.Lock()


def is_exr(path: str | os.PathLike[str]) -> bool:
    """Return whether a file has the extension of OpenEXR."""
    return os.fspath(path).lower().endswith(SUFFIX)


def read_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return (width, height), px, from the header of a file.

    Raises
    ------
    DataError
        OpenEXR is not installed, or the file is missing, damaged, not one part of plain pixels, or announces more
        pixels than its bytes can hold.
    """
    name = os.fspath(path)
    file = _open(name, header_only=True)
    header = file.header()
    if len(file.parts) != 1 or "deep" in str(header.get("type")):
        raise DataError(
            f"{name} must be one part of plain pixels, got several or deep ones; write it again as one part of scan "
            "lines or tiles"
        )
    (left, top), (right, bottom) = header["dataWindow"]
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise DataError(f"{name} must show its whole display window, got another data window; write it again uncropped")
    width, height, channels = int(right) - int(left) + 1, int(bottom) - int(top) + 1, len(header["channels"])
    # Decoded floats of all channels, and the image that is made of them.
    announced = f"an image ({width}x{height}, {channels} channels)"
    check_growth(path, os.path.getsize(path), width * height * 4 * (channels + 4), announced)
    return width, height


def read_channels(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Decode all channels of a file, each float32 [H, W], by name.

    Raises
    ------
    DataError
        As :func:`read_size`, or the pixels do not decode.
    """
    name, (width, height) = os.fspath(path), read_size(path)
    file = _open(name, header_only=False)
    found = {key: np.asarray(channel.pixels, dtype=np.float32) for key, channel in file.channels().items()}
    if any(pixels.shape != (height, width) for pixels in found.values()):
        raise DataError(f"image {name} must have channels of {width}x{height} pixels; write it again without sampling")
    return found


def _open(name: str, *, header_only: bool) -> Any:
    """Return OpenEXR's ``File``, which has at least one part."""
    if not os.path.exists(name):
        raise DataError(f"image {name} does not exist")
    try:
        library: Any = importlib.import_module("OpenEXR")
    except ImportError as error:
        raise DataError(f"{name} needs OpenEXR, which is not installed; {install('exr')}") from error
    with _quiet() as printed:
        try:
            file = library.File(name, separate_channels=True, header_only=header_only)
            why = "" if file.parts else printed.getvalue()  # it drops a part whose pixels do not decode, and prints
        except Exception as error:  # whatever it makes of a damaged file
            why = str(error) or type(error).__name__
    if why:
        raise DataError(f"image {name} does not decode: {why.splitlines()[0]}; replace or remove the file")
    return file


@contextlib.contextmanager
def _quiet() -> Iterator[io.StringIO]:
    """Yield what is printed; stderr, to which the C library writes lines of its own, is dropped."""
    with _ONE, open(os.devnull, "w") as null, contextlib.redirect_stdout(io.StringIO()) as printed:
        kept = os.dup(2)
        os.dup2(null.fileno(), 2)
        try:
            yield printed
        finally:
            os.dup2(kept, 2)
            os.close(kept)


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
