"""Shared parts of the readers of this package: checked numbers of camera files, and point clouds beside them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.data.build import Capture, PosedImage
from gs2d.data.file_names import in_any_case, parsed
from gs2d.data.readers.capture_readers import READERS
from gs2d.data.scene import PointCloud
from gs2d.errors import DataError, UnusableViewError
from gs2d.io.meshes import read_points
from gs2d.io.splat_ply import ply_kind

_LARGEST = 1e300  # JSON integers are unbounded


@dataclass(frozen=True)
class FileReader:
    """A reader of captures that are recognised by one file; the fields are those of ``Reader``."""

    looks_for: str
    find: Callable[[Path], Path | None]
    read_capture: Callable[[Path], Capture]
    before_colmap: bool = False
    protocol: str = "generic"

    def detect(self, path: Path) -> bool:
        """Return whether the folder has the file."""
        return self.find(path) is not None

    def read(self, path: Path, *, downscale: int) -> Capture:
        """Read cameras and images."""
        return self.read_capture(path)


def register_file_reader(name: str, reader: FileReader, module: str) -> None:
    """Register a reader that a module of this package defines."""
    READERS.register(name, module=module)(lambda: reader)


def real(value: Any, where: str) -> float:
    """Convert a number or its text to a finite float.

    Errors name ``where``: UnusableViewError for NaN or infinity, DataError for anything else.
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
    """Convert a list, or text separated by white space, to ``count`` finite numbers, or raise DataError."""
    items = value.split() if isinstance(value, str) else value
    if not isinstance(items, Sequence) or len(items) != count:
        actual = f"{len(items)}" if isinstance(items, Sequence) else type(value).__name__
        raise DataError(f"{where} must be {count} numbers, got {actual}")
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
        raise DataError(f"{where} must be an object, got {type(value).__name__}; was it written by another program?")
    return value


def required(entry: Mapping[str, Any], key: str, where: str) -> Any:
    """Return the value of a required key."""
    if key not in entry:
        raise DataError(f'{where} must have the key "{key}", got {sorted(map(str, entry))[:12]}')
    return entry[key]


# -- point clouds ------------------------------------------------------------------------------------------------------
_NAMES = ("points3D.ply", "points.ply", "sparse.ply", "sparse_points.ply", "tie_points.ply", "point_cloud.ply")
_TRUTHS = ("mesh_gt.ply", "points_gt.ply")  # ground truth, not for training
_MIN_VISIBLE = 0.5  # smallest fraction of points that must be visible to two cameras
_MAX_DISTANCE = 100.0  # largest distance of these points, in camera extents
_TESTED_POINTS, _TESTED_CAMERAS = 2000, 100  # largest numbers of points and cameras in this test


def points_beside(root: Path, frames: Sequence[PosedImage]) -> tuple[PointCloud | None, list[str]]:
    """Return the points of a PLY file in ``root``, and a note if one is not used. A damaged file is a DataError.

    Reads a file with a usual name (``points3D.ply``, ``points.ply``, ...), else the only one. Points may have been
    exported in other coordinates, so they are not used if less than half of them are visible to two cameras.
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
    fraction = _visible_fraction(points.points, frames)
    if fraction < _MIN_VISIBLE:
        return None, [
            f"no sparse points: only {fraction:.0%} of the points of {path.name} are visible to two cameras; export "
            "them in the coordinates of the cameras"
        ]
    return points, []


def _visible_fraction(points: np.ndarray, frames: Sequence[PosedImage]) -> float:
    """Return the fraction of points near the cameras that are visible to two of them, ignoring distortion."""
    some = points[np.linspace(0, len(points) - 1, min(len(points), _TESTED_POINTS)).astype(int)]
    some = some[np.isfinite(some).all(axis=1)]
    if not len(some):
        return 0.0
    centers = np.stack([-frame.T_cam_world[:3, :3].T @ frame.T_cam_world[:3, 3] for frame in frames])
    extent = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    near = np.linalg.norm(some - centers.mean(axis=0), axis=1) <= _MAX_DISTANCE * extent
    views = np.zeros(len(some), dtype=int)
    for index in np.linspace(0, len(frames) - 1, min(len(frames), _TESTED_CAMERAS)).astype(int):
        k, T = frames[index].intrinsics, frames[index].T_cam_world
        x = some @ T[:3, :3].T + T[:3, 3]
        z = np.where(x[:, 2] > 0, x[:, 2], np.nan)
        u, v = k.fx * x[:, 0] / z + k.cx, k.fy * x[:, 1] / z + k.cy
        views += (u >= 0) & (u <= k.width) & (v >= 0) & (v <= k.height)  # comparisons with NaN are False
    return float((near & (views >= 2)).mean())


def pose_from_camera_to_world(matrix: object, where: str, *, opengl: bool) -> np.ndarray:
    """Return T_cam_world of a camera-to-world matrix [3 or 4, 4]; the rotation is orthonormalised.

    With ``opengl`` the axes y and z change sign: OpenGL cameras look along -z with y up. Raises UnusableViewError if a
    number is not finite, DataError if it is not a matrix or not a rigid motion.
    """
    try:
        M = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where} must be a 4x4 matrix of numbers, got {str(matrix)[:60]}") from error
    except OverflowError as error:
        raise UnusableViewError(f"{where} must be finite, got a number out of range") from error
    if M.shape not in ((4, 4), (3, 4)):
        raise DataError(f"{where} must be a 4x4 matrix, got shape {list(M.shape)}")
    if not np.isfinite(M).all():
        raise UnusableViewError(f"{where} must be finite, got NaN or infinity")
    R = M[:3, :3]
    with np.errstate(all="ignore"):  # numbers that overflow fail the check
        is_rotation = np.abs(R.T @ R - np.eye(3)).max() <= 1e-2 and np.linalg.det(R) > 0
        length, volume = np.linalg.norm(R, axis=0).round(4).tolist(), float(np.linalg.det(R))
    if not is_rotation:
        raise DataError(
            f"{where} must hold a rotation, got columns of length {length} and determinant {volume:.4g}; "
            "remove scale or mirroring from it"
        )
    u, _, vt = np.linalg.svd(R)
    R = u @ vt
    if opengl:
        R = R * (1.0, -1.0, -1.0)
    T = np.eye(4)
    T[:3, :3] = R.T
    T[:3, 3] = -R.T @ M[:3, 3]
    return T


def files_ending(folder: Path, ending: str) -> list[Path]:
    """Return the entries of a folder with a suffix, in any letter case, sorted by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == ending)
