"""The subject of captures with known ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.core.json_files import write_json
from gs2d.data.subject_box import Sight, Subject, find_subject, middle_weights, read_subject, subject_in_box
from gs2d.errors import DataError

UP = np.array([0.0, 0.0, 1.0])


def camera(eye: np.ndarray, target: np.ndarray) -> Camera:
    return look_at(np.asarray(eye, float), np.asarray(target, float), UP, width=40, height=30, fx=36.0)


def around(count: int, radius: float, *, arc: float = 360.0, height: float = 1.0) -> list[Camera]:
    """Cameras on an arc around the origin, that look at it."""
    turns = np.radians(np.linspace(0, arc, count, endpoint=arc < 360))
    return [camera(np.array([radius * np.cos(a), radius * np.sin(a), height]), np.zeros(3)) for a in turns]


def sight(seen_from: Camera, *balls: tuple[np.ndarray, float], room: float = 50.0) -> Sight:
    """What a camera sees of balls (centre, radius) inside a large sphere around the origin: the nearest hit."""
    columns, rows = np.meshgrid(np.arange(seen_from.width) + 0.5, np.arange(seen_from.height) + 0.5)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    rays = np.concatenate([(pixels - [seen_from.cx, seen_from.cy]) / seen_from.fx, np.ones((len(pixels), 1))], axis=1)
    rays = rays @ seen_from.rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = np.full(len(rays), np.inf)
    for center, radius in (*balls, (np.zeros(3), room)):
        arm = seen_from.center - center
        b, c = rays @ arm, arm @ arm - radius**2
        root = np.sqrt(np.maximum(b**2 - c, 0))
        hit = np.where(-b - root > 0, -b - root, -b + root)
        distance = np.where((b**2 >= c) & (hit > 0), np.minimum(distance, hit), distance)
    weights = middle_weights(seen_from, pixels)
    return Sight(seen_from, seen_from.center + distance[:, None] * rays, weights / weights.sum())


@pytest.mark.parametrize("arc", [360.0, 50.0])
def test_the_subject_is_the_ball_inside_the_ring_of_cameras_not_the_room(arc: float) -> None:
    place = np.array([0.3, -0.2, 0.1])
    subject = find_subject([sight(c, (place, 1.0)) for c in around(12, 5.0, arc=arc)])
    assert subject.kind == "object"
    assert subject.why == "12 of 12 cameras look at it"
    np.testing.assert_allclose(subject.up, UP, atol=1e-6 if arc == 360 else 0.05)
    if arc == 360:  # all of the ball was seen
        assert (subject.low < place - 0.9).all()
        assert (subject.high > place + 0.9).all()
    assert np.linalg.norm(subject.center - place) < 1.0
    assert subject.radius < 6.0  # the room's is 87


def test_cameras_inside_a_room_have_a_scene() -> None:
    turns = np.radians(np.arange(0, 360, 24))
    inside = [
        camera(0.4 * np.array([np.cos(a), np.sin(a), 0]), np.array([9 * np.cos(a), 9 * np.sin(a), 0])) for a in turns
    ]
    subject = find_subject([sight(c, room=4.0) for c in inside])
    assert subject.kind == "scene"
    assert "most cameras have no common target" in subject.why
    assert (subject.low < -2).any()
    assert (subject.high > 2).any()


def test_a_subject_reads_back_from_the_run_folder(tmp_path: Path) -> None:
    subject = find_subject([sight(c, (np.zeros(3), 1.0)) for c in around(6, 5.0)])
    assert read_subject(tmp_path) is None
    write_json(tmp_path / "subject.json", subject.to_json())
    assert set(subject.to_json()) == {"kind", "min", "max", "center", "radius", "up", "why"}
    back = read_subject(tmp_path)
    assert back is not None
    assert back.to_json() == subject.to_json()


@pytest.mark.parametrize(
    ("name", "value"),
    [("min", [1, 2]), ("max", [-9.0, -9.0, -9.0]), ("kind", "thing"), ("up", ["a", "b", "c"]), ("center", None)],
)
def test_a_damaged_subject_is_an_error_with_a_remedy(tmp_path: Path, name: str, value: object) -> None:
    good = Subject("object", np.zeros(3), np.ones(3), np.ones(3) / 2, UP, "so").to_json()
    write_json(tmp_path / "subject.json", {**good, name: value})
    with pytest.raises(DataError, match=r"subject\.json"):
        read_subject(tmp_path)


def test_a_box_of_the_user_is_used_unchanged_or_refused() -> None:
    cameras = around(4, 5.0)
    subject = subject_in_box((-1, -2, -3, 1, 2, 3), cameras)
    assert (subject.kind, subject.low.tolist(), subject.high.tolist()) == ("object", [-1, -2, -3], [1, 2, 3])
    for box in ((1, 0, 0, 0, 1, 1), (0, 0, 0, 1, 1, np.nan), (0, 0, 1, 1)):
        with pytest.raises(DataError, match="corner"):
            subject_in_box(box, cameras)


def test_cameras_that_see_nothing_have_no_subject() -> None:
    empty = [Sight(c, np.zeros((0, 3)), np.zeros(0)) for c in around(3, 5.0)]
    with pytest.raises(DataError, match="no camera sees"):
        find_subject(empty)
