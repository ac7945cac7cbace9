"""Shared parts of readers: checked numbers, image files by name, and point clouds beside the cameras."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.data.build import PosedImage
from gs2d.data.file_names import IMAGES, NO_PHOTOGRAPHS, Files, files_ending, in_any_case, name_below
from gs2d.data.photo_formats import UNREAD, remedy
from gs2d.data.scene import PointCloud
from gs2d.errors import DataError, UnusableViewError
from gs2d.io.meshes import read_points
from gs2d.io.splat_ply import ply_kind

# -- numbers in files --------------------------------------------------------------------------------------------------
_LARGEST = 1e300  # JSON integers are unbounded
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
    """Parse a number; NaN for ``-nan(ind)``, ``1.#INF`` and the like, which C programs write on Windows.

    Raises
    ------
    ValueError
        If the text is not a number.
    """
    return math.nan if _NO_NUMBER.fullmatch(text) else float(text)


def real(value: Any, where: str) -> float:
    """Convert a number or its text to a finite float.

    Raises
    ------
    UnusableViewError
        For NaN or infinity; names ``where``.
    DataError
        For anything else; names ``where``.
    """
    kind: type[DataError] = DataError
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError
        number = parsed(value) if isinstance(value, str) else float(value)
        kind = DataError if math.isfinite(number) else UnusableViewError
        if not abs(number) <= _LARGEST:
            raise ValueError
        return number
    except (ValueError, OverflowError) as error:
        raise kind(f"{where} must be a finite number, got {str(value)[:40]!r}") from error


def reals(value: Any, count: int, where: str) -> np.ndarray:
    """Convert a list, or text separated by white space, to ``count`` finite numbers.

    Raises
    ------
    DataError
        If the count differs or an item is not a finite number.
    """
    items = value.split() if isinstance(value, str) else value
    if not isinstance(items, Sequence) or len(items) != count:
        got = f"{len(items)}" if isinstance(items, Sequence) else type(value).__name__
        raise DataError(f"{where} must be {count} numbers, got {got}")
    return np.array([real(item, where) for item in items])


def whole(value: Any, where: str) -> int:
    """Convert a number or its text to a non-negative integer."""
    number = real(value, where)
    if number != int(number) or number < 0:
        raise DataError(f"{where} must be a whole number >= 0, got {str(value)[:40]!r}")
    return int(number)


def entries(value: Any, where: str) -> Mapping[str, Any]:
    """Return a JSON object, or raise DataError."""
    if not isinstance(value, dict):
        raise DataError(f"{where} must be an object, got {type(value).__name__}; is the file of another tool?")
    return value


def required(entry: Mapping[str, Any], key: str, where: str) -> Any:
    """Return the value of a required key."""
    if key not in entry:
        raise DataError(f'{where} must have the key "{key}", got {sorted(map(str, entry))[:12]}')
    return entry[key]


# -- photographs by their names ----------------------------------------------------------------------------------------
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

    Parameters
    ----------
    names : sequence of str
    folders : sequence of Path
        Folders that may contain the images, most likely first.
    where : Path
        The camera file.
    base : Path, optional
        Base folder of relative paths.
    homes : sequence of Path, optional
        Base folders of names in the scene; default: ``folders``.
    reason : str, optional
        Reason for a missing file; default: names the camera file.

    Raises
    ------
    DataError
        If several files fit a name equally well.
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


# -- point clouds ------------------------------------------------------------------------------------------------------
_NAMES = ("points3D.ply", "points.ply", "sparse.ply", "sparse_points.ply", "tie_points.ply", "point_cloud.ply")
_TRUTHS = ("mesh_gt.ply", "points_gt.ply")  # ground truth, not for training
_FEWEST = 0.5  # smallest fraction of points that two cameras must see
_FARTHEST = 100.0  # largest distance of these points, in camera extents
_LOOKED_AT, _LOOKED_FROM = 2000, 100  # largest numbers of points and cameras in this test


def points_beside(root: Path, frames: Sequence[PosedImage]) -> tuple[PointCloud | None, list[str]]:
    """Return the points of a PLY file in ``root``, and a note if one is not used.

    Takes a file with a usual name (``points3D.ply``, ``points.ply``, ...), else the only one. Points may have been
    exported in other coordinates: they are left out if two cameras see less than half of them.

    Raises
    ------
    DataError
        If the file is damaged.
    """
    beside = [path for path in files_ending(root, ".ply") if path.name.lower() not in _TRUTHS]
    named = [path for name in _NAMES if (path := in_any_case(root, name)) in beside]
    if not beside or not frames:
        return None, []
    if not named and len(beside) > 1:
        names = ", ".join(path.name for path in beside[:4])
        return None, [f"no sparse points: several PLY files ({names}); name the one to use {_NAMES[1]}"]
    path = (named or beside)[0]
    if ply_kind(path) != "points":
        return None, [f"no sparse points: {path.name} is not a point cloud"]
    cloud = read_points(path)
    points = PointCloud(np.asarray(cloud.points, dtype=np.float64), cloud.colors)
    fraction = _seen(points.points, frames)
    if fraction < _FEWEST:
        return None, [
            f"no sparse points: two cameras see only {fraction:.0%} of the points of {path.name}, which seem to be in "
            "other coordinates; export them in the coordinates of the cameras"
        ]
    return points, []


def _seen(points: np.ndarray, frames: Sequence[PosedImage]) -> float:
    """Return the fraction of points near the cameras that two of them see, ignoring distortion."""
    some = points[np.linspace(0, len(points) - 1, min(len(points), _LOOKED_AT)).astype(int)]
    some = some[np.isfinite(some).all(axis=1)]
    if not len(some):
        return 0.0
    centers = np.stack([-frame.T_cam_world[:3, :3].T @ frame.T_cam_world[:3, 3] for frame in frames])
    extent = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    near = np.linalg.norm(some - centers.mean(axis=0), axis=1) <= _FARTHEST * extent
    seen = np.zeros(len(some), dtype=int)
    for index in np.linspace(0, len(frames) - 1, min(len(frames), _LOOKED_FROM)).astype(int):
        k, T = frames[index].intrinsics, frames[index].T_cam_world
        x = some @ T[:3, :3].T + T[:3, 3]
        z = np.where(x[:, 2] > 0, x[:, 2], np.nan)
        u, v = k.fx * x[:, 0] / z + k.cx, k.fy * x[:, 1] / z + k.cy
        seen += (u >= 0) & (u <= k.width) & (v >= 0) & (v <= k.height)  # comparisons with NaN are False
    return float((near & (seen >= 2)).mean())
