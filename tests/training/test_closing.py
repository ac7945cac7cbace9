"""Points that start where photographs have no texture, and points that are moved onto the planes around them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gs2d.config.recipe import DenseStart
from gs2d.data.scene import Scene, View
from gs2d.training.start import plane_sweep
from gs2d.training.start.plane_sweep import Sweep, sweep_views, unproject
from gs2d.training.start.start_points import StartPoints, levelled, start_points
from wall_scene import WALL, image, wall

SETTINGS = DenseStart(side=48, min_angle=1.0, cell=1.5)
Places = Callable[[np.ndarray], np.ndarray]


def patch(places: np.ndarray) -> np.ndarray:
    return np.asarray((np.abs(places[..., 0] - 0.2) < 1.1) & (np.abs(places[..., 1]) < 0.9))


def scene_with(bare: Places) -> Scene:
    """Return the wall, bare in some places, without sparse points to start from."""
    views = (View.from_arrays(v.name, v.camera, image(v.camera, bare=bare)) for v in wall().train)
    return replace(wall(), train=tuple(views), points=None)


def slit(places: np.ndarray) -> np.ndarray:
    return np.asarray((np.abs(places[..., 0] - 0.2) < 0.3) & (np.abs(places[..., 1]) < 0.9))


def with_depth_in_patch(sweep: Sweep, depth: float, where: Places = patch) -> Sweep:
    """Return the sweep with another depth in the patch, and that of the wall elsewhere."""
    depths = []
    for view, found in zip(sweep.views, sweep.depths, strict=True):
        inside = where(unproject(view, np.full(found.shape, WALL)))
        depths.append(np.where(inside, depth, np.where(found > 0, WALL, 0)))
    return replace(sweep, depths=depths)


def started_in_patch(scene: Scene, sweep: Sweep) -> np.ndarray:
    points = start_points(scene, sweep, SETTINGS).points
    inner = (np.abs(points[:, 0] - 0.2) < 0.6) & (np.abs(points[:, 1]) < 0.4)
    return np.asarray(points[inner & (np.abs(points[:, 2] - WALL) < 0.3 * WALL)])


def test_points_start_on_a_bare_part_of_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_sweep, "WIDE_WINDOWS", plane_sweep.FINE_WINDOWS)  # those would reach the texture
    scene = scene_with(patch)
    sweep = sweep_views(scene, SETTINGS)
    found = started_in_patch(scene, sweep)
    assert len(found) >= 3
    np.testing.assert_allclose(found[:, 2], WALL, rtol=0.03)
    monkeypatch.setattr("gs2d.training.start.start_points.library_for", lambda _: None)
    assert len(started_in_patch(scene, sweep)) < len(found) / 3


def test_a_wide_gap_with_texture_stays_open() -> None:
    scene = scene_with(lambda places: np.zeros(places.shape[:-1], bool))
    assert len(started_in_patch(scene, with_depth_in_patch(sweep_views(scene, SETTINGS), 0))) == 0


def test_a_narrow_gap_may_have_texture(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_with(lambda places: np.zeros(places.shape[:-1], bool))
    sweep = with_depth_in_patch(sweep_views(scene, SETTINGS), 0, slit)
    found = len(start_points(scene, sweep, SETTINGS).points)
    monkeypatch.setattr("gs2d.training.start.start_points.library_for", lambda _: None)
    assert len(start_points(scene, sweep, SETTINGS).points) <= found - 3


def test_a_gap_that_views_see_through_stays_open() -> None:
    scene = scene_with(patch)
    sweep = sweep_views(scene, SETTINGS)
    assert len(started_in_patch(scene, with_depth_in_patch(sweep, 0))) >= 4
    assert len(started_in_patch(scene, with_depth_in_patch(sweep, 2 * WALL))) == 0


def points_at(places: np.ndarray) -> StartPoints:
    count, random = len(places), np.random.default_rng(1)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return StartPoints(places, np.full((count, 3), 0.5), normals, np.full(count, 0.01), np.zeros(count))


def test_points_move_onto_the_plane_around_them() -> None:
    random = np.random.default_rng(0)
    flat = np.stack([*random.uniform(-1, 1, (2, 4000)), random.normal(0, 0.01, 4000)], axis=1)
    flat[:40, 2] += 0.08  # outliers do not tilt it
    moved = levelled(points_at(flat), 3.0)
    inner = (np.abs(moved.places[:, :2]) < 0.9).all(axis=1) & (np.abs(moved.places[:, 2]) < 0.05)
    assert moved.places[inner, 2].std() < 0.004
    assert np.median(np.abs(moved.normals[inner, 2])) > 0.98


def test_points_of_a_wire_stay() -> None:
    random = np.random.default_rng(0)
    wire = np.stack([np.linspace(0, 3, 300), *random.normal(0, 0.004, (2, 300))], axis=1)
    moved = levelled(points_at(wire), 3.0)
    assert (moved.places == wire).all(axis=1).mean() > 0.9
