"""What came out of structure from motion, and why some photographs have no place in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

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
from gs2d.sfm.colmap_process import MatchFacts
from gs2d.sfm.fisheye import Circle
from gs2d.sfm.panoramas import PANORAMA

_MAX_ANGLES = 2000
FEW_FEATURES = 50  # of a photograph: fewer verify nothing
_NONE: Mapping[str, str] = MappingProxyType({})
_SHOOTING = "take photographs a step apart, each showing two thirds of what the one before shows"


@dataclass(frozen=True, eq=False)
class SfmModel:
    """One model: photographs that are connected with each other.

    Attributes
    ----------
    images : tuple of ColmapImage
    cameras : dict of int to ColmapCamera
    points : ColmapPoints
    mean_error : float
        px; of all observations.
    mean_track : float
        Photographs that see a point.
    median_angle : float
        Degrees; of the widest angle between the rays that see a point. Near 0 for a camera that only turned.
    upright : bool
        Turned so that +z is up.
    """

    images: tuple[ColmapImage, ...]
    cameras: Mapping[int, ColmapCamera]
    points: ColmapPoints
    mean_error: float
    mean_track: float
    median_angle: float
    upright: bool

    @property
    def names(self) -> set[str]:
        """Of the photographs that are placed in it."""
        return {image.name for image in self.images}


def read_model(folder: Path, done: Mapping[str, Any]) -> SfmModel:
    """Read a model that the worker wrote, by our own reader."""
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
    """See ``SfmModel``; over at most ``_MAX_ANGLES`` points."""
    step = -(-len(points.ids) // _MAX_ANGLES)
    rays: dict[int, list[np.ndarray]] = {int(number): [] for number in points.ids[::step]}
    places = dict(zip(rays, points.xyz[::step], strict=True))
    for image in images:
        assert image.point_ids is not None
        center = -image.T_cam_world[:3, :3].T @ image.T_cam_world[:3, 3]
        for number in rays.keys() & set(image.point_ids.tolist()):
            ray = places[number] - center
            rays[number].append(ray / np.linalg.norm(ray))
    cosines = [np.min(np.array(seen) @ np.array(seen).T) for seen in rays.values() if len(seen) > 1]
    return float(np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))) if cosines else 0.0


def check_any(pieces: Sequence[SfmModel], facts: MatchFacts, root: Path) -> None:
    """Raise DataError where there is no model at all; says at which step it ended, and what to do."""
    if pieces:
        return
    features = sorted(facts.features.values())
    if features[len(features) // 2] < FEW_FEATURES:
        raise DataError(
            f"{root} must hold photographs with texture, got {features[len(features) // 2]} features in the median "
            f"photograph (expected {FEW_FEATURES} or more): blurred, dark, or of plain surfaces; photograph it in "
            "better light, on a patterned base"
        )
    if not facts.matches:
        raise DataError(
            f"{root} must hold photographs that overlap, got no two that show the same points (of "
            f"{len(facts.features)} photographs); {_SHOOTING}"
        )
    best = max(facts.matches.values())
    together = _largest_group(facts)
    if 2 * together < len(facts.features):
        raise DataError(
            f"{root} must hold photographs that overlap, got at most {together} of {len(facts.features)} that show the "
            f"same points as one another: the steps between them are too large; {_SHOOTING}"
        )
    raise DataError(
        f"{root} must hold photographs taken from different places: {len(facts.matches)} pairs show the same points "
        f"(up to {best}), but none of them from two places far enough apart; do not turn on the spot: {_SHOOTING}"
    )


def _largest_group(facts: MatchFacts) -> int:
    """How many photographs the largest group holds that pairs with the same points connect."""
    groups: list[set[str]] = []
    for pair in facts.matches:
        touched = [group for group in groups if not group.isdisjoint(pair)]
        groups = [group for group in groups if group.isdisjoint(pair)] + [set(pair).union(*touched)]
    return max(map(len, groups), default=1)


def why_not_placed(name: str, pieces: Sequence[SfmModel], facts: MatchFacts, refused: Mapping[str, str] = _NONE) -> str:
    """Return the reason, as far as it is known, why a photograph has no camera in the first piece.

    ``refused`` are those that found a place in the second round and lost it again, with what is known of them.
    """
    for number, piece in enumerate(pieces[1:], start=1):
        if name in piece.names:
            return f"in a separate piece (sparse/{number}): too little in it is seen from the photographs of sparse/0"
    if name in refused:
        return refused[name]
    features = facts.features.get(name, 0)
    if features < FEW_FEATURES:
        return f"{features} features: blurred, or nothing in it has texture"
    partners = {a if b == name else b: rows for (a, b), rows in facts.matches.items() if name in (a, b)}
    if not partners:
        return "nothing in it was found in another photograph"
    placed = {other: rows for other, rows in partners.items() if other in pieces[0].names}
    if not placed:
        return f"matches only photographs that are not placed either ({_first(partners)})"
    best = max(placed, key=lambda other: placed[other])
    return f"{placed[best]} matches with {best} at best: too few points of known place in it"


def _first(names: Mapping[str, int]) -> str:
    listed = sorted(names)
    return ", ".join(listed[:2]) + (" ..." if len(listed) > 2 else "")


def camera_line(camera: ColmapCamera, images: int, circle: Circle | None = None) -> str:
    """One line about an estimated camera: model, focal length, field of view (of a round picture, its circle)."""
    if camera.model == PANORAMA:
        return f"{camera.model} of {images} photographs, {camera.width}x{camera.height} (360 degrees wide)"
    focal = focal_length(camera)
    k = colmap_intrinsics(camera.model, camera.model, camera.width, camera.height, camera.params)
    if circle is not None and k.lens is not None and k.lens.kind == "fisheye":
        across = round(2 * circle.radius * max(k.width, k.height))
        if across < k.width:  # the picture goes on where the lens shows nothing
            k = replace(k, width=across, cx=across / 2)
    angle = field_of_view(k)
    return (
        f"{camera.model} of {images} photographs, {camera.width}x{camera.height}, f = {focal:.0f} px "
        f"({angle:.0f} degrees wide)"
    )


def focal_length(camera: ColmapCamera) -> float:
    """px; the first parameter of every model of COLMAP, but for panoramas: px a radian."""
    if camera.model == PANORAMA:
        return camera.width / (2 * math.pi)
    return float(camera.params[0])
