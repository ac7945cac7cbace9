"""Cameras on an orbit around the subject, as far as it was photographed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gs2d.core.camera import Camera, look_at
from gs2d.core.transforms import focus_point, up_direction

_UNSEEN_ARC = np.radians(100.0)  # a larger gap between cameras is not photographed; orbits have gaps of up to 60
_FADE = 0.15  # of the arc, over which distances and heights of photographs are averaged


def orbit_cameras(cameras: Sequence[Camera], frames: int, focus: np.ndarray | None = None) -> list[Camera]:
    """Return the cameras of a circle around the focus, with the median radius and height of the photographs.

    If a part of the circle was not photographed (``photographed_arc``), the path swings back and forth over the rest,
    at the local distance and height of the photographs. ``focus`` [3] is in world units (default: the point
    nearest to the optical axes).
    """
    focus = focus_point(cameras) if focus is None else np.asarray(focus, np.float64)
    up = up_direction(cameras)
    arms = np.array([camera.center for camera in cameras]) - focus  # [V, 3]
    heights = arms @ up
    flat = arms - heights[:, None] * up
    radii = np.linalg.norm(flat, axis=1)
    side = flat[int(np.argmax(radii > 1e-9 * radii.max()))]
    side = side / max(float(np.linalg.norm(side)), 1e-300)
    other = np.cross(up, side)
    angles = np.arctan2(flat @ other, flat @ side)
    arc = photographed_arc(angles)
    if arc is None:
        turns = np.linspace(0, 2 * np.pi, frames, endpoint=False)
        places = [(angle, float(np.median(radii)), float(np.median(heights))) for angle in turns]
    else:
        start, width = arc
        turns = start + width / 2 * (1 - np.cos(2 * np.pi * np.arange(frames) / frames))  # slow at the turning points
        places = [(angle, *_photographed_at(angle, angles, radii, heights, width)) for angle in turns]
    like = cameras[0]
    circle = []
    for angle, radius, height in places:
        eye = focus + height * up + radius * (np.cos(angle) * side + np.sin(angle) * other)
        circle.append(look_at(eye, focus, up, width=like.width, height=like.height, fx=like.fx, fy=like.fy))
    return circle


def photographed_arc(angles: np.ndarray) -> tuple[float, float] | None:
    """Return start and width of the arc of the cameras, rad; None if they are all around.

    ``angles`` [V] are the directions from the focus to the cameras, rad.
    """
    ordered = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    if gaps[widest] < _UNSEEN_ARC:
        return None
    return float(ordered[(widest + 1) % len(ordered)]), float(2 * np.pi - gaps[widest])


def _photographed_at(
    angle: float, angles: np.ndarray, radii: np.ndarray, heights: np.ndarray, width: float
) -> tuple[float, float]:
    """Return radius and height of the photographs near a direction, as a weighted mean."""
    off = np.abs(np.mod(angles - angle + np.pi, 2 * np.pi) - np.pi)
    weights = np.exp(-0.5 * (off / max(_FADE * width, 0.05)) ** 2) + 1e-12
    return float(np.average(radii, weights=weights)), float(np.average(heights, weights=weights))
