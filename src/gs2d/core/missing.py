"""Remedies for a path that does not exist, or that exists and is not what a command needs."""

from __future__ import annotations

import difflib
import fnmatch
import json
import os
import re
import shlex
import zipfile
from pathlib import Path

_ALIKE = 0.6  # of difflib's ratio, from which a name is proposed
_UP = 3  # folders above a path that are looked at
_PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".avif", ".exr")
_CAPTURES = (  # names in a capture's folder, without those that photographs alone have
    *("transforms.json", "transforms_train.json", "cameras.npz", "cameras_sphere.npz", "sparse"),
    *("reconstruction.json", "opensfm", "cameras.xml", "*.sfm"),
)


def where_it_ends(path: Path) -> str:
    """Return "; did you mean scans/chair?", or "; there is no chair in /home/me/scans", of a path that is not there.

    Parameters
    ----------
    path : Path
        Relative to the working folder, or absolute.
    """
    missing, rest = path, Path()
    while missing.parent != missing and not missing.parent.exists():
        missing, rest = missing.parent, missing.name / rest
    try:
        names = sorted(os.listdir(missing.parent))
    except OSError:  # a file where a folder is needed, or one that may not be read
        return "; check the path"
    close = difflib.get_close_matches(missing.name.casefold(), [name.casefold() for name in names], 1, _ALIKE)
    for name in names:
        if name.casefold() in close:
            meant = missing.parent / name / rest
            return f"; did you mean {meant}?" if meant.exists() else f"; did you mean {missing.parent / name}?"
    return f"; there is no {missing.name} in {missing.parent.resolve()}"


def instead(path: Path, needed: str) -> str:
    """Return what to do with a path that exists, but is not what a command needs; begins with "; ".

    Judges by names alone. Paths in the result exist, and its commands work; RUN and FOLDER are for the user to choose.

    Parameters
    ----------
    path : Path
    needed : str
        "run", "capture" or "photographs".
    """
    here = [path, *list(path.parents)[:_UP]]
    run = next((folder for folder in here if (folder / "run.json").is_file()), None) or _run_in(path)
    tried = needed == "capture" and path.is_dir()
    capture = next((folder for folder in here[tried:] if _holds_capture(folder)), None)
    photos = path.parent if path.suffix.lower() in _PHOTOS else path
    photos = photos if holds_photographs(photos) else photos / "images"
    if needed == "run":
        if run is not None:
            return f"; give the run folder {run}"
        if capture is not None:
            return f"; `gs2d train {_quoted(capture)} --out RUN` makes a run of it"
        if holds_photographs(photos):
            return _with_cameras(photos)
        return "; give a folder that `gs2d train` or `gs2d reconstruct` made"
    if capture is None and run is not None:
        capture = _capture_of(run)
    if needed == "capture":
        if capture is not None and capture.is_dir():
            return f"; give the capture {capture}"
        if capture is not None:
            return f"; unpack it with `{_unpacking(capture)[0]}`, and give the folder with the capture"
        return _with_cameras(photos) if holds_photographs(photos) else "; give photographs with their cameras"
    if capture is not None and capture.is_file():
        return f"; `gs2d train {_quoted(capture)} --out RUN` makes a run of it"
    if capture is not None and holds_photographs(capture / "images"):
        return f"; give the folder of its photographs, {capture / 'images'}"
    if not holds_photographs(photos):
        return "; give a folder of photographs, or a video"
    return f"; give the folder {photos}" if photos.is_dir() else _with_cameras(photos)


def belongs_to_run(path: Path) -> bool:
    """Whether a folder is a run, a part of one, or holds runs and no photographs; a capture in a run is none of it."""
    for folder in (path, *list(path.parents)[:_UP]):
        if (folder / "run.json").is_file():
            return True
        if _holds_capture(folder):
            return False
    return _run_in(path) is not None and not holds_photographs(path)


def _run_in(folder: Path) -> Path | None:
    """Return the first run folder in a folder, by name."""
    return next(iter(sorted(path.parent for path in folder.glob("*/run.json"))), None)


def holds_photographs(path: Path) -> bool:
    """Whether a folder or a ZIP file holds photographs and no cameras, by the names in it."""
    names = _names_in(path)
    return any(name.lower().endswith(_PHOTOS) for name in names) and not _holds_capture(path)


def _holds_capture(path: Path) -> bool:
    return any(fnmatch.fnmatch(name.lower(), pattern) for name in _names_in(path) for pattern in _CAPTURES)


def _names_in(path: Path) -> set[str]:
    """Return the names in a folder, or the parts of all names in a ZIP file; none of what cannot be read."""
    try:
        if path.suffix.lower() == ".zip" and path.is_file():
            with zipfile.ZipFile(path) as file:
                return {part for name in file.namelist() for part in re.split(r"[/\\]", name)}
        return set(os.listdir(path))
    except (OSError, ValueError, zipfile.BadZipFile):
        return set()


def _capture_of(run: Path) -> Path | None:
    """Return the capture of a run; None where it is gone."""
    try:
        capture = Path(json.loads((run / "run.json").read_text(encoding="utf-8"))["scene"]["path"])
    except (OSError, ValueError, LookupError, TypeError):
        return None
    return capture if capture.is_dir() else None


def _with_cameras(photos: Path) -> str:
    """Return how to make a run of photographs, which may be in a ZIP file."""
    unpack, folder = _unpacking(photos) if photos.is_file() else ("", photos)
    first = f"unpack it with `{unpack}`, then " if unpack else ""
    return f"; {first}`gs2d reconstruct {_quoted(folder)} --out RUN` makes a run of its photographs"


def _unpacking(archive: Path) -> tuple[str, Path]:
    """Return a command that unpacks a ZIP file, and the new folder that it makes."""
    folder = archive.with_suffix("")
    while folder.exists():
        folder = folder.with_name(folder.name + "_unpacked")
    return f"python -m zipfile -e {_quoted(archive)} {_quoted(folder)}", folder


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
