"""Compute the opening view of the page, and the directions from which the subject was photographed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.data.subject_box import OBJECT, SCENE, Subject

MIN_GAP = math.radians(100.0)  # angle without photographs from which a capture counts as one-sided
MARGIN = math.radians(12.0)  # visitors may turn this far beyond the outermost photographs, sideways and down
MARGIN_ABOVE = math.radians(20.0)
STEEPEST = math.radians(85.0)
GUESSED_SIZE = 0.3  # half side of the box of a guessed subject, relative to the viewing distance
MIN_AIMED_SHARE = 0.8  # share of the cameras that must look at an object
MIN_AIM = 0.5  # cosine of the angle between optical axis and direction to the object of a camera that looks at it


@dataclass(frozen=True, eq=False)
class PhotographedArc:
    """Directions from the subject that were photographed, with a margin."""

    middle: np.ndarray  # [3]: unit vector perpendicular to the up direction: the middle of the arc
    half: float  # rad: half of the angle of the arc; pi: all around
    low: float  # rad: limits of the elevation
    high: float


def guessed_subject(cameras: Sequence[Camera], center: np.ndarray, unit: float, up: np.ndarray) -> Subject:
    """Return the subject of a capture, guessed from its cameras alone.

    ``center`` [3] world units: the point that the cameras look at. ``unit`` (world units): typical distance between the
    cameras and ``center``. ``up`` [3]: unit vector.
    """
    size = np.full(3, GUESSED_SIZE * unit)
    aims = [float(camera.rotation[2] @ _unit(center - camera.center)) for camera in cameras]
    is_object = sum(aim > MIN_AIM for aim in aims) > MIN_AIMED_SHARE * len(aims)
    why = "most cameras look at this point" if is_object else "the cameras look at no common point"
    return Subject(OBJECT if is_object else SCENE, center - size, center + size, center, up, why)


def photographed_arc(cameras: Sequence[Camera], subject: Subject, up: np.ndarray) -> PhotographedArc:
    """Return the directions from which a subject was photographed; all directions for a scene without a subject."""
    north = _unit(np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0]))
    if subject.kind != OBJECT or not cameras:
        return PhotographedArc(north, np.pi, -STEEPEST, STEEPEST)
    east = np.cross(up, north)
    arms = np.array([camera.center for camera in cameras]) - subject.center  # [V, 3]
    elevations = np.arctan2(arms @ up, np.hypot(arms @ north, arms @ east))
    low, high = max(elevations.min() - MARGIN, -STEEPEST), min(elevations.max() + MARGIN_ABOVE, STEEPEST)
    azimuths = np.sort(np.arctan2(arms @ east, arms @ north))
    gaps = np.diff(np.append(azimuths, azimuths[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] < MIN_GAP:
        return PhotographedArc(north, np.pi, float(low), float(high))
    half = (2 * np.pi - float(gaps[widest])) / 2
    middle = azimuths[(widest + 1) % len(azimuths)] + half  # the arc begins after the widest gap
    direction = np.cos(middle) * north + np.sin(middle) * east
    return PhotographedArc(direction, half + MARGIN, float(low), float(high))


def opening_camera(cameras: Sequence[Camera], subject: Subject, arc: PhotographedArc, up: np.ndarray) -> int:
    """Return the index of the camera at which the page opens.

    For an object this is the most typical camera: near the middle of the arc, at about the median elevation and
    distance, and aimed at the object. For a scene it is the camera with the smallest summed distance to all others.
    """
    centers = np.array([camera.center for camera in cameras])
    if subject.kind != OBJECT:
        return int(np.linalg.norm(centers[:, None] - centers[None], axis=2).sum(axis=1).argmin())
    arms = centers - subject.center
    distance = np.maximum(np.linalg.norm(arms, axis=1), 1e-12)
    elevations = np.arcsin(np.clip(arms @ up / distance, -1, 1))
    level = arms - (arms @ up)[:, None] * up
    aside = np.arccos(np.clip(level @ arc.middle / np.maximum(np.linalg.norm(level, axis=1), 1e-12), -1, 1))
    axes = np.stack([camera.rotation[2] for camera in cameras])
    off_axis = np.arccos(np.clip(-(axes * arms).sum(axis=1) / distance, -1, 1))
    unusual = np.abs(elevations - np.median(elevations)) + np.abs(np.log(distance / np.median(distance))) + 2 * off_axis
    if arc.half < np.pi:
        unusual = unusual + aside
    return int(unusual.argmin())


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
