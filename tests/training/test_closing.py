"""Depth that is interpolated where photographs have no texture, and the points that start there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.config.robust import DenseStart
from gs2d.data.scene import Scene, View
from gs2d.training.start import plane_sweep
from gs2d.training.start.closing import closed_depth, enclosed
from gs2d.training.start.plane_sweep import sweep_views
from gs2d.training.start.start_points import start_points
from wall_scene import WALL, image, wall

SHAPE = (14, 18)
ROWS, COLUMNS = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
PLANE = 1 / (0.2 + 0.003 * ROWS + 0.005 * COLUMNS)  # the depth of a plane: 1/z is affine in the pixel
GREY, ALL = np.full((*SHAPE, 3), 0.5), np.ones(SHAPE, bool)


def rim() -> np.ndarray:
    known = np.ones(SHAPE, bool)
    known[1:-1, 1:-1] = False
    return known


def test_a_plane_is_restored_from_its_rim() -> None:
    closed = closed_depth(np.where(rim(), PLANE, 0), rim(), GREY, ALL)
    np.testing.assert_allclose(closed, PLANE, rtol=1e-5)


def test_depth_does_not_cross_an_edge_of_the_photograph() -> None:
    color, behind = GREY.copy(), COLUMNS >= 9
    color[behind] = 0.8
    truth = np.where(behind, 3 * PLANE, PLANE)
    closed = closed_depth(np.where(rim(), truth, 0), rim(), color, ALL)
    np.testing.assert_allclose(closed, truth, rtol=0.1)  # the other surface is three times as far


@pytest.mark.filterwarnings("error")
def test_what_is_connected_to_nothing_known_has_no_depth() -> None:
    assert (closed_depth(np.zeros(SHAPE), np.zeros(SHAPE, bool), GREY, ALL) == 0).all()
    usable = ALL.copy()
    usable[3:8, 3] = usable[3:8, 7] = usable[3, 3:8] = usable[7, 3:8] = False  # a ring of masked pixels
    closed = closed_depth(np.where(rim(), PLANE, 0), rim(), GREY, usable)
    assert (closed[4:7, 4:7] == 0).all()
    assert (closed[1:-1, 9:-1] > 0).all()


def test_only_pixels_between_known_ones_are_enclosed() -> None:
    known = np.zeros((5, 5), bool)
    known[0, 2] = known[4, 2] = known[2, 0] = known[2, 4] = True
    expected = np.zeros((5, 5), bool)
    expected[2, 2] = True
    np.testing.assert_array_equal(enclosed(known), expected)


def bare(places: np.ndarray) -> np.ndarray:
    return np.asarray((np.abs(places[..., 0] - 0.2) < 1.1) & (np.abs(places[..., 1]) < 0.9))


def patched() -> Scene:
    """Return the wall with a bare rectangle, without sparse points to start from."""
    views = (View.from_arrays(v.name, v.camera, image(v.camera, bare=bare)) for v in wall().train)
    return replace(wall(), train=tuple(views), points=None)


def in_patch(points: np.ndarray) -> np.ndarray:
    return np.asarray(points[(np.abs(points[:, 0] - 0.2) < 0.6) & (np.abs(points[:, 1]) < 0.4)])


def test_points_start_on_a_bare_part_of_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_sweep, "WIDE_WINDOWS", plane_sweep.FINE_WINDOWS)  # those would reach the texture
    scene, settings = patched(), DenseStart(side=48, min_angle=1.0, cell=2.0)
    sweep = sweep_views(scene, settings)
    found = in_patch(start_points(scene, sweep, settings).points)
    assert len(found) >= 4
    np.testing.assert_allclose(found[:, 2], WALL, rtol=0.03)
    monkeypatch.setattr("gs2d.training.start.start_points.closed_depth", lambda depth, *_: np.zeros_like(depth))
    assert len(in_patch(start_points(scene, sweep, settings).points)) < len(found) / 3
