"""Formats of photographs that are not read, or only with another package, and what to do about them."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util

from PIL import features

from gs2d.core.extras import install
from gs2d.data import exr


def _reads_heif() -> bool:
    """Let Pillow read HEIC with a package of the user; none is a dependency, because their wheels hold LGPL code."""
    for name in ("pi_heif", "pillow_heif"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name).register_heif_opener()
            return True
    return False


AVIF = (".avif",) if "avif" in features.modules and features.check("avif") else ()  # Pillow 11.3 and newer
HEIF = (".heic", ".heif") if _reads_heif() else ()
EXR = (exr.SUFFIX,) if importlib.util.find_spec("OpenEXR") is not None else ()
_ALL_HEIF = (".heic", ".heif")
_RAWS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
#: extensions of photographs that are not read here
UNREAD = tuple(suffix for suffix in (*_ALL_HEIF, ".avif", exr.SUFFIX, *_RAWS) if suffix not in (*AVIF, *HEIF, *EXR))


def remedy(suffix: str) -> str:
    """Return what to do about photographs with an extension of ``UNREAD``, in lower case."""
    convert = f"convert them to JPEG (magick mogrify -format jpg *{suffix})"
    if suffix in _ALL_HEIF:
        return f"pip install pi-heif (its wheel holds LGPL code), or {convert}"
    if suffix == exr.SUFFIX:
        return f"{install('exr')} to have OpenEXR read"
    if suffix == ".avif":
        return f"install Pillow 11.3 or newer, or {convert}"
    return "raw files are not developed here; export JPEG or PNG from your photo program"
