"""What most cameras look at: the subject of a capture, and the box that holds it.

Every camera has one vote, spread over the surface that it sees, more in the middle of its picture than at the rim. An
object is a place that most cameras give a fair part of their votes to, from outside; its box holds the surface there
that most pictures show. Cameras that look at no common place (in a room, along a street) have a scene, not a subject.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.json_files import read_json
from gs2d.core.transforms import focus_point, up_direction
from gs2d.errors import DataError, ProtocolError
from gs2d.io.run_dir import SUBJECT

OBJECT, SCENE = "object", "scene"
SPREAD = 0.5  # standard deviation of a camera's votes, in halves of the picture's shorter side
FAIR_PART = 0.3  # of its votes, which a camera gives to a place that it looks at
MOST = 0.6  # of the cameras look at an object
SHOWN_BY = 0.5  # of the cameras that look at the object, in the pictures of which its surface lies
FEW_INSIDE = 0.1  # of the cameras may stand within what they look at
TAIL = 0.5  # per cent of the votes that may lie outside the box on each side
MARGIN = 0.05  # of the box's longest side, on every side
# World units, of a box that is given: the mesh is made in 32-bit numbers, of which squares and cubes are taken.
LARGEST = 1e12
_STEPS = 20  # of mean shift
_SEEDS = 16  # places that are tried


@dataclass(frozen=True, eq=False)
class Sight:
    """What one camera sees.

    Attributes
    ----------
    camera : Camera
    points : ndarray [P, 3] world units
        On the surface.
    weights : ndarray [P]
        Parts of the camera's vote; their sum is 1, or 0 where it sees nothing.
    """

    camera: Camera
    points: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Subject:
    """What the cameras look at, in the capture's frame.

    Attributes
    ----------
    kind : str
        "object": a box that most cameras look at; "scene": no such place, the box is that of all they see.
    low, high : ndarray [3] world units
        Corners of the box.
    center : ndarray [3] world units
        The middle of the votes, which need not be that of the box.
    up : ndarray [3]
        Unit.
    why : str
        One sentence.
    """

    kind: str
    low: np.ndarray
    high: np.ndarray
    center: np.ndarray
    up: np.ndarray
    why: str

    @property
    def radius(self) -> float:
        """Half the diagonal of the box, world units."""
        return float(np.linalg.norm(self.high - self.low)) / 2

    @property
    def box(self) -> np.ndarray:
        """Both corners [2, 3] world units."""
        return np.stack([self.low, self.high])

    def to_json(self) -> dict[str, Any]:
        """Return what ``subject.json`` holds."""
        return {
            "kind": self.kind,
            "min": self.low.tolist(),
            "max": self.high.tolist(),
            "center": self.center.tolist(),
            "radius": self.radius,
            "up": self.up.tolist(),
            "why": self.why,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Subject:
        """Read what ``to_json`` gave.

        Raises
        ------
        DataError
            A field is missing or not what it should be.
        """
        try:
            low, high, center, up = (np.asarray(data[name], np.float64) for name in ("min", "max", "center", "up"))
            kind, why = data["kind"], str(data["why"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(f"a subject must hold kind, min, max, center, up and why, got {error!r}") from error
        whole = all(value.shape == (3,) and (np.abs(value) <= LARGEST).all() for value in (low, high, center, up))
        if kind not in (OBJECT, SCENE) or not whole or not (low < high).all():
            raise DataError(f"a subject must be an object or a scene with a box of finite corners, got {dict(data)}")
        return cls(kind, low, high, center, up, why)


def read_subject(run: Path) -> Subject | None:
    """Return the subject of a run folder; None where none was found yet.

    Raises
    ------
    DataError
        ``subject.json`` is damaged.
    """
    path = Path(run) / SUBJECT
    if not path.exists():
        return None
    try:
        data = read_json(path)
        if not isinstance(data, dict):
            raise DataError(f"an object was expected, got {type(data).__name__}")
        return Subject.from_json(data)
    except DataError as error:
        raise DataError(f"{path} was damaged ({error}); delete it, and `gs2d mesh {run}` finds it again") from error


def checked_box(box: Sequence[float], option: str) -> np.ndarray:
    """Return both corners [2, 3] world units of a box x0 y0 z0 x1 y1 z1 that the user gave by an option.

    Raises
    ------
    DataError
        The numbers are no box.
    """
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not (np.abs(corners) <= LARGEST).all() or not (corners[:3] < corners[3:]).all():
        numbers = " ".join(f"{value:g}" for value in box)
        raise DataError(f"{option} must be a lower corner and a higher one, x0 y0 z0 x1 y1 z1, got {numbers}")
    return corners.reshape(2, 3)


def check_subject_box(box: Sequence[float] | None, others: Mapping[str, bool]) -> None:
    """Raise for a box of the subject that is none, or that is not the only choice of what is meshed.

    Parameters
    ----------
    box : sequence of 6 floats, optional
    others : mapping of str to bool
        Options that choose something else, and whether they were given.

    Raises
    ------
    DataError
        The numbers are no box.
    ProtocolError
        Another choice was made too.
    """
    if box is None:
        return
    checked_box(box, "--subject-box")
    for option, given in others.items():
        if given:
            raise ProtocolError(f"--subject-box and {option} exclude each other, got both; leave one out")


def given_subject(box: Sequence[float], cameras: Sequence[Camera]) -> Subject:
    """Return the object in a box (x0 y0 z0 x1 y1 z1, world units) that the user named.

    Raises
    ------
    DataError
        The numbers are no box.
    """
    low, high = checked_box(box, "--subject-box")
    return Subject(OBJECT, low, high, (low + high) / 2, up_direction(cameras), "the box was given")


def middle_weights(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return how much a camera looks at each of its pixels [P, 2] px: a normal curve around the picture's middle."""
    off = (pixels - [camera.width / 2, camera.height / 2]) / (min(camera.width, camera.height) / 2)
    return np.asarray(np.exp(-0.5 * (off**2).sum(axis=1) / SPREAD**2))


