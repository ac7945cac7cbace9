"""The ground truth of DTU as it is distributed: scan, observation mask, plane of the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from gs2d.errors import DataError
from gs2d.io.meshes import read_points


@dataclass(frozen=True, eq=False)
class DtuTruth:
    """What a mesh of one scan is compared with, in mm.

    Attributes
    ----------
    scan : int
    points : ndarray [P, 3]
        The structured-light scan (``stlNNN_total.ply``).
    observed : ndarray [X, Y, Z] bool
        Cells that the scanner observed (``ObsMaskN_10.mat``).
    bounds : ndarray [2, 3]
        Smallest and largest corner of those cells.
    resolution : float
        mm, side of a cell.
    plane : ndarray [4]
        Points with plane . (x, y, z, 1) > 0 are above the table (``PlaneN.mat``).
    """

    scan: int
    points: np.ndarray
    observed: np.ndarray
    bounds: np.ndarray
    resolution: float
    plane: np.ndarray

    def is_observed(self, points: np.ndarray) -> np.ndarray:
        """Which points [P, 3] lie in an observed cell, bool [P] (the nearest cell centre, ties to even)."""
        cell = np.around((points - self.bounds[0]) / self.resolution).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.observed.shape)).all(axis=1)
        inside[inside] = self.observed[tuple(cell[inside].T)]
        return np.asarray(inside)

    def above_plane(self) -> np.ndarray:
        """Return the scanned points above the table."""
        return np.asarray(self.points[self.points @ self.plane[:3] + self.plane[3] > 0])


def read_dtu_truth(scan: int, files: Mapping[str, Path]) -> DtuTruth:
    """Read the ground truth of a scan from its three ``files`` (keys as ``data.benchmarks.dtu_truth_files``).

    Raises
    ------
    DataError
        A file is missing or broken; names it.
    """
    mask = _matrices(files["mask"], ("ObsMask", "BB", "Res"))
    observed, bounds = np.asarray(mask["ObsMask"]), np.asarray(mask["BB"], np.float64)
    if observed.ndim != 3 or bounds.shape != (2, 3) or np.asarray(mask["Res"]).size != 1:
        raise DataError(
            f"{files['mask']} must hold ObsMask [X, Y, Z], BB [2, 3] and one Res, got {list(observed.shape)}, "
            f"{list(bounds.shape)} and {np.asarray(mask['Res']).size}; copy it again"
        )
    plane = np.asarray(_matrices(files["plane"], ("P",))["P"], np.float64).ravel()
    if plane.shape != (4,) or not np.isfinite(plane).all():
        raise DataError(f"{files['plane']} must hold four finite numbers P, got {plane.size}; copy it again")
    points = np.asarray(read_points(files["scan"]).points, np.float64)
    if not len(points):
        raise DataError(f"{files['scan']} must hold the scanned points, got none; copy it again")
    resolution = float(np.asarray(mask["Res"]).ravel()[0])
    return DtuTruth(scan, points, observed.astype(bool), bounds, resolution, plane)


def _matrices(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Variables of a MATLAB file (version 5, as DTU has them)."""
    try:
        content = loadmat(path)
    except FileNotFoundError as error:
        raise DataError(f"cannot read {path}: no such file") from error
    except (OSError, ValueError, TypeError, NotImplementedError, KeyError, IndexError, EOFError) as error:
        raise DataError(f"{path} must be a MATLAB 5 file, got: {error}; copy it again") from error
    missing = [name for name in names if name not in content]
    if missing:
        raise DataError(f"{path} must hold {', '.join(names)}; {', '.join(missing)} is missing; copy it again")
    return {name: content[name] for name in names}
