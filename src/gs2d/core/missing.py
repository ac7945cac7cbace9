"""Suggestions for a path that does not exist or is not what a command needs."""

from __future__ import annotations

import difflib
import fnmatch
import json
import os
import shlex
from pathlib import Path

_ALIKE = 0.6  # smallest ratio of difflib for a suggested name
_UP = 3  # number of parent folders that are searched
_PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".avif")
_CAPTURES = (  # files and folders of captures
    *("transforms.json", "transforms_train.json", "cameras.npz", "cameras_sphere.npz", "sparse"),
    *("reconstruction.json", "opensfm", "cameras.xml", "*.sfm"),
)
_SOG = "means_l.webp"  # an image of splats in the SOG format, beside its meta.json


def path_hint(path: Path) -> str:
    """Return a hint on a missing path: "; did you mean scans/chair?" or "; there is no chair in /home/me/scans"."""
    missing, rest = path, Path()
    while missing.parent != missing and not missing.parent.exists():
        missing, rest = missing.parent, missing.name / rest
    try:
        names = sorted(os.listdir(missing.parent))
    except OSError:  # not a folder, or not readable
        return "; check the path"
    close = difflib.get_close_matches(missing.name.casefold(), [name.casefold() for name in names], 1, _ALIKE)
    for name in names:
        if name.casefold() in close:
            meant = missing.parent / name / rest
            return f"; did you mean {meant}?" if meant.exists() else f"; did you mean {missing.parent / name}?"
    return f"; there is no {missing.name} in {missing.parent.resolve()}"


def suggestion(path: Path, needed: str) -> str:
    """Return a suggestion for an existing path that is not the ``needed`` "run", "capture" or "photographs".

    It begins with "; ". Only file names are examined. RUN in a suggested command is a name that the user chooses.
    """
    if path.suffix.lower() == ".zip" and path.is_file():
        folder = path.with_suffix("")
        while folder.exists():
            folder = folder.with_name(folder.name + "_unpacked")
        return f"; unpack it with `python -m zipfile -e {_quoted(path)} {_quoted(folder)}`, and give that folder"
    if _SOG in _names_in(path):
        return f"; it holds splats: `gs2d view {_quoted(path / 'meta.json')}` shows them"
    here = [path, *list(path.parents)[:_UP]]
    run = next((folder for folder in here if (folder / "run.json").is_file()), None) or _run_in(path)
    tried = needed == "capture" and path.is_dir()
    capture = next((folder for folder in here[tried:] if _has_capture(folder)), None)
    photos = path.parent if path.suffix.lower() in _PHOTOS else path
    photos = photos if has_photographs(photos) else photos / "images"
    if needed == "run":
        if run is not None:
            return f"; give the run folder {run}"
        if capture is not None:
            return f"; `gs2d train {_quoted(capture)} --out RUN` makes a run of it"
        if has_photographs(photos):
            return _with_cameras(photos)
        return "; give a folder that `gs2d train` or `gs2d reconstruct` made"
    if capture is None and run is not None:
        capture = _capture_of(run)
    if needed == "capture":
        if capture is not None:
            return f"; give the capture {capture}"
        return _with_cameras(photos) if has_photographs(photos) else "; give photographs with their cameras"
    if capture is not None and has_photographs(capture / "images"):
        return f"; give the folder of its photographs, {capture / 'images'}"
    if not has_photographs(photos):
        return "; give a folder of photographs, or a video"
    return f"; give the folder {photos}" if photos.is_dir() else _with_cameras(photos)


def belongs_to_run(path: Path) -> bool:
    """Whether a folder is a run, inside one, or contains runs but no images; a capture inside a run is not."""
    for folder in (path, *list(path.parents)[:_UP]):
        if (folder / "run.json").is_file():
            return True
        if _has_capture(folder):
            return False
    return _run_in(path) is not None and not has_photographs(path)


def _run_in(folder: Path) -> Path | None:
    """Return the first run folder in a folder; None without any."""
    return next(iter(sorted(path.parent for path in folder.glob("*/run.json"))), None)


def has_photographs(path: Path) -> bool:
    """Whether a folder contains images but no cameras, by file names."""
    names = _names_in(path)
    return any(name.lower().endswith(_PHOTOS) for name in names) and _SOG not in names and not _has_capture(path)


def _has_capture(path: Path) -> bool:
    return any(fnmatch.fnmatch(name.lower(), pattern) for name in _names_in(path) for pattern in _CAPTURES)


def _names_in(path: Path) -> set[str]:
    """Return the names in a folder; empty if it cannot be read."""
    try:
        return set(os.listdir(path))
    except (OSError, ValueError):
        return set()


def _capture_of(run: Path) -> Path | None:
    """Return the capture of a run; None if it no longer exists."""
    try:
        capture = Path(json.loads((run / "run.json").read_text(encoding="utf-8"))["scene"]["path"])
    except (OSError, ValueError, LookupError, TypeError):
        return None
    return capture if capture.is_dir() else None


def _with_cameras(photos: Path) -> str:
    """Return how to make a run from images."""
    return f"; `gs2d reconstruct {_quoted(photos)} --out RUN` makes a run of its photographs"


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
