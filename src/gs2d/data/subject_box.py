"""The subject of a capture: what most cameras look at, and its bounding box.

Every camera has one vote, spread over the surface that it sees and weighted towards the middle of its image. An object
is a region outside the cameras that most of them give a fair part of their votes to; its box contains the surface there
that most images show. Cameras without a common target (in a room, along a street) have a scene, not an object.
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
SPREAD = 0.5  # standard deviation of the vote, in half shorter image sides
FAIR_PART = 0.3  # smallest part of its vote that a camera gives to a region it looks at
MOST = 0.6  # smallest fraction of cameras that look at an object
SHOWN_BY = 0.5  # smallest fraction of these cameras that show a point of its surface
FEW_INSIDE = 0.1  # largest fraction of cameras inside the object
TAIL = 0.5  # per cent of the votes outside the box on each side
MARGIN = 0.05  # of the longest side of the box, added on each side
LARGEST = 1e12  # world units; its cube is still a float32 number
_STEPS = 20  # of mean shift
_SEEDS = 16  # start positions of the mean shift


@dataclass(frozen=True, eq=False)
class Sight:
    """The surface that one camera sees."""

    camera: Camera
    points: np.ndarray  # [P, 3] world units; surface points
    weights: np.ndarray  # [P]; parts of the vote of the camera; their sum is 1, or 0 without surface


@dataclass(frozen=True, eq=False)
class Subject:
    """What the cameras look at, in the coordinates of the capture."""

    kind: str  # "object", or "scene": no common target, the box contains everything visible
    # low, high: [3] world units; corners of the box
    low: np.ndarray
    high: np.ndarray
    center: np.ndarray  # [3] world units; mean of the votes, not the centre of the box
    up: np.ndarray  # [3]; unit up vector
    why: str  # reason, in one sentence

    @property
    def radius(self) -> float:
        """Half the diagonal of the box, world units."""
        return float(np.linalg.norm(self.high - self.low)) / 2

    @property
    def box(self) -> np.ndarray:
        """Both corners of the box [2, 3], world units."""
        return np.stack([self.low, self.high])

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``subject.json``."""
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
        """Convert the result of ``to_json``.

        Raises DataError if a field is missing or invalid.
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
    """Read the subject of a run folder; None without one.

    Raises DataError if ``subject.json`` is damaged.
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
        raise DataError(f"{path} is damaged ({error}); delete it, and `gs2d mesh {run}` creates it again") from error


def checked_box(box: Sequence[float], option: str) -> np.ndarray:
    """Return both corners [2, 3], world units, of a box x0 y0 z0 x1 y1 z1 from the command line.

    Raises DataError if the numbers are not a box.
    """
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not (np.abs(corners) <= LARGEST).all() or not (corners[:3] < corners[3:]).all():
        numbers = " ".join(f"{value:g}" for value in box)
        raise DataError(f"{option} must be a lower and an upper corner, x0 y0 z0 x1 y1 z1, got {numbers}")
    return corners.reshape(2, 3)


def check_subject_box(box: Sequence[float] | None, others: Mapping[str, bool]) -> None:
    """Check ``--subject-box``: a valid box, and no conflicting option.

    ``others``: conflicting options, and whether they are set. Raises DataError if the numbers are not a box. Raises
    ProtocolError if a conflicting option is set.
    """
    if box is None:
        return
    checked_box(box, "--subject-box")
    for option, is_set in others.items():
        if is_set:
            raise ProtocolError(f"--subject-box and {option} exclude each other, got both; leave one out")


def subject_in_box(box: Sequence[float], cameras: Sequence[Camera]) -> Subject:
    """Return the object in a box x0 y0 z0 x1 y1 z1, world units.

    Raises DataError if the numbers are not a box.
    """
    low, high = checked_box(box, "--subject-box")
    return Subject(OBJECT, low, high, (low + high) / 2, up_direction(cameras), "set with --subject-box")


