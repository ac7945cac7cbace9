"""Draw ``poses.png``: cameras and points from above and from the side, for a quick check."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.sfm.model import SfmModel, focal_length

MAX_POINTS = 20_000
_VIEWS = (("from above", 0, 1), ("from the side", 0, 2))
_WIDEST = 1.0  # largest half width of a wedge at distance 1; panoramas and fisheyes exceed it
_WEDGE = 0.06  # length of a camera's wedge, as a fraction of the plot width
_CAMERA = "#d62728"


def write_image_of(path: Path, piece: SfmModel, title: str) -> None:
    """Draw a model projected on its x-y plane and its x-z plane."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    centers = np.stack([-image.T_cam_world[:3, :3].T @ image.T_cam_world[:3, 3] for image in piece.images])
    points, colors = _thinned(piece)
    low, high = _limits(points, centers)
    figure = Figure(figsize=(12, 6.4), dpi=110, layout="compressed")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    for number, (name, across, upwards) in enumerate(_VIEWS, start=1):
        axes = figure.add_subplot(1, 2, number)
        plane = [across, upwards]
        axes.scatter(points[:, across], points[:, upwards], s=1.5, c=colors, linewidths=0)
        wedges = [_wedge(image.T_cam_world, center, piece, image.camera_id, high - low, plane)
                  for image, center in zip(piece.images, centers, strict=True)]  # fmt: skip
        axes.add_collection(LineCollection(wedges, colors=_CAMERA, linewidths=0.9))
        axes.plot(*centers[:, plane].T, ".", color=_CAMERA, markersize=3)
        axes.set_xlim(low[across], high[across])
        axes.set_ylim(low[upwards], high[upwards])
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel("xyz"[across])
        axes.set_ylabel("xyz"[upwards] + (" (up)" if piece.upright and upwards == 2 else ""))
        axes.set_title(name if piece.upright else f"axes {'xyz'[across]} and {'xyz'[upwards]}", fontsize=10)
        axes.grid(linewidth=0.3)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})


def _thinned(piece: SfmModel) -> tuple[np.ndarray, np.ndarray]:
    """Return at most ``MAX_POINTS`` points [P, 3], evenly from the list, and their colours [P, 3] in [0, 1]."""
    step = max(1, -(-len(piece.points.xyz) // MAX_POINTS))
    return piece.points.xyz[::step], piece.points.rgb[::step] / 255


def _limits(points: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [3] of a box around all cameras and the middle 96 % of the points, with a margin."""
    low = np.minimum(np.quantile(points, 0.02, axis=0), centers.min(axis=0))
    high = np.maximum(np.quantile(points, 0.98, axis=0), centers.max(axis=0))
    margin = 0.06 * float((high - low).max())
    return low - margin, high + margin


def _wedge(
    T_cam_world: np.ndarray, center: np.ndarray, piece: SfmModel, camera_id: int, box: np.ndarray, plane: list[int]
) -> np.ndarray:
    """Return a closed path [4, 2] from the camera centre to both ends of the middle image row."""
    camera = piece.cameras[camera_id]
    half = min(_WIDEST, camera.width / (2 * focal_length(camera)))
    ends = np.array([[-half, 0.0, 1.0], [half, 0.0, 1.0]]) @ T_cam_world[:3, :3]
    length = _WEDGE * float(box.max())
    path = np.stack([center, center + length * ends[0], center + length * ends[1], center])
    return np.asarray(path[:, plane])
