"""Camera paths: orbits around the subject, and flights along the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from gs2d.core.camera import Camera, look_at
from gs2d.core.transforms import focus_point, up_direction

_UNSEEN_ARC = np.radians(100.0)  # a larger gap between cameras is not photographed; orbits have gaps of up to 60
_FADE = 0.15  # of the arc, over which distances and heights of photographs are averaged
_MAX_IN_TOUR = 300  # cameras considered for a flight
_DETOUR = 1.6  # a path in the order of names may be longer than a tour by this factor
_FRAMES_A_STOP = 15  # between two photographs of a flight: half a second
_MIN_STOPS = 4
_AIMED = 0.5  # cosine between the axis of each camera and its direction to the focus
_LEVEL = 0.1  # largest rise of the x axis of a level camera
_STEEP = 0.98  # steepest view of a camera that is kept level


def orbit_cameras(cameras: Sequence[Camera], frames: int, focus: np.ndarray | None = None) -> list[Camera]:
    """Return the cameras of a circle around the focus, with the median radius and height of the photographs.

    If a part of the circle was not photographed (``photographed_arc``), the path swings back and forth over the rest,
    at the local distance and height of the photographs.

    Parameters
    ----------
    cameras : sequence of Camera
    frames : int
    focus : ndarray [3], optional
        World units (default: the point nearest to the optical axes).
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

    Parameters
    ----------
    angles : ndarray [V]
        Directions from the focus to the cameras, rad.
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


