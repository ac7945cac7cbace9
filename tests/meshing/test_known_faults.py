"""Captures whose meshes other implementations break: a room seen from inside, and a specular surface.

docs/known-faults.md names these tests.
"""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.contrib.surfaces.unbounded import extract_unbounded
from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import RenderedView
from gs2d.meshing.extract import ExtractOptions, extract
from surface_shapes import rays

ROOM = np.array([3.0, 2.0, 1.3])  # half side lengths; the cameras are inside
UP = np.array([0, 0, 1.0])


def room_depth(camera: Camera) -> np.ndarray:
    """Return the z-depth of walls, floor and ceiling at pixel centres: where a ray leaves the box."""
    eye, steps = rays(camera)
    steps = np.where(np.abs(steps) < 1e-12, 1e-12, steps)
    return np.asarray(((np.sign(steps) * ROOM - eye) / steps).min(axis=-1))


def room_views() -> list[RenderedView]:
    """Return views from a path through the room that look outwards, unlike an orbit around an object."""
    views = []
    for k in range(30):
        along = 2 * np.pi * k / 30
        eye = np.array([1.2 * np.cos(along), 0.7 * np.sin(along), 0.2])
        ahead = np.array([np.cos(5 * along), np.sin(5 * along), (-0.55, 0.0, 0.55)[k % 3]])
        camera = look_at(eye, eye + ahead, UP, width=96, height=72, fx=52.0)
        views.append(RenderedView(camera, room_depth(camera)))
    return views


def covered(mesh: Mesh, axis: int, side: float, cell: float = 0.2) -> float:
    """Return the fraction of a room wall's cells that have a vertex in its plane."""
    v = mesh.vertices.astype(np.float64)
    v = v[np.abs(v[:, axis] - side * ROOM[axis]) < 0.05]
    across = [k for k in range(3) if k != axis]
    counts = [round(2 * ROOM[k] / cell) for k in across]
    cells = {tuple(row) for row in np.floor((v[:, across] + ROOM[across]) / cell).astype(int).tolist()}
    inside = {(i, j) for i, j in cells if 0 <= i < counts[0] and 0 <= j < counts[1]}
    return len(inside) / (counts[0] * counts[1])


@pytest.mark.parametrize("bounded", [True, False])
def test_a_room_seen_from_inside_has_all_its_walls(bounded: bool) -> None:
    views = room_views()
    mesh = (extract if bounded else extract_unbounded)(views, ExtractOptions(resolution=96), threads=1).mesh
    parts = {(axis, side): covered(mesh, axis, side) for axis in range(3) for side in (-1.0, 1.0)}
    assert min(parts.values()) > 0.8, parts


def shining_wall(through: int, views: int = 12) -> list[RenderedView]:
    """Return views of a wall at y = 0; the first ``through`` have a moving highlight at depth 1 behind the wall."""
    frames = []
    for k in range(views):
        x = -0.6 + 1.2 * k / (views - 1)
        camera = look_at(np.array([x, -3.0, 0.0]), np.array([0.5 * x, 0, 0]), UP, width=96, height=96, fx=110.0)
        eye, steps = rays(camera)
        depth = -eye[1] / steps[..., 1]
        at = eye + depth[..., None] * steps
        shines = np.hypot(at[..., 0] - 0.3 * x, at[..., 2]) < 0.25
        frames.append(RenderedView(camera, np.where(shines & (k < through), depth + 1.0, depth)))
    return frames


def cells_without(mesh: Mesh, cell: float = 0.1) -> int:
    """Return how many cells in the middle of the wall, where the highlights are, have no vertex near its plane."""
    v = mesh.vertices.astype(np.float64)
    v = v[np.abs(v[:, 1]) < 0.2]
    found = {tuple(row) for row in np.floor(v[:, [0, 2]] / cell).astype(int).tolist()}
    return sum((i, j) not in found for i in range(-4, 4) for j in range(-4, 4))


def test_a_highlight_that_some_views_see_through_leaves_no_hole() -> None:
    assert cells_without(extract(shining_wall(4), ExtractOptions(resolution=96), threads=1).mesh) == 0


def test_what_all_views_see_through_is_a_hole() -> None:
    """Fusion does not repair a mirror: if all images agree on a depth behind it, the mesh lies there."""
    assert cells_without(extract(shining_wall(12), ExtractOptions(resolution=96), threads=1).mesh) > 10