def middle_weights(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the vote of a camera at pixels [P, 2] px: a Gaussian around the image centre."""
    off = (pixels - [camera.width / 2, camera.height / 2]) / (min(camera.width, camera.height) / 2)
    return np.asarray(np.exp(-0.5 * (off**2).sum(axis=1) / SPREAD**2))


def shown(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return which points [P, 3] project into the image of a camera; occlusion is ignored."""
    pixels, depth = camera.project(points)
    return np.asarray((depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= (camera.width, camera.height)).all(axis=1))


def find_subject(sights: Sequence[Sight]) -> Subject:
    """Find what most cameras look at.

    ``sights``: one per camera. Raises DataError if no camera sees any surface.
    """
    cameras = [sight.camera for sight in sights]
    voters = [sight for sight in sights if sight.weights.sum() > 0]
    if not voters:
        raise DataError("no camera sees any surface; train longer or check the cameras")
    up = up_direction(cameras)
    center = _place(voters)
    size = frame_size([sight.camera for sight in voters], center)
    if not size > 0:
        return _scene(sights, up, "most cameras have no common target")
    looking = np.array([_fraction(sight, center, size) >= FAIR_PART for sight in voters])
    inside = np.mean([np.linalg.norm(camera.center - center) < 0.5 * size for camera in cameras])
    count = f"{int(looking.sum())} of {len(cameras)} cameras"
    if looking.sum() < MOST * len(cameras):
        return _scene(sights, up, f"most cameras have no common target: at most {count}")
    if inside > FEW_INSIDE:
        return _scene(sights, up, f"{inside:.0%} of the cameras are inside what they look at")
    lookers = [sight for sight, looks in zip(voters, looking, strict=True) if looks]
    box = _object_box(lookers, center, size)
    if box is None:
        return _scene(sights, up, "the surface that most cameras look at has no extent")
    return Subject(OBJECT, box[0], box[1], center, up, f"{count} look at it")


def frame_size(cameras: Sequence[Camera], center: np.ndarray) -> float:
    """Return half the shorter image side at the distance of a point [3], world units: median; 0 behind most cameras."""
    depths = np.array([float(camera.forward @ (center - camera.center)) for camera in cameras])
    halves = np.array([0.5 * min(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras])
    return max(float(np.median(depths * halves)), 0.0)


def _fraction(sight: Sight, center: np.ndarray, radius: float) -> float:
    """Return the part of a camera's vote inside a ball."""
    near = ((sight.points - center) ** 2).sum(axis=1) <= radius**2
    return float(sight.weights[near].sum() / sight.weights.sum())


def _place(sights: Sequence[Sight]) -> np.ndarray:
    """Return the point [3] with the most votes, each camera limited: the best of some seeds, then mean shift."""
    points = np.concatenate([sight.points for sight in sights])
    weights = np.concatenate([sight.weights for sight in sights])
    seeds = [_weighted_median(points, weights)]
    if len(sights) > 1:
        seeds.append(focus_point([sight.camera for sight in sights]))
    chosen = np.unique(np.linspace(0, len(sights) - 1, min(len(sights), _SEEDS)).round().astype(int))
    seeds += [_weighted_median(sights[i].points, sights[i].weights) for i in chosen]
    center = max(seeds, key=lambda seed: _mean_vote(sights, seed))
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


def _mean_vote(sights: Sequence[Sight], center: np.ndarray) -> float:
    """Return how much cameras look at a point, 0 to 1: the mean part of their votes around it, limited per camera."""
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
    """Return the box of the surface near ``center`` that most images show; None without extent."""
    cameras = [sight.camera for sight in sights]
    reach = max(math.hypot(c.width, c.height) / min(c.width, c.height) for c in cameras) * size
    points = np.concatenate([sight.points for sight in sights])
    weights = np.concatenate([sight.weights for sight in sights])
    near = (((points - center) ** 2).sum(axis=1) <= reach**2) & (weights > 0)
    points, weights = points[near], weights[near]
    count = np.zeros(len(points))
    for camera in cameras:
        count += shown(camera, points)
    common = count >= SHOWN_BY * len(cameras)
    if common.sum() < 2:
        return None
    corners = np.array([_weighted_percentiles(axis, weights[common]) for axis in points[common].T])
    low, high = corners[:, 0], corners[:, 1]
    side = float((high - low).max())
    if not side > 0:
        return None
    return low - MARGIN * side, high + MARGIN * side


def _weighted_percentiles(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Return the values below and above which ``TAIL`` of the weight lies."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / weights.sum()
    last = len(order) - 1
    low = min(int(np.searchsorted(reached, TAIL / 100)), last)
    high = min(int(np.searchsorted(reached, 1 - TAIL / 100)), last)
    return float(values[order[low]]), float(values[order[high]])


def _scene(sights: Sequence[Sight], up: np.ndarray, why: str) -> Subject:
    """Return a scene: the box of all visible surface except the farthest per cent on each side."""
    points = np.concatenate([sight.points[sight.weights > 0] for sight in sights])
    low, high = np.percentile(points, (1, 99), axis=0)
    margin = max(MARGIN * float((high - low).max()), 1e-9)
    return Subject(SCENE, low - margin, high + margin, np.median(points, axis=0), up, why)
