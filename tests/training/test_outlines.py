"""Splats on shiny surface move outward to the outlines (``training/robust/outlines.py``)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.training.robust.outlines import moved_outward
from gs2d.training.robust.view_cells import ViewCells

SIZE, CELLS, INSIDE = 192, 48, 0.95


def cameras() -> Iterator[Camera]:
    """Twenty-four cameras around the origin, at a distance of 5."""
    ring = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    for height in (-3.0, 0.0, 3.0):
        for angle in ring + height:
            eye = (5 * np.cos(angle), 5 * np.sin(angle), height)
            yield look_at(np.array(eye), np.zeros(3), np.array([0, 0, 1.0]), width=SIZE, height=SIZE, fx=300.0)


def directions(count: int) -> np.ndarray:
    """Return unit vectors [N, 3]."""
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def pixel_rays(camera: Camera) -> np.ndarray:
    """Return the points [SIZE, SIZE, 3] at depth 1 in the frame of a camera."""
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)


def ball(camera: Camera, shine: float) -> ViewCells:
    """A view of a ball of radius 1 before a wall; where it mirrors, its depth is too large."""
    rays = pixel_rays(camera)
    center = camera.T_cam_world[:3, 3]
    a, b = (rays**2).sum(axis=-1), rays @ center
    inner = b**2 - a * (center @ center - 1)
    outline = inner > 0
    dented = b**2 - a * (center @ center - INSIDE**2)
    z = np.where(dented > 0, (b - np.sqrt(np.maximum(dented, 0))) / a, b / a)
    return ViewCells(camera, np.full((CELLS, CELLS), shine), np.where(outline, z, 9.0))


@pytest.mark.parametrize("sign", [1, -1])
def test_shiny_splats_move_to_the_outlines(sign: int) -> None:
    out = directions(300)
    moved = moved_outward(INSIDE * out, sign * out, [ball(camera, 0.5) for camera in cameras()])
    radius = np.linalg.norm(moved, axis=1)
    assert radius.min() >= INSIDE - 1e-9  # none moves inward
    assert np.mean(radius > INSIDE + 0.02) > 0.2  # the others follow in later comparisons
    assert radius.max() < 1.02


def test_matt_splats_stay() -> None:
    out = directions(50)
    views = [ball(camera, 0.2) for camera in cameras()]
    np.testing.assert_array_equal(moved_outward(INSIDE * out, out, views), INSIDE * out)


def test_shiny_plane_stays() -> None:
    """A flat surface has no outline inside its image, so views only see past what has left it."""
    views = [
        ViewCells(camera, np.ones((CELLS, CELLS)), plane_depth(camera))
        for camera in cameras()
        if camera.center[2] > 1  # from above
    ]
    places = np.column_stack([np.random.default_rng(0).uniform(-0.3, 0.3, (50, 2)), np.zeros(50)])
    np.testing.assert_array_equal(moved_outward(places, np.tile([0, 0, 1.0], (50, 1)), views), places)


def plane_depth(camera: Camera) -> np.ndarray:
    """Return the depth [SIZE, SIZE] of the plane z = 0."""
    down = (pixel_rays(camera) @ camera.rotation)[..., 2]
    return np.where(down < 0, -camera.center[2] / np.minimum(down, -1e-9), 0.0)


def test_hollows_stay() -> None:
    """No outline shows the inside of a bowl, and views see past what leaves it."""
    inside = -directions(300)
    inside[:, 2] = -np.abs(inside[:, 2])  # the lower half, seen from above
    above = [camera for camera in cameras() if camera.center[2] > 1]
    bowl = [ViewCells(camera, np.full((CELLS, CELLS), 0.5), far_side(camera)) for camera in above]
    np.testing.assert_array_equal(moved_outward(inside, -inside, bowl), inside)


def far_side(camera: Camera) -> np.ndarray:
    """Return the depth of the lower half of the ball, seen from inside, before a wall."""
    rays = pixel_rays(camera)
    center = camera.T_cam_world[:3, 3]
    a, b = (rays**2).sum(axis=-1), rays @ center
    z = (b + np.sqrt(np.maximum(b**2 - a * (center @ center - 1), 0))) / a
    height = (rays * z[..., None] - center) @ camera.rotation[:, 2]
    return np.where((b**2 > a * (center @ center - 1)) & (height < 0), z, 9.0)
