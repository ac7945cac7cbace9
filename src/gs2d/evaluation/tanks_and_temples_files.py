"""The ground truth of Tanks and Temples as it is distributed: scan, crop volume, camera log, transform."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gs2d.core.images import natural_key
from gs2d.errors import DataError
from gs2d.evaluation.crop import CropVolume, read_crop
from gs2d.io.meshes import read_points


@dataclass(frozen=True, eq=False)
class TntTruth:
    """What a mesh of one scene is compared with.

    Attributes
    ----------
    scene : str
    points : ndarray [P, 3]
        The laser scan, m.
    crop : CropVolume
        In the scan's frame.
    T_truth_log : ndarray [4, 4]
        ``SCENE_trans.txt``: from the frame of the log to that of the scan.
    trajectory : ndarray [n, 4, 4]
        ``SCENE_COLMAP_SfM.log``: camera-to-world matrices of all photographs, in order.
    """

    scene: str
    points: np.ndarray
    crop: CropVolume
    T_truth_log: np.ndarray
    trajectory: np.ndarray


def read_tnt_truth(scene: str, files: Mapping[str, Path]) -> TntTruth:
    """Read the ground truth of a scene from its four ``files`` (keys as ``data.benchmarks.tnt_truth_files``).

    Raises
    ------
    DataError
        A file is missing or broken; names it.
    """
    points = np.asarray(read_points(files["scan"]).points)
    crop = read_crop(files["crop"])
    if not crop.contains(points).any():
        raise DataError(f"{files['crop']} must hold part of the scan {files['scan'].name}, got none; copy both again")
    return TntTruth(scene, points, crop, read_transform(files["transform"]), read_trajectory(files["log"]))


def read_transform(path: Path) -> np.ndarray:
    """Return a 4x4 matrix of numbers in four lines (``SCENE_trans.txt``).

    Raises
    ------
    DataError
    """
    rows = _number_rows(path)
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise DataError(f"{path} must hold four lines of four numbers, got {len(rows)} lines; copy it again")
    T = np.array(rows)
    if not np.isfinite(T).all() or abs(np.linalg.det(T)) < 1e-12:
        raise DataError(f"{path} must hold a finite transform, got {T.round(4).tolist()}; copy it again")
    return T


def read_trajectory(path: Path) -> np.ndarray:
    """Camera-to-world matrices [n, 4, 4] of a ``.log`` file: a line of three whole numbers, then the matrix, each.

    Raises
    ------
    DataError
    """
    rows = _number_rows(path)
    if not rows or len(rows) % 5 or any(len(row) != (3 if i % 5 == 0 else 4) for i, row in enumerate(rows)):
        raise DataError(
            f"{path} must hold a line of three numbers and four of four for each camera, "
            f"got {len(rows)} lines; copy it again"
        )
    poses = np.array([row for i, row in enumerate(rows) if i % 5], dtype=np.float64).reshape(-1, 4, 4)
    if not np.isfinite(poses).all():
        raise DataError(f"{path} must hold finite cameras, got NaN or infinity; copy it again")
    return poses


def _number_rows(path: Path) -> list[list[float]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        return [[float(word) for word in line.split()] for line in lines if line.strip()]
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise DataError(f"{path} must hold numbers only, got: {error}; copy it again") from error


def match_cameras(names: Sequence[str], count: int, where: str = "the log") -> tuple[np.ndarray, np.ndarray]:
    """Which of the named photographs belong to which of ``count`` entries of a log: indices [m], [m].

    As many as entries: in order of their names (``frame_2`` before ``frame_10``). Else by the number in the name, the
    first photograph being 1 (``000001.jpg``) as Tanks and Temples counts, or 0 if there is a number 0.

    Raises
    ------
    DataError
        Neither is possible.
    """
    order = np.array(sorted(range(len(names)), key=lambda i: natural_key(names[i])), np.int64)
    if len(names) == count:
        return order, np.arange(count)
    numbers = [re.search(r"(\d+)\D*$", Path(names[i]).stem) for i in order]
    if not all(numbers):
        raise DataError(f"{where} has {count} cameras, the capture {len(names)}, and their names have no numbers")
    counted = np.array([int(number.group(1)) for number in numbers if number], np.int64)
    first = min(1, int(counted.min()))
    entries = counted - first
    inside = (entries >= 0) & (entries < count)
    if inside.sum() < 3 or len(np.unique(entries)) < len(entries):
        raise DataError(
            f"{where} has {count} cameras, the capture {len(names)}, numbered {counted.min()} to "
            f"{counted.max()}; take the log of the same photographs"
        )
    return order[inside], entries[inside]
