"""Results of structure from motion, reasons why images could not be placed, and a drawing of the cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.data.faces import field_of_view
from gs2d.data.readers.colmap import (
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    read_cameras,
    read_images,
    read_points,
)
from gs2d.data.undistort import colmap_intrinsics
from gs2d.errors import DataError
from gs2d.sfm.colmap_process import MatchCounts
from gs2d.sfm.lens import PANORAMA

_MAX_ANGLES = 2000
FEW_FEATURES = 50  # of an image: too few for a match
_SHOOTING = "take photographs a step apart, with two thirds of overlap"


@dataclass(frozen=True, eq=False)
class SfmModel:
    """One model: a connected set of images."""

    images: tuple[ColmapImage, ...]
    cameras: Mapping[int, ColmapCamera]
    points: ColmapPoints
    mean_error: float  # px; mean reprojection error
    mean_track: float  # mean number of images per point
    # Degrees; median over points of the widest angle between two rays. Near 0 for a camera that only rotated.
    median_angle: float
    upright: bool  # whether +z is up

    @property
    def names(self) -> set[str]:
        """Names of the placed images."""
        return {image.name for image in self.images}


def read_model(folder: Path, done: Mapping[str, Any]) -> SfmModel:
    """Read a model that the worker wrote; ``done`` are its statistics."""
    points = read_points(folder, "bin")
    images = sorted(read_images(folder, "bin", observations=True), key=lambda image: image.name)
    assert points is not None  # the worker writes no model without points
    return SfmModel(
        tuple(images),
        read_cameras(folder, "bin"),
        points,
        float(done["mean_error"]),
        float(done["mean_track"]),
        _median_angle(images, points),
        bool(done["upright"]),
    )


def _median_angle(images: Sequence[ColmapImage], points: ColmapPoints) -> float:
    """Return the median angle (see ``SfmModel``) over at most ``_MAX_ANGLES`` points."""
    step = -(-len(points.ids) // _MAX_ANGLES)
    rays: dict[int, list[np.ndarray]] = {int(number): [] for number in points.ids[::step]}
    positions = dict(zip(rays, points.xyz[::step], strict=True))
    for image in images:
        assert image.point_ids is not None
        center = -image.T_cam_world[:3, :3].T @ image.T_cam_world[:3, 3]
        for number in rays.keys() & set(image.point_ids.tolist()):
            ray = positions[number] - center
            rays[number].append(ray / np.linalg.norm(ray))
    cosines = [np.min(np.array(some) @ np.array(some).T) for some in rays.values() if len(some) > 1]
    return float(np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))) if cosines else 0.0


def check_any(pieces: Sequence[SfmModel], counts: MatchCounts, root: Path) -> None:
    """Raise DataError if there is no model; the message names the step that failed and a remedy."""
    if pieces:
        return
    features = sorted(counts.features.values())
    if features[len(features) // 2] < FEW_FEATURES:
        raise DataError(
            f"{root} must hold photographs with texture, got {features[len(features) // 2]} features in the median "
            f"photograph (expected {FEW_FEATURES} or more): they are blurred or dark, or show plain surfaces; use more "
            "light and a patterned base"
        )
    if not counts.matches:
        raise DataError(
            f"{root} must hold photographs that overlap, got {len(counts.features)} without a single matching pair; "
            f"{_SHOOTING}"
        )
    best = max(counts.matches.values())
    connected = _largest_group(counts)
    if 2 * connected < len(counts.features):
        raise DataError(
            f"{root} must hold photographs that overlap, but at most {connected} of {len(counts.features)} are "
            f"connected by matches: the steps between them are too large; {_SHOOTING}"
        )
    raise DataError(
        f"{root} must hold photographs from different positions: {len(counts.matches)} pairs match (up to {best} "
        f"points), but none from two positions far enough apart; do not just rotate the camera: {_SHOOTING}"
    )


def _largest_group(counts: MatchCounts) -> int:
    """Return the size of the largest set of images that is connected by matches."""
    groups: list[set[str]] = []
    for pair in counts.matches:
        touched = [group for group in groups if not group.isdisjoint(pair)]
        groups = [group for group in groups if group.isdisjoint(pair)] + [set(pair).union(*touched)]
    return max(map(len, groups), default=1)


def why_not_placed(name: str, pieces: Sequence[SfmModel], counts: MatchCounts) -> str:
    """Return the most likely reason why an image has no camera in the first model."""
    for number, piece in enumerate(pieces[1:], start=1):
        if name in piece.names:
            return f"in a separate model (sparse/{number}): too few matches with the photographs of sparse/0"
    features = counts.features.get(name, 0)
    if features < FEW_FEATURES:
        return f"{features} features: blurred, or without texture"
    partners = {a if b == name else b: rows for (a, b), rows in counts.matches.items() if name in (a, b)}
    if not partners:
        return "no matches with any other photograph"
    placed = {other: rows for other, rows in partners.items() if other in pieces[0].names}
    if not placed:
        return f"matches only photographs that are not placed either ({_first(partners)})"
    best = max(placed, key=lambda other: placed[other])
    return f"too few matches with placed photographs (at most {placed[best]}, with {best})"


def _first(names: Mapping[str, int]) -> str:
    listed = sorted(names)
    return ", ".join(listed[:2]) + (" ..." if len(listed) > 2 else "")


def camera_line(camera: ColmapCamera, images: int) -> str:
    """Describe an estimated camera: model, focal length, field of view."""
    if camera.model == PANORAMA:
        return f"{camera.model} of {images} photographs, {camera.width}x{camera.height} (360 degrees wide)"
    focal = focal_length(camera)
    k = colmap_intrinsics(camera.model, camera.model, camera.width, camera.height, camera.params)
    angle = field_of_view(k)
    return (
        f"{camera.model} of {images} photographs, {camera.width}x{camera.height}, f = {focal:.0f} px "
        f"({angle:.0f} degrees wide)"
    )


def focal_length(camera: ColmapCamera) -> float:
    """Return the focal length in px: the first parameter of every COLMAP model; for panoramas px per radian."""
    if camera.model == PANORAMA:
        return camera.width / (2 * math.pi)
    return float(camera.params[0])


# -- a drawing of cameras and points, for a quick check ----------------------------------------------------------------
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
