"""Where a page of splats opens, and which directions were photographed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.data.subject import OBJECT, SCENE, Subject

ROUND = math.radians(100.0)  # a gap between neighbouring directions from which a capture is one-sided
MARGIN = math.radians(12.0)  # beyond the outermost photographs, sideways and down; splats are still believable there
ABOVE = math.radians(20.0)  # beyond the highest photograph
STEEPEST = math.radians(85.0)
GUESSED_SIZE = 0.3  # of half a side of the box, in distances from which it is seen: about what a picture holds
MOST = 0.8  # of the cameras look at an object
AIMED = 0.5  # cosine of the angle at the camera between its axis and what it looks at, at the least


@dataclass(frozen=True, eq=False)
class Arc:
    """Directions from the subject that were photographed, with a margin.

    Attributes
    ----------
    middle : ndarray [3]
        Unit, across what is up: the middle of the arc.
    half : float, rad
        To both sides of it; pi: all round.
    low, high : float, rad
        Above the horizon.
    """

    middle: np.ndarray
    half: float
    low: float
    high: float


def guessed_subject(cameras: Sequence[Camera], center: np.ndarray, unit: float, up: np.ndarray) -> Subject:
    """Return the subject of a capture of which nothing is known but its cameras.

    Parameters
    ----------
    center : ndarray [3] world units
        What the cameras look at.
    unit : float, world units
        About how far away it is seen from.
    up : ndarray [3]
        Unit.
    """
    size = np.full(3, GUESSED_SIZE * unit)
    aims = [float(camera.rotation[2] @ _unit(center - camera.center)) for camera in cameras]
    round_it = sum(aim > AIMED for aim in aims) > MOST * len(aims)
    why = "about what the cameras look at" if round_it else "the cameras look at no common place"
    return Subject(OBJECT if round_it else SCENE, center - size, center + size, center, up, why)


def photographed_arc(cameras: Sequence[Camera], subject: Subject, up: np.ndarray) -> Arc:
    """Return the directions from which a subject was photographed; every direction for a scene."""
    north = _unit(np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0]))
    if subject.kind != OBJECT or not cameras:
        return Arc(north, np.pi, -STEEPEST, STEEPEST)
    east = np.cross(up, north)
    arms = np.array([camera.center for camera in cameras]) - subject.center  # [V, 3]
    rises = np.arctan2(arms @ up, np.hypot(arms @ north, arms @ east))
    low, high = max(rises.min() - MARGIN, -STEEPEST), min(rises.max() + ABOVE, STEEPEST)
    turns = np.sort(np.arctan2(arms @ east, arms @ north))
    gaps = np.diff(np.append(turns, turns[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] < ROUND:
        return Arc(north, np.pi, float(low), float(high))
    half = (2 * np.pi - float(gaps[widest])) / 2
    middle = turns[(widest + 1) % len(turns)] + half  # the arc begins after the widest gap
    return Arc(np.cos(middle) * north + np.sin(middle) * east, half + float(MARGIN), float(low), float(high))


def home_camera(cameras: Sequence[Camera], subject: Subject, arc: Arc, up: np.ndarray) -> int:
    """Return the index of the photograph from whose place the page opens.

    The most usual one: its direction is near the middle of the photographed arc, its height and distance are near the
    median, and the subject is in the middle of its picture. Where there is no subject, the place nearest to all others.
    """
    places = np.array([camera.center for camera in cameras])
    if subject.kind != OBJECT:
        return int(np.linalg.norm(places[:, None] - places[None], axis=2).sum(axis=1).argmin())
    arms = places - subject.center
    away = np.maximum(np.linalg.norm(arms, axis=1), 1e-12)
    rises = np.arcsin(np.clip(arms @ up / away, -1, 1))
    level = arms - (arms @ up)[:, None] * up
    aside = np.arccos(np.clip(level @ arc.middle / np.maximum(np.linalg.norm(level, axis=1), 1e-12), -1, 1))
    axes = np.stack([camera.rotation[2] for camera in cameras])
    off = np.arccos(np.clip(-(axes * arms).sum(axis=1) / away, -1, 1))
    unusual = np.abs(rises - np.median(rises)) + np.abs(np.log(away / np.median(away))) + 2 * off
    if arc.half < np.pi:
        unusual = unusual + aside
    return int(unusual.argmin())


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
