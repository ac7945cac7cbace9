"""Masks of images: where they are, and what a black pixel means.

White = keep. A black pixel is *ignored* (never used), or *empty* (transparent, as alpha 0).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gs2d.data.file_names import Files, folded, in_any_case
from gs2d.errors import DataError

IGNORE, EMPTY, OFF = "ignore", "empty", "off"
MASKED = (IGNORE, EMPTY, OFF)
FOLDER = "masks"
ENDING = "_mask"  # a_mask.png for a.jpg: Metashape and others
LAYER = ".mask.png"  # a.jpg.mask.png for a.jpg: RealityCapture
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_NAMED, _BESIDE = "the camera file", "the image folder"


@dataclass(frozen=True)
class Masks:
    """Masks of a capture."""

    folder: Path | None = None  # folder set by the user; None: the usual folders
    # "ignore", "empty", "off" or None; meaning of a black pixel; None: ignored if the protocol uses masks
    masked: str | None = None
    found: int = 0  # number of views with a mask

    def __post_init__(self) -> None:
        if self.masked not in (None, *MASKED):
            raise DataError(f"masked must be one of {', '.join(MASKED)}, got {self.masked}")

    def options(self) -> dict[str, Any]:
        """Return the options set by the user, as keyword arguments of ``load_scene``."""
        options = {"masks": self.folder, "masked": self.masked}
        return {name: value for name, value in options.items() if value is not None}

    @property
    def requested(self) -> bool:
        """Whether the user requests masks, whatever the protocol."""
        return self.masked == IGNORE or (self.masked is None and self.folder is not None)


def _spellings(name: str) -> list[str]:
    """Return the possible names of the mask of ``a/b.jpg`` in a folder of masks, most likely first.

    ``a/b.jpg.png`` (COLMAP), ``a/b.png``, those of ``_beside``, and ``a/b.jpg``.
    """
    stem = os.path.splitext(name)[0]
    return [f"{name}.png", f"{stem}.png", *_beside(name), name, *(f"{stem}{suffix}" for suffix in _SUFFIXES[1:])]


def _beside(name: str) -> list[str]:
    """Return the possible names of the mask of ``b.jpg`` in its own folder: ``b_mask.png``, ``b.jpg.mask.png``."""
    return [*(f"{os.path.splitext(name)[0]}{ENDING}{suffix}" for suffix in _SUFFIXES), f"{name}{LAYER}"]


def without_masks(paths: Sequence[Path]) -> list[Path]:
    """Return the images that are not the mask of another one in the same folder."""
    masks = {(path.parent, folded(mask)) for path in paths for mask in _beside(path.name)}
    return [path for path in paths if (path.parent, folded(path.name)) not in masks]


def find_masks_in(folders: Sequence[Path], names: Sequence[str]) -> list[Path | None]:
    """Return the mask of each image below some folders, or None."""
    return [match.path for match in Files(folders).match([_spellings(name) for name in names], moved=False)]


def _masks_beside(images: Sequence[Path]) -> list[Path | None]:
    """Return the mask of each image in its own folder, or None."""
    parents: dict[Path, dict[str, Path]] = {image.parent: {} for image in images}
    for parent, files in parents.items():
        files.update((folded(entry.name), Path(entry.path)) for entry in os.scandir(parent) if entry.is_file())
    masks = [[parents[image.parent].get(folded(mask)) for mask in _beside(image.name)] for image in images]
    return [next((path for path in paths if path is not None), None) for paths in masks]


def find_masks(
    names: Sequence[str], images: Sequence[Path], named: Sequence[Path | None], homes: Sequence[Path], masks: Masks
) -> tuple[list[Path | None], str]:
    """Return the mask of each image, and a note ("" without masks).

    ``names``: names of the images, with ``/``. ``images``: image files. ``named``: masks named by the capture, which
    take precedence. ``homes``: folders that may hold a folder ``masks``. Raises DataError if the folder set by the user
    has no mask of any image.
    """
    if masks.masked == OFF:
        return [None] * len(names), "masks are not used (--masked off)" if any(named) else ""
    if masks.folder is not None:
        folders = [masks.folder]
        places: dict[str, Sequence[Path | None]] = {str(masks.folder): find_masks_in(folders, names)}
    else:
        folders = [folder for home in dict.fromkeys(homes) if (folder := in_any_case(home, FOLDER)).is_dir()]
        places = {_NAMED: named, FOLDER: find_masks_in(folders, names), _BESIDE: _masks_beside(images)}
    chosen: list[Path | None] = [None] * len(names)
    counts: Counter[str] = Counter()
    for where, paths in places.items():
        for index, path in enumerate(paths):
            if path is not None and chosen[index] is None:
                chosen[index] = path
                counts[where] += 1
    count = counts.total()
    if masks.folder is not None and not count:
        raise DataError(
            f"{masks.folder} must hold masks of the images, got none for {len(names)} images; expected for example "
            f"{names[0]}.png, {Path(names[0]).with_suffix('.png')} or {Path(names[0]).stem}{ENDING}.png"
        )
    if not count:
        unused = "" if masks.masked is None else f": --masked {masks.masked} has no effect"
        line = f"masks: none of {len(names)} views has one in {FOLDER} (a/b.jpg.png for a/b.jpg){unused}"
        return chosen, line if folders or unused else ""
    in_what = " and ".join(counts)
    rest = f"; the other {len(names) - count} are whole" if count < len(names) else ""
    meaning = ", the rest is empty" if masks.masked == EMPTY else ", the rest is ignored" if masks.requested else ""
    return chosen, f"masks: {count} of {len(names)} views have one in {in_what} (white = keep{meaning}){rest}"
