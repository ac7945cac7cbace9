"""What benchmarks/points.py says of points that lie a known way off a plane."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks import points

from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh


def test_distances_are_in_pixels_of_the_nearest_view_and_points_out_of_sight_do_not_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Cameras 2 and 4 above the plane z = 0, f = 100 px: a pixel is 0.02 wide at a depth of 2.
    views = [
        SimpleNamespace(
            camera=look_at(np.array([0.0, 0.0, h]), np.zeros(3), np.array([0.0, 1.0, 0.0]), width=80, height=80, fx=100)
        )
        for h in (2.0, 4.0)
    ]
    off = np.array([0.0, 0.004, 0.03, 0.5])  # below the plane: depths 2 + off, so 0, 0.2, 1.48 and 20 px
    seen = np.stack([np.linspace(-0.2, 0.2, 4), np.zeros(4), -off], axis=1)
    hidden = np.array([[1.9, 0.0, 0.0], [0.0, 0.0, 5.0]])  # beside all pictures; behind the cameras
    scene = SimpleNamespace(train=views, points=SimpleNamespace(points=np.concatenate([seen, hidden])))
    corners = np.array([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0], [2, 2, -1]], np.float32)
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), None)  # one vertex only makes its box deeper
    monkeypatch.setattr(points, "open_run", lambda run: run)
    monkeypatch.setattr(points, "reload_job", lambda run, on_event: SimpleNamespace(scene=scene))
    monkeypatch.setattr(points, "read_mesh", lambda path: plane)
    row = points.measure(Path("run"))
    px = off / ((2 + off) / 100)
    assert row.points == 4
    assert row.median == pytest.approx(np.median(px), abs=1e-6)
    assert row.mean == pytest.approx((px[:3].sum() + 10) / 4)
    assert row.within == {0.5: 0.5, 1.0: 0.5, 2.0: 0.75, 5.0: 0.75}
