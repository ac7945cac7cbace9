"""Masks of photographs: where tools put them, and what a black pixel means.

White = keep. A black pixel is *ignored* (it takes part in nothing), or *empty* (there is nothing, as an alpha channel
of 0 says).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gs2d.errors import DataError

IGNORE, EMPTY, OFF = "ignore", "empty", "off"
MASKED = (IGNORE, EMPTY, OFF)
FOLDER = "masks"
ENDING = "_mask"  # of a mask that lies with the photographs (Metashape's own template, and others)
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif")
_NAMED = "the file of cameras"


@dataclass(frozen=True)
class Masks:
    """Which masks a capture's photographs have.

    Attributes
    ----------
    folder : Path or None
        Where they are, as the user says; None: where tools put them.
    masked : "ignore", "empty", "off" or None
        What a black pixel is; None: ignored, where the protocol looks at masks.
    found : int
        Views that have one.
    """

    folder: Path | None = None
    masked: str | None = None
    found: int = 0

    def __post_init__(self) -> None:
        if self.masked not in (None, *MASKED):
            raise DataError(f"masked must be one of {', '.join(MASKED)}, got {self.masked}")

    def options(self) -> dict[str, Any]:
        """Return what ``load_scene`` takes; nothing where the user has said nothing."""
        said = {"masks": self.folder, "masked": self.masked}
        return {name: value for name, value in said.items() if value is not None}

    @property
    def asked_for(self) -> bool:
        """Whether masks count under any protocol, because the user says so."""
        return self.masked == IGNORE or (self.masked is None and self.folder is not None)


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask of the image ``name`` in ``folder``.

    Of ``a/b.jpg``: ``a/b.jpg.png`` (COLMAP), ``a/b.png``, ``a/b_mask.png`` (Metashape), ``a/b.jpg``.
    """
    return next((path for path in _candidates(folder, name) if path.is_file()), None)


def _candidates(folder: Path, name: str) -> Iterator[Path]:
    image = folder / name
    yield folder / f"{name}.png"
    yield image.with_suffix(".png")
    yield from (image.with_name(f"{image.stem}{ENDING}{suffix}") for suffix in _SUFFIXES)
    yield image
    yield from (image.with_suffix(suffix) for suffix in _SUFFIXES[1:])


def mask_beside(image: Path) -> Path | None:
    """Return the mask that lies with a photograph: ``b_mask.png`` beside ``b.jpg``, or None."""
    beside = (image.with_name(f"{image.stem}{ENDING}{suffix}") for suffix in _SUFFIXES)
    return next((path for path in beside if path != image and path.is_file()), None)


def find_masks(
    names: Sequence[str], images: Sequence[Path], named: Sequence[Path | None], homes: Sequence[Path], masks: Masks
) -> tuple[list[Path | None], str]:
    """Return the mask of each photograph, and a line about them ("" where there are none).

    Parameters
    ----------
    names : sequence of str
        Of the photographs, with ``/``.
    images : sequence of Path
        Their files.
    named : sequence of Path or None
        Masks that the capture itself names, which are taken before those that are found.
    homes : sequence of Path
        Folders that may hold a folder ``masks``.
    masks : Masks

    Raises
    ------
    DataError
        The folder that the user names holds no mask of any of the photographs.
    """
    if masks.masked == OFF:
        return [None] * len(names), "masks are not used (--masked off)" if any(named) else ""
    folders = [masks.folder] if masks.folder is not None else [home / FOLDER for home in homes]
    folders = [folder for folder in dict.fromkeys(folders) if folder.is_dir()]
    shared = _shared_folder(names)
    found: list[Path | None] = []
    places: Counter[str] = Counter()
    for name, image, own in zip(names, images, named, strict=True):
        where, path = _NAMED, own if masks.folder is None else None
        if path is None:
            spellings = (name, name[len(shared) :])
            path = next((p for folder in folders for word in spellings if (p := find_mask(folder, word))), None)
            where = FOLDER if masks.folder is None else str(masks.folder)
        if path is None and masks.folder is None:
            path, where = mask_beside(image), "the photographs' folder"
        found.append(path)
        places[where] += path is not None
    count = len(found) - found.count(None)
    if masks.folder is not None and not count:
        raise DataError(
            f"{masks.folder} must hold masks of the photographs, got none of {len(names)}: {names[0]}.png, "
            f"{Path(names[0]).with_suffix('.png')} or {Path(names[0]).stem}{ENDING}.png was looked for"
        )
    if not count:
        vain = "" if masks.masked is None else f": --masked {masks.masked} changes nothing"
        line = f"masks: none of {len(names)} views has one in {FOLDER} (a/b.jpg.png for a/b.jpg){vain}"
        return found, line if folders or vain else ""
    in_what = " and ".join(where for where, number in places.items() if number)
    rest = f"; the other {len(names) - count} are whole" if count < len(names) else ""
    meaning = ", the rest is empty" if masks.masked == EMPTY else ", the rest is ignored" if masks.asked_for else ""
    return found, f"masks: {count} of {len(names)} views have one in {in_what} (white = keep{meaning}){rest}"


def _shared_folder(names: Sequence[str]) -> str:
    """Return the folder that all names begin with, with a ``/`` at its end; "" without one."""
    try:
        folder = os.path.commonpath([os.path.dirname(name) for name in names]) if names else ""
    except ValueError:  # some are absolute
        folder = ""
    return f"{folder}/" if folder else ""
