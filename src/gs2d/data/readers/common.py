"""Shared parts of readers: image files by the names in camera files."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gs2d.data.file_names import IMAGES, NO_PHOTOGRAPHS, Files, name_below
from gs2d.data.image_files import UNREAD, remedy
from gs2d.errors import DataError

_NO_NUMBER = re.compile(r"[+-]?(nan\(\w*\)|1\.#\w+)", re.IGNORECASE)
_BOXES = b"ftyp"  # signature of HEIC and AVIF; other files with such a suffix are read by content
_HEAD = 4096  # bytes that identify a file


def head(path: Path) -> bytes:
    """Return the first bytes of a file; b"" if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(_HEAD)
    except OSError:
        return b""


def parsed(text: str) -> float:
    """Parse a number. ``-nan(ind)`` and ``1.#INF``, as C programs on Windows write them, are NaN.

    Raises ValueError if the text is not a number.
    """
    return math.nan if _NO_NUMBER.fullmatch(text) else float(text)


@dataclass(frozen=True)
class ImageFile:
    """The image file of a name in a camera file: path and name in the scene, or the reason why there is none."""

    path: Path | None
    name: str = ""
    reason: str = ""


def find_photographs(
    names: Sequence[str],
    folders: Sequence[Path],
    where: Path,
    *,
    base: Path | None = None,
    homes: Sequence[Path] = (),
    reason: str = "",
) -> dict[str, ImageFile]:
    """Find the image file of each name in a camera file; the suffix is optional (see ``Files`` for the rules).

    ``folders``: folders that may contain the images, most likely first. ``where``: the camera file. ``base``: base
    folder of relative paths. ``homes``: base folders of names in the scene; default: ``folders``. ``reason``: reason
    for a missing file; default: names the camera file. Raises DataError if several files fit a name equally well.
    """
    files = Files(folders, base)
    names = list(dict.fromkeys(names))
    matches = files.match([_spellings(name) for name in names], not_in=NO_PHOTOGRAPHS)
    homes = homes or folders
    paths = [match.path for match in matches if match.path is not None]
    if not any(path.is_relative_to(home) for path in paths for home in homes):
        homes = _shared(paths)
    found = {}
    for name, match in zip(names, matches, strict=True):
        if match.several:
            raise DataError(
                f"{where} must name one image, got {name}, which may be {match.several[0]} or {match.several[1]}; "
                "keep only one of them in the capture, or include the folder in the name"
            )
        if match.path is None:
            why = reason or f"listed in {where.name}, but there is no such file"
            other = files.of_stem(name, IMAGES, NO_PHOTOGRAPHS)
            if other is not None:
                why += f"; {other.parent.name}/{other.name} exists: use its suffix in the camera file"
            found[name] = ImageFile(None, reason=why)
        elif match.path.suffix.lower() in UNREAD and head(match.path)[4:8] == _BOXES:
            suffix = match.path.suffix.lower()
            found[name] = ImageFile(None, reason=f"{suffix[1:].upper()} cannot be read; {remedy(suffix)}")
        else:
            found[name] = ImageFile(match.path, name_below(match.path, homes))
    return found


def _shared(paths: Sequence[Path]) -> list[Path]:
    """Return the common folder of all files, if any."""
    try:
        return [Path(os.path.commonpath([path.parent for path in paths]))]
    except ValueError:  # no files, or on several drives
        return []


def _spellings(name: str) -> list[str]:
    if os.path.splitext(name)[1].lower() in IMAGES:
        return [name]
    return [name, *(name + suffix for suffix in IMAGES)]
