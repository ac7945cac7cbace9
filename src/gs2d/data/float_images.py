"""OpenEXR images, linear floats with 1 as white, and their conversion to 8-bit sRGB (extra ``exr``)."""

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
from gs2d.errors import DataError

EXR_SUFFIX = ".exr"
_ONE = threading.Lock()


def display_values(light: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:
    """Convert linear light [H, W, 3], premultiplied by ``alpha`` [H, W], to sRGB: uint8 [H, W, 3], or [H, W, 4].

    Values above 1 are clipped; negative values and NaN become black.
    """
    light = np.nan_to_num(light, nan=0.0, posinf=1.0, neginf=0.0)
    if alpha is None:
        return _to_bytes(_encode_srgb(light))
    alpha = np.clip(np.nan_to_num(alpha, nan=0.0), 0.0, 1.0)[..., None]
    straight = np.divide(light, alpha, out=np.zeros_like(light), where=alpha > 0)
    return _to_bytes(np.concatenate([_encode_srgb(straight), alpha], axis=-1))


def _encode_srgb(light: np.ndarray) -> np.ndarray:
    """Return sRGB values in [0, 1] of linear light, clipped to [0, 1] (IEC 61966-2-1)."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(255 * values).astype(np.uint8))


# -- OpenEXR -----------------------------------------------------------------------------------------------------------
def is_exr(path: str | os.PathLike[str]) -> bool:
    """Whether a file has the suffix of OpenEXR."""
    return os.fspath(path).lower().endswith(EXR_SUFFIX)


def exr_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return (width, height), px, from the header of an OpenEXR file.

    Raises
    ------
    DataError
        If OpenEXR is not installed, or the file is missing, damaged, cropped, has several parts or deep pixels, or
        implausibly many pixels for its size.
    """
    name = os.fspath(path)
    file = _open_exr(name, header_only=True)
    header = file.header()
    if len(file.parts) != 1 or "deep" in str(header.get("type")):
        raise DataError(
            f"{name} must have one part of flat pixels, got several parts or deep pixels; save it as one part of scan "
            "lines or tiles"
        )
    (left, top), (right, bottom) = header["dataWindow"]
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise DataError(f"{name} must fill its display window, got another data window; save it uncropped")
    width, height, channels = int(right) - int(left) + 1, int(bottom) - int(top) + 1, len(header["channels"])
    # Decoded floats of all channels, and the image made from them.
    announced = f"an image ({width}x{height}, {channels} channels)"
    check_growth(path, os.path.getsize(path), width * height * 4 * (channels + 4), announced)
    return width, height


def _exr_channels(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Decode all channels, each float32 [H, W], by name."""
    name, (width, height) = os.fspath(path), exr_size(path)
    file = _open_exr(name, header_only=False)
    found = {key: np.asarray(channel.pixels, dtype=np.float32) for key, channel in file.channels().items()}
    if any(pixels.shape != (height, width) for pixels in found.values()):
        raise DataError(f"image {name} must have channels of {width}x{height} pixels; save it without subsampling")
    return found


def _open_exr(name: str, *, header_only: bool) -> Any:
    """Return OpenEXR's ``File``, with at least one part."""
    if not os.path.exists(name):
        raise DataError(f"image {name} does not exist")
    try:
        library: Any = importlib.import_module("OpenEXR")
    except ImportError as error:
        raise DataError(f"{name} needs OpenEXR, which is not installed; {install('exr')}") from error
    with _quiet() as printed:
        try:
            file = library.File(name, separate_channels=True, header_only=header_only)
            why = "" if file.parts else printed.getvalue()  # it prints errors and drops damaged parts
        except Exception as error:  # of any kind, for damaged files
            why = str(error) or type(error).__name__
    if why:
        raise DataError(f"image {name} does not decode: {why.splitlines()[0]}; replace or remove the file")
    return file


@contextlib.contextmanager
def _quiet() -> Iterator[io.StringIO]:
    """Yield what Python prints; drop stderr, to which the C library prints."""
    with _ONE, open(os.devnull, "w") as null, contextlib.redirect_stdout(io.StringIO()) as printed:
        kept = os.dup(2)
        os.dup2(null.fileno(), 2)
        try:
            yield printed
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def read_exr(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode an OpenEXR photograph to sRGB: uint8 [H, W, 3], or [H, W, 4] with straight alpha.

    Reads R, G, B, or Y, with the primaries of sRGB, premultiplied by A.

    Raises
    ------
    DataError
        As for :func:`exr_size`, or if the pixels do not decode or the channels are missing.
    """
    channels = _exr_channels(path)
    names = ("R", "G", "B") if {"R", "G", "B"} <= channels.keys() else ("Y",) * 3
    if names[0] not in channels:
        have = ", ".join(sorted(channels)) or "none"
        raise DataError(f"{os.fspath(path)} must have the channels R, G and B, or Y, got {have}; export colours")
    return display_values(np.stack([channels[name] for name in names], axis=-1), channels.get("A"))


def read_exr_map(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode a map, float32 [H, W]: the channel Z, else Y, else the only channel.

    Raises
    ------
    DataError
        As for :func:`exr_size`, or if there are several channels but neither Z nor Y.
    """
    channels = _exr_channels(path)
    of_depth: list[str] = [key for key in ("Z", "Y") if key in channels]
    names = of_depth[:1] or list(channels)
    if len(names) != 1:
        have = ", ".join(sorted(channels)) or "none"
        raise DataError(f"{os.fspath(path)} must have a channel Z or Y, or a single one, got {have}; export depths")
    return channels[names[0]]
