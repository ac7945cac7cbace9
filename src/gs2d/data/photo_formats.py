"""Image formats that need another package or are not supported."""

from __future__ import annotations

import contextlib
import importlib

from PIL import features


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