def flight_cameras(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Return the cameras of a smooth flight past the photographs, at constant speed of position and direction.

    Akima splines go through some of the cameras: in the order of their names if that is a short path, else through the
    most different ones on a short tour. If all cameras look at about one point, distance and direction from it are
    interpolated, so that the flight goes around it. Level cameras stay level. The flight is closed if its ends meet.

    Parameters
    ----------
    cameras : sequence of Camera
        In the order of their names. Size and focal lengths of the path are those of the first.
    frames : int
    """
    if len(cameras) == 1:
        return [cameras[0]] * frames
    frame = _FlightFrame.of(cameras)
    poses = frame.poses(cameras)
    count = max(_MIN_STOPS, frames // _FRAMES_A_STOP)
    order = stops(poses, count)
    steps = np.linalg.norm(np.diff(poses[order], axis=0), axis=1)
    closed = len(order) > 3 and float(np.linalg.norm(poses[order[-1]] - poses[order[0]])) <= 1.5 * np.median(steps)
    way = poses[[*order[-2:], *order, *order[:3]]] if closed else poses[order]
    times = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(way, axis=0), axis=1), 1e-9))])
    spline = Akima1DInterpolator(times, way)
    first, last = (times[2], times[-3]) if closed else (times[0], times[-1])
    dense = np.linspace(first, last, 50 * len(way))
    seen = frame.seen(spline(dense))
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(seen, axis=0), axis=1))])
    even = np.interp(np.linspace(0, gone[-1], frames, endpoint=not closed), gone, dense)
    like, unit = cameras[0], frame.unit
    return [
        look_at(
            unit * place, unit * (place + forward), up, width=like.width, height=like.height, fx=like.fx, fy=like.fy
        )
        for place, forward, up in frame.seen(spline(even)).reshape(-1, 3, 3)
    ]


@dataclass(frozen=True)
class _FlightFrame:
    """Coordinates in which poses are interpolated: position (or direction and distance), view direction, up.

    Attributes
    ----------
    unit : float
        Length that counts as much as a rotation by a radian: the median distance to the focus, world units.
    focus : ndarray [3] or None
        Centre of the flight, in units; None if the cameras do not look at one point.
    up : ndarray [3] or None
        Common up direction; None if the cameras are not level.
    """

    unit: float
    focus: np.ndarray | None
    up: np.ndarray | None

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> _FlightFrame:
        focus = focus_point(cameras)
        arms = np.array([camera.center for camera in cameras]) - focus
        distances = np.maximum(np.linalg.norm(arms, axis=1), 1e-12)
        rotations = np.stack([camera.rotation for camera in cameras])
        aims = -(arms * rotations[:, 2]).sum(axis=1) / distances
        up = up_direction(cameras)
        unit = float(np.median(distances))
        round_it, level = float(aims.min()) > _AIMED, float(np.abs(rotations[:, 0] @ up).max()) < _LEVEL
        # a camera that looks straight down could turn about its axis at any moment
        level = level and float(np.abs(rotations[:, 2] @ up).max()) < _STEEP
        return cls(unit, focus / unit if round_it else None, up if level else None)

    def poses(self, cameras: Sequence[Camera]) -> np.ndarray:
        """Return coordinates [V, 11] for interpolation.

        Position [3] (around a focus: direction from it); distance and rise; view direction [3] (around a focus:
        tangents to the right of and above it); up [3].
        """
        centers = np.array([camera.center for camera in cameras]) / self.unit
        rotations = np.stack([camera.rotation for camera in cameras])
        forward, up = rotations[:, 2], -rotations[:, 1]
        distance, rise = np.ones((len(cameras), 1)), np.zeros((len(cameras), 1))
        if self.focus is not None:
            centers = centers - self.focus
            distance = np.linalg.norm(centers, axis=1, keepdims=True)
            centers = centers / distance
            rise = rise if self.up is None else (centers @ self.up)[:, None]
            aside, above = self._axes(-centers, up)
            ahead = -(forward * centers).sum(1)
            tangents = [(forward * axis).sum(1) / ahead for axis in (aside, above)]
            forward = np.stack([*tangents, np.zeros(len(cameras))], axis=1)
        return np.concatenate([centers, distance, rise, forward, up], axis=1)

    def seen(self, poses: np.ndarray) -> np.ndarray:
        """Return positions in units, unit view directions and unit up vectors [n, 9] of interpolated coordinates."""
        place, forward = poses[:, :3], poses[:, 5:8]
        up = poses[:, 8:11] if self.up is None else np.broadcast_to(self.up, place.shape)
        if self.focus is not None:
            if self.up is not None:  # a great circle between two low positions would go below both
                rise = np.clip(poses[:, 4:5], -1, 1)
                place = np.sqrt(1 - rise**2) * _unit_rows(place - (place @ self.up)[:, None] * self.up) + rise * self.up
            place = _unit_rows(place)
            aside, above = self._axes(-place, up)
            forward = forward[:, :1] * aside + forward[:, 1:2] * above - place
            place = self.focus + poses[:, 3:4] * place
        forward = _unit_rows(forward)
        return np.concatenate([place, forward, _unit_rows(up - (up * forward).sum(1, keepdims=True) * forward)], axis=1)

    def _axes(self, ahead: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit vectors to the right of and above view directions [n, 3]."""
        aside = _unit_rows(np.cross(ahead, up if self.up is None else self.up))
        return aside, np.cross(aside, ahead)


def _unit_rows(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def stops(poses: np.ndarray, count: int) -> np.ndarray:
    """Return indices of at most ``count`` of the poses [V, C], in the order of the flight.

    Evenly spaced from first to last if that path is hardly longer than a tour (a walk, a video); else the poses
    that are farthest from those chosen before, on a tour from the first.
    """
    some = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _MAX_IN_TOUR)).round().astype(np.int64))
    steps = np.linalg.norm(np.diff(poses[some], axis=0), axis=1)
    short = tour(poses[some])
    if steps.sum() <= _DETOUR * np.linalg.norm(np.diff(poses[some[short]], axis=0), axis=1).sum():
        gone = np.concatenate([[0.0], np.cumsum(steps)])
        wanted = np.linspace(0, gone[-1], min(count, len(gone)))
        return np.asarray(some[np.unique(np.abs(gone[:, None] - wanted).argmin(axis=0))])
    chosen, nearest = [0], np.linalg.norm(poses - poses[0], axis=1)
    while len(chosen) < min(count, len(poses)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(poses - poses[chosen[-1]], axis=1))
    return np.array(chosen)[tour(poses[chosen])]


def tour(poses: np.ndarray) -> np.ndarray:
    """Return a short path through all poses [n, C] from the first, as indices [n]: nearest neighbour, then 2-opt."""
    distance = np.linalg.norm(poses[:, None] - poses[None], axis=2)  # [n, n]
    n = len(poses)
    left, way = np.ones(n, bool), [0]
    left[0] = False
    while left.any():
        nearest = int(np.where(left, distance[way[-1]], np.inf).argmin())
        way.append(nearest)
        left[nearest] = False
    order = np.array(way)
    shorter = True
    while shorter:
        shorter = False
        for i in range(n - 2):
            ends, after = order[i + 2 :], np.append(order[i + 3 :], -1)  # candidates for the end of a reversed part
            gain = distance[order[i], order[i + 1]] - distance[order[i], ends]
            gain += np.where(after >= 0, distance[ends, after] - distance[order[i + 1], after], 0)
            best = int(gain.argmax())
            if gain[best] > 1e-9:
                order[i + 1 : i + 3 + best] = order[i + 1 : i + 3 + best][::-1]
                shorter = True
    return order
