"""Crop volumes, camera logs and transforms as Tanks and Temples writes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gs2d.contrib.lab.evaluate_tnt import (
    CropVolume,
    box,
    match_cameras,
    read_crop,
    read_trajectory,
    read_transform,
)
from gs2d.errors import DataError

ARROW = [[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]  # not convex: the notch reaches down to (2, 1)


def write_crop(path: Path, **changes: object) -> Path:
    data = {
        "axis_max": 2.0, "axis_min": 1.0, "bounding_polygon": [[x, 0.0, z] for x, z in ARROW],
        "class_name": "SelectionPolygonVolume", "orthogonal_axis": "Y", "version_major": 1, "version_minor": 0,
    }  # fmt: skip
    path.write_text(json.dumps(data | changes))
    return path


@pytest.mark.parametrize(("axis", "order"), [("X", (2, 0, 1)), ("Y", (0, 2, 1)), ("Z", (0, 1, 2))])
def test_a_polygon_is_drawn_out_along_its_axis(tmp_path: Path, axis: str, order: tuple[int, int, int]) -> None:
    """Points (u, v, w): inside, in the notch, left of it, above the range, on its ends, outside."""
    uvw = np.array([[1, 0.5, 1.5], [2, 2, 1.5], [0.5, 2, 1.5], [1, 0.5, 2.1], [1, 0.5, 2], [1, 0.5, 1], [5, 1, 1.5]])
    places = {"X": (1, 2, 0), "Y": (0, 2, 1), "Z": (0, 1, 2)}[axis]
    points = np.empty_like(uvw)
    points[:, places] = uvw
    polygon = np.zeros((5, 3))
    polygon[:, places[:2]] = ARROW
    volume = read_crop(write_crop(tmp_path / "c.json", orthogonal_axis=axis, bounding_polygon=polygon.tolist()))
    assert volume.contains(points).tolist() == [True, False, True, False, True, True, False]
    np.testing.assert_array_equal(volume.apply(points), points[[0, 2, 4, 5]])


def test_the_polygon_agrees_with_areas_worked_by_hand() -> None:
    """The arrow has area 16 - 6 = 10 of its 4 x 4 square: the notch is a triangle of base 4 and height 3."""
    points = np.random.default_rng(0).uniform(0, 4, (200_000, 3))
    volume = CropVolume(1, 0.0, 4.0, np.array(ARROW, float))
    assert volume.contains(points).mean() == pytest.approx(10 / 16, abs=0.005)
    assert box(np.zeros(3), np.full(3, 2.0)).contains(points).mean() == pytest.approx(1 / 8, abs=0.005)
    assert volume.contains(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"orthogonal_axis": "W"}, "must hold orthogonal_axis"),
        ({"axis_min": 3.0}, "axis_min must be below axis_max, got 3 and 2"),
        ({"bounding_polygon": [[0, 0, 0], [1, 1, 1]]}, "three corners"),
        ({"axis_max": None}, "must hold orthogonal_axis"),
    ],
)
def test_a_broken_crop_volume_is_named(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        read_crop(write_crop(tmp_path / "Barn.json", **change))
    assert "Barn.json" in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "0 0 0\n1 0 0 5\n", "0 0\n" + "1 0 0 5\n" * 4, "a b c\n", "0 0 0\n" + "nan 0 0 0\n" * 4]
)
def test_a_broken_log_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "Barn_COLMAP_SfM.log"
    path.write_text(text)
    with pytest.raises(DataError, match="Barn_COLMAP_SfM.log must hold"):
        read_trajectory(path)


def test_a_transform_is_four_lines_of_four_numbers(tmp_path: Path) -> None:
    path = tmp_path / "Barn_trans.txt"
    np.savetxt(path, np.diag([2.0, 2, 2, 1]))
    np.testing.assert_array_equal(read_transform(path), np.diag([2.0, 2, 2, 1]))
    path.write_text("1 0 0 0\n")
    with pytest.raises(DataError, match="four lines of four numbers, got 1"):
        read_transform(path)
    np.savetxt(path, np.zeros((4, 4)))
    with pytest.raises(DataError, match="finite transform"):
        read_transform(path)
    with pytest.raises(DataError, match=r"cannot read .*none.txt"):
        read_transform(tmp_path / "none.txt")


def test_photographs_are_matched_with_the_log_by_order_or_by_number() -> None:
    names = ["000003.jpg", "000001.jpg", "000002.jpg"]
    ours, entries = match_cameras(names, 3)
    assert [names[i] for i in ours] == ["000001.jpg", "000002.jpg", "000003.jpg"]
    assert entries.tolist() == [0, 1, 2]
    ours, entries = match_cameras(names, 5)  # two photographs were left out: 000004 and 000005
    assert ours.tolist() == [1, 2, 0]
    assert entries.tolist() == [0, 1, 2]
    with pytest.raises(DataError, match="numbered 1 to 3"):
        match_cameras(names, 2)
    with pytest.raises(DataError, match="have no numbers"):
        match_cameras(["a.jpg", "b.jpg", "c.jpg"], 5)