def shown(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return which points [P, 3] lie in front of a camera and inside its picture, whatever is before them."""
    pixels, depth = camera.project(points)
    return np.asarray((depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= (camera.width, camera.height)).all(axis=1))


def find_subject(sights: Sequence[Sight]) -> Subject:
    """Find what most cameras look at.

    Parameters
    ----------
    sights : sequence of Sight
        One for each camera.

    Raises
    ------
    DataError
        No camera sees anything.
    """
    cameras = [sight.camera for sight in sights]
    voters = [sight for sight in sights if sight.weights.sum() > 0]
    if not voters:
        raise DataError("a subject needs surface that some camera sees, got none; train longer or check the cameras")
    up = up_direction(cameras)
    center = _place(voters)
    size = frame_size([sight.camera for sight in voters], center)
    if not size > 0:
        return _scene(sights, up, "no place is looked at by most cameras")
    looking = np.array([_fraction(sight, center, size) >= FAIR_PART for sight in voters])
    inside = np.mean([np.linalg.norm(camera.center - center) < 0.5 * size for camera in cameras])
    count = f"{int(looking.sum())} of {len(cameras)} cameras"
    if looking.sum() < MOST * len(cameras):
        return _scene(sights, up, f"no place is looked at by most cameras: at most by {count}")
    if inside > FEW_INSIDE:
        return _scene(sights, up, f"{inside:.0%} of the cameras stand within what they look at")
    lookers = [sight for sight, looks in zip(voters, looking, strict=True) if looks]
    box = _object_box(lookers, center, size)
    if box is None:
        return _scene(sights, up, "the surface that most cameras look at has no extent")
    return Subject(OBJECT, box[0], box[1], center, up, f"{count} look at it")


def frame_size(cameras: Sequence[Camera], center: np.ndarray) -> float:
    """Return half of what an image's shorter side spans at a place [3] (world units; median; 0 behind most cameras)."""
    depths = np.array([float(camera.forward @ (center - camera.center)) for camera in cameras])
    halves = np.array([0.5 * min(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras])
    return max(float(np.median(depths * halves)), 0.0)


def _fraction(sight: Sight, center: np.ndarray, radius: float) -> float:
    """Return the part of a camera's votes in a ball."""
    near = ((sight.points - center) ** 2).sum(axis=1) <= radius**2
    return float(sight.weights[near].sum() / sight.weights.sum())


def _place(sights: Sequence[Sight]) -> np.ndarray:
    """Find the place [3] with the most votes, no camera more than it may: the best of some seeds, then mean shift."""
    points = np.concatenate([sight.points for sight in sights])
    weights = np.concatenate([sight.weights for sight in sights])
    seeds = [_weighted_median(points, weights)]
    if len(sights) > 1:
        seeds.append(focus_point([sight.camera for sight in sights]))
    chosen = np.unique(np.linspace(0, len(sights) - 1, min(len(sights), _SEEDS)).round().astype(int))
    seeds += [_weighted_median(sights[i].points, sights[i].weights) for i in chosen]
    center = max(seeds, key=lambda seed: _looked_at(sights, seed))
    for _ in range(_STEPS):
        size = frame_size([sight.camera for sight in sights], center)
        near = ((points - center) ** 2).sum(axis=1) <= size**2
        if not weights[near].sum() > 0:
            break
        moved = np.average(points[near], axis=0, weights=weights[near])
        shift = float(np.linalg.norm(moved - center))
        center = moved
        if shift <= 1e-3 * size:
            break
    return center


def _looked_at(sights: Sequence[Sight], center: np.ndarray) -> float:
    """How much cameras look at a place, from 0 to 1: the mean over cameras of their share within half the frame."""
    size = frame_size([sight.camera for sight in sights], center)
    return float(np.mean([min(_fraction(sight, center, 0.7 * size), 0.5) for sight in sights])) * 2 if size > 0 else 0.0


def _weighted_median(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the median [3] along each axis."""
    middle = []
    for values in points.T:
        order = np.argsort(values)
        reached = np.cumsum(weights[order])
        middle.append(values[order][min(int(np.searchsorted(reached, 0.5 * reached[-1])), len(order) - 1)])
    return np.array(middle)


def _object_box(sights: Sequence[Sight], center: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the box of the surface within a picture's reach of the middle that most of the pictures show."""
    cameras = [sight.camera for sight in sights]
    reach = max(math.hypot(c.width, c.height) / min(c.width, c.height) for c in cameras) * size
    points = np.concatenate([sight.points for sight in sights])
    weights = np.concatenate([sight.weights for sight in sights])
    near = (((points - center) ** 2).sum(axis=1) <= reach**2) & (weights > 0)
    points, weights = points[near], weights[near]
    seen = np.zeros(len(points))
    for camera in cameras:
        seen += shown(camera, points)
    kept = seen >= SHOWN_BY * len(cameras)
    if kept.sum() < 2:
        return None
    corners = np.array([_weighted_percentiles(axis, weights[kept]) for axis in points[kept].T])
    low, high = corners[:, 0], corners[:, 1]
    side = float((high - low).max())
    if not side > 0:
        return None
    return low - MARGIN * side, high + MARGIN * side


def _weighted_percentiles(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Below and above which lies ``TAIL`` of the weight."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / weights.sum()
    last = len(order) - 1
    low = min(int(np.searchsorted(reached, TAIL / 100)), last)
    high = min(int(np.searchsorted(reached, 1 - TAIL / 100)), last)
    return float(values[order[low]]), float(values[order[high]])


def _scene(sights: Sequence[Sight], up: np.ndarray, why: str) -> Subject:
    """All that is seen, but for the farthest on each side."""
    points = np.concatenate([sight.points[sight.weights > 0] for sight in sights])
    low, high = np.percentile(points, (1, 99), axis=0)
    margin = max(MARGIN * float((high - low).max()), 1e-9)
    return Subject(SCENE, low - margin, high + margin, np.median(points, axis=0), up, why)
