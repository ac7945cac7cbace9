"""Image files: reading, writing, and sizes from headers."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import logging
import os
from collections.abc import Iterator
from functools import cache
from typing import IO

import numpy as np
from PIL import Image, features

from gs2d.core.atomic_files import atomic_write
from gs2d.core.growth import check_growth
from gs2d.core.image_arrays import to_uint8
from gs2d.core.text import first_line
from gs2d.errors import DataError, ShapeError


def _reads_heif() -> bool:
    """Register HEIC with Pillow if a package is installed; none is a dependency because their wheels hold LGPL code."""
    for name in ("pi_heif", "pillow_heif"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name).register_heif_opener()
            return True
    return False


AVIF = (".avif",) if "avif" in features.modules and features.check("avif") else ()  # Pillow 11.3 and newer
HEIF = (".heic", ".heif") if _reads_heif() else ()
_ALL_HEIF = (".heic", ".heif")
_UNSUPPORTED = (".exr", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
#: suffixes of images that cannot be read
UNREAD = tuple(suffix for suffix in (*_ALL_HEIF, ".avif", *_UNSUPPORTED) if suffix not in (*AVIF, *HEIF))


def remedy(suffix: str) -> str:
    """Return what to do about images with a suffix of ``UNREAD``, in lower case."""
    convert = f"convert them to JPEG (magick mogrify -format jpg *{suffix})"
    if suffix in _ALL_HEIF:
        return f"pip install pi-heif (its wheel holds LGPL code), or {convert}"
    if suffix == ".avif":
        return f"install Pillow 11.3 or newer, or {convert}"
    if suffix == ".exr":
        return convert
    return "raw files are not supported; export JPEG or PNG from your photo program"


#: Formats that Pillow may open. Others are rarely tested or start external programs (EPS: Ghostscript).
FORMATS = ("PNG", "JPEG", "MPO", "TIFF", "WEBP", "AVIF", "HEIF", "BMP", "PPM", "JPEG2000")


def open_image(path: str | os.PathLike[str] | IO[bytes]) -> Image.Image:
    """Open an image of one of ``FORMATS`` and read its header; errors are those of Pillow."""
    _silence_decoders()
    Image.init()  # else Pillow raises KeyError for formats that are not loaded
    return Image.open(path, formats=[name for name in FORMATS if name in Image.OPEN])


@cache
def _silence_decoders() -> None:
    """Keep Pillow and libtiff from printing warnings about damaged files.

    The handlers of libtiff are reached through Pillow's module. On Windows, where libtiff is linked statically, it
    still prints.
    """
    logging.getLogger("PIL").addHandler(logging.NullHandler())
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(importlib.import_module("PIL._imaging").__file__)
        for name in ("TIFFSetErrorHandler", "TIFFSetWarningHandler"):
            handler = getattr(library, name)
            handler.argtypes, handler.restype = (ctypes.c_void_p,), ctypes.c_void_p
            handler(None)


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str], expected: str) -> Iterator[Image.Image]:
    """Open an image; convert any error of Pillow, here or in the body, to DataError."""
    try:
        with open_image(path) as file:
            yield file
    except FileNotFoundError as error:
        raise DataError(f"image {os.fspath(path)} does not exist") from error
    except DataError:
        raise
    except MemoryError as error:  # the JPEG 2000 decoder also raises it for damaged files
        raise DataError(
            f"image {os.fspath(path)} does not fit in memory; it is damaged, or too large for this machine"
        ) from error
    except Exception as error:
        raise DataError(expected.format(path=os.fspath(path), error=_first_line(error))) from error


def _check_pixels(path: str | os.PathLike[str], file: Image.Image, bytes_per_pixel: int) -> None:
    """Raise before decoding an image with implausibly many pixels for its file size."""
    packed = os.stat(path).st_size
    check_growth(path, packed, file.width * file.height * bytes_per_pixel, f"an image ({file.width}x{file.height})")


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return (width, height) of an image file, px, from its header. EXIF orientation is not applied.

    Raises DataError if the file is missing or not an image.
    """
    with _opened(path, "{path} must be an image, got: {error}") as file:
        return file.size


_UNDECODED = "image {path} does not decode: {error}; replace or remove the file"


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode an image.

    EXIF orientation is **not** applied, as in COLMAP: poses refer to the stored pixels. Grey and palette images become
    RGB, 16-bit grey becomes 8-bit. The result is uint8 [H, W, 3], or [H, W, 4] with straight alpha if the file has
    transparency. Raises DataError if the file is missing, truncated, not an image of ``FORMATS``, or has implausibly
    many pixels.
    """
    with _opened(path, _UNDECODED) as file:
        _check_pixels(path, file, 4)
        if file.mode == "F":
            raise DataError(f"image {os.fspath(path)} must hold integers, got floats; save it with 16 bits")
        if file.mode.startswith("I;16") or file.mode == "I":
            grey = np.clip(np.asarray(file, dtype=np.float64) / 257.0, 0, 255)  # 65535 / 255 = 257
            return np.repeat(np.round(grey).astype(np.uint8)[:, :, None], 3, axis=2)
        has_alpha = file.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in file.info
        mode = "RGBA" if has_alpha else "RGB"
        return np.array(file if file.mode == mode else file.convert(mode))  # convert() copies


def read_grey(path: str | os.PathLike[str]) -> tuple[np.ndarray, str]:
    """Decode an image without conversion: its array, [h, w] if grey, and its Pillow mode.

    Raises DataError as for :func:`read_image`.
    """
    with _opened(path, _UNDECODED) as file:
        _check_pixels(path, file, 4)
        return np.asarray(file), file.mode


def read_mask(path: str | os.PathLike[str]) -> np.ndarray:
    """Decode a mask: bool [H, W], True where the image is at least half white and half opaque.

    In a file of zeros and ones, one is white. 8-bit masks compress well, so that more pixels per byte are allowed than
    for photographs.
    """
    with _opened(path, _UNDECODED) as file:
        plain = file.mode in ("1", "L") and "transparency" not in file.info
        if plain:
            _check_pixels(path, file, 1)
            grey = np.array(file.convert("L"))
    if not plain:
        image = read_image(path)
        grey = image[:, :, :3].max(axis=2)
    if grey.max() == 1:
        grey = grey * np.uint8(255)
    if not plain and image.shape[2] == 4:
        grey = np.minimum(grey, image[:, :, 3])
    return np.asarray(grey >= 128)


def _first_line(error: BaseException) -> str:
    if isinstance(error, Image.DecompressionBombError):
        return f"more than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels, which Pillow refuses to decode; shrink it"
    return first_line(error)


def write_image(path: str | os.PathLike[str], image: np.ndarray) -> None:
    """Write a PNG atomically.

    ``path``: its folder must exist. ``image`` [H, W], [H, W, 3] or [H, W, 4]: uint8, bool (white = True), or float in
    [0, 1] (clipped, rounded to the nearest of 256 levels). Raises ShapeError if the shape is wrong or a float image has
    NaN. Raises DiskError if the file could not be written.
    """
    pixels = to_uint8(image)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)):
        raise ShapeError(f"image must be [H, W], [H, W, 3] or [H, W, 4], got {list(pixels.shape)}")
    with atomic_write(path) as file:
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, format="PNG")
