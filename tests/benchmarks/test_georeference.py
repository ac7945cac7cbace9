"""The measurement of noisy positions and control points: what it writes is read back, and its errors are true ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.georeference import (
    CONTROL,
    WORLD,
    Truth,
    judged,
    over_seeds,
    table,
    write_control,
)

from gs2d.core.georeference import Georeference
from gs2d.data import View
from gs2d.geo.control import locate, read_control
from gs2d.synthetic.flight import Flight, flown_cameras

CAMERAS = {f"{k}.jpg": camera for k, camera in enumerate(flown_cameras(Flight(24)))}
GROUND = np.stack([*np.meshgrid(np.linspace(0, 60, 20), np.linspace(0, 60, 20))], axis=-1).reshape(-1, 2)
TRUTH = Truth(CAMERAS, np.column_stack([GROUND - GROUND.mean(axis=0), np.zeros(len(GROUND))]))


def undecoded() -> Any:
    raise AssertionError("no photograph is looked at")


def test_marks_of_control_points_meet_where_the_points_are(tmp_path: Path) -> None:
    count = write_control(tmp_path / "control.csv", TRUTH, list(CAMERAS), np.random.default_rng(0))
    assert count == CONTROL
    points = read_control(tmp_path / "control.csv").points
    assert sum(point.check for point in points) == CONTROL // 3
    located = locate(points, [View(name, camera, undecoded) for name, camera in CAMERAS.items()])
    np.testing.assert_allclose(located.source + WORLD, located.world, atol=1.5)  # of 0.5 px, which are 0.2 m there
    assert np.abs(located.source + WORLD - located.world).max() > 0.05  # there is noise


def test_a_wrong_scale_is_an_error_of_scale_and_of_places() -> None:
    centers = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    found = Georeference(1.02, np.eye(3), np.zeros(3), WORLD, "a test", facts={"scale_error": 0.01})
    entry = judged(found, centers, centers, 1.0)
    assert entry["scale_error"] == pytest.approx(0.02)
    assert entry["told"] == 0.01
    assert entry["cameras_off"] == pytest.approx(0.2 * np.sqrt(2 / 3))
    row = {"source": "x", **over_seeds([entry, {**entry, "scale_error": 0.04}])}
    assert row["worst_scale_error"] == 0.04
    assert "| x | 3.000% | 4.000% | 1.000% | 0.163 m |" in table([row])
