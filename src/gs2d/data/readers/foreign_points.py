"""Sparse points beside another tool's cameras: a PLY file that may be in another frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gs2d.data.build import PosedImage
from gs2d.data.scene import PointCloud
from gs2d.io.meshes import read_points
from gs2d.io.splat_ply import ply_kind

_NAMES = ("points3D.ply", "points.ply", "sparse.ply", "sparse_points.ply", "tie_points.ply", "point_cloud.ply")
_TRUTHS = ("mesh_gt.ply", "points_gt.ply")  # what a result is scored against is no place to start from
_FEWEST = 0.5  # share of the points that two cameras must see
_FARTHEST = 100.0  # extents of the cameras within which they must be
_LOOKED_AT = 2000  # points and
_LOOKED_FROM = 100  # cameras that are asked


def points_beside(root: Path, frames: Sequence[PosedImage]) -> tuple[PointCloud | None, list[str]]:
    """Return the points of a PLY file in ``root``, and a note where there is one that is not used.

    One of a usual name (``points3D.ply``, ``points.ply``, ``sparse.ply``, ``sparse_points.ply``, ``tie_points.ply``,
    ``point_cloud.ply``), else the only one. Points are exported with a coordinate system of their own choice: where
    fewer than half are in the pictures of two cameras they are in another frame, and are left out.

    Raises
    ------
    DataError
        The file of that name is broken.
    """
    beside = sorted(path for path in root.glob("*.ply") if path.name not in _TRUTHS)
    named = [root / name for name in _NAMES if (root / name) in beside]
    if not beside or not frames:
        return None, []
    if not named and len(beside) > 1:
        names = ", ".join(path.name for path in beside[:4])
        return None, [f"no sparse points: {names} are there; call the one to start from {_NAMES[1]}"]
    path = (named or beside)[0]
    if ply_kind(path) != "points":
        return None, [f"no sparse points: {path.name} is no point cloud"]
    cloud = read_points(path)
    points = PointCloud(np.asarray(cloud.points, dtype=np.float64), cloud.colors)
    fraction = _seen(points.points, frames)
    if fraction < _FEWEST:
        return None, [
            f"no sparse points: two cameras see {fraction:.0%} of those of {path.name}, which are in another frame; "
            "export them in the coordinates of the cameras"
        ]
    return points, []


def _seen(points: np.ndarray, frames: Sequence[PosedImage]) -> float:
    """Return the fraction of points that two cameras see (lenses that bend count as straight) from near."""
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
