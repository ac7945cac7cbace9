"""The box that the cameras look at, in which training without points starts, and how far depth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.transforms import camera_extent, focus_point
from gs2d.data.scene import PointCloud, Scene

_GRID = 40  # samples along each side of the search box
_CAMERAS = 48  # largest number of cameras that vote, evenly chosen
_BLENDER_HALF = 1.3  # half side of the initial box of NeRF-Synthetic in 3DGS and 2DGS


def scene_bounds(
    cameras: Sequence[Camera], points: PointCloud | None, *, is_synthetic: bool = False
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the box that the cameras look at, [2, 3] float64 in world units, and warnings if it is guessed.

    With sparse points: their 1st to 99th percentile on each axis, enlarged by a tenth. Without: the region that most
    cameras see. For synthetic captures: [-1.3, 1.3]^3 if the cameras agree with it. ``is_synthetic``: whether to
    try the box of NeRF-Synthetic first.
    """
    if points is not None and len(points) >= 10:
        low, high = np.percentile(points.points, (1, 99), axis=0)
        margin = 0.1 * np.maximum(high - low, 1e-3 * (high - low).max())
        if (margin > 0).all():
            return np.stack([low - margin, high + margin]), ()
    if is_synthetic and _fits_blender_box(cameras):
        return np.array([[-_BLENDER_HALF] * 3, [_BLENDER_HALF] * 3]), ()
    box = _commonly_visible_box(cameras)
    if box is not None:
        return box, ()
    return _box_ahead(cameras), (
        "the optical axes do not meet, so the depth of the scene is a guess; add sparse points for a better start",
    )


def _fits_blender_box(cameras: Sequence[Camera]) -> bool:
    """Whether all cameras are outside the box of NeRF-Synthetic and look at its centre."""
    focus = focus_point(cameras)
    if not _axes_meet(cameras) or np.abs(focus).max() > 0.5 * _BLENDER_HALF:
        return False
    distances = [np.abs(camera.center).max() for camera in cameras]
    if min(distances) <= _BLENDER_HALF:
        return False
    # The box must fill a fair part of the images, else the capture has other units.
    radius = np.median([np.linalg.norm(camera.center) for camera in cameras])
    half_view = np.median([min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]) * radius
    return bool(0.5 < half_view / _BLENDER_HALF < 3.0)


def _axes_meet(cameras: Sequence[Camera]) -> bool:
    """Whether the optical axes are not nearly parallel and meet in front of most cameras."""
    axes = np.stack([camera.forward for camera in cameras])
    spread = np.linalg.eigvalsh(np.eye(3) - axes.T @ axes / len(axes))[0]  # mean sin^2 to the best common axis
    ahead = np.mean([(focus_point(cameras) - c.center) @ c.forward > 0 for c in cameras])
    return bool(spread > np.sin(np.radians(3.0)) ** 2 and ahead > 0.5)


def _commonly_visible_box(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the box of the grid points that at least 80 % of the maximum number of cameras see."""
    if len(cameras) < 2 or not _axes_meet(cameras):
        return None
    focus = focus_point(cameras)
    centers = np.stack([camera.center for camera in cameras])
    reach = np.median(np.linalg.norm(centers - focus, axis=1))
    ticks = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
    grid = focus + reach * np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    votes = np.zeros(len(grid))
    chosen_cameras = np.linspace(0, len(cameras) - 1, min(len(cameras), _CAMERAS)).round().astype(int)
    for camera in (cameras[index] for index in chosen_cameras):
        pixels, depth = camera.project(grid)
        inside = (pixels >= 0).all(axis=1) & (pixels <= (camera.width, camera.height)).all(axis=1)
        votes += inside & (depth > 0.05 * reach)
    if votes.max() < 2:
        return None
    chosen = grid[votes >= 0.8 * votes.max()]
    half_cell = reach / _GRID
    return np.stack([chosen.min(axis=0) - half_cell, chosen.max(axis=0) + half_cell])


def _box_ahead(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the box of the view frusta between one and four camera extents."""
    extent = max(camera_extent(cameras), 1e-6)
    corners = []
    for camera in cameras:
        for depth in (extent, 4 * extent):
            u = (np.array([0.0, camera.width]) - camera.cx) / camera.fx
            v = (np.array([0.0, camera.height]) - camera.cy) / camera.fy
            rays = np.array([[x, y, 1.0] for x in u for y in v])
            corners.append(camera.center + depth * rays @ camera.rotation)
    stacked = np.concatenate(corners)
    return np.stack([stacked.min(axis=0), stacked.max(axis=0)])


NEARLY_ALL = 98.0  # percentile of distances; farther points are outliers or far background


@dataclass(frozen=True, eq=False)
class Reach:
    """A ball that contains the cameras and nearly all sparse points."""

    center: np.ndarray  # [3] world units; mean of the training cameras
    radius: float  # world units

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return which points [P, 3] are inside, [P] bool."""
        return np.asarray(np.linalg.norm(points - self.center, axis=1) <= self.radius)


def reach_of(scene: Scene, further: np.ndarray | None = None) -> Reach | None:
    """Return the reach of a scene; None without points.

    ``further`` [P, 3] world units: points beside the sparse points.
    """
    center = np.stack([view.camera.center for view in scene.train]).mean(axis=0)
    clouds = [array for array in (None if scene.points is None else scene.points.points, further) if array is not None]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    distance = np.linalg.norm(points - center, axis=1)
    return Reach(center, max(scene.extent, float(np.percentile(distance, NEARLY_ALL))))
