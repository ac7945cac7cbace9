"""Rays straight down: which of several triangles is hit, where, and at what depth."""

from __future__ import annotations

import numpy as np

from gs2d.meshing.raycast import cast_down

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def two_floors() -> tuple[np.ndarray, np.ndarray]:
    """Return a floor at height 1, and a second one above its east half that rises from 2 to 3 towards the north."""
    low = np.concatenate([SQUARE, np.full((4, 1), 1.0)], axis=1)
    high = np.concatenate([SQUARE * (0.5, 1) + (2, 0), (2 + SQUARE[:, 1:] / 4)], axis=1)
    return np.concatenate([low, high]), np.concatenate([HALVES, HALVES + 4])


def test_the_highest_surface_is_hit_and_interpolated() -> None:
    vertices, faces = two_floors()
    hits = cast_down(vertices, faces, (0.0, 4.0), 1.0, (4, 4))
    heights = (vertices[faces[hits.face], 2] * hits.weights).sum(axis=-1)
    north = np.array([3.5, 2.5, 1.5, 0.5])  # per row; the first row is the northernmost
    np.testing.assert_allclose(heights[:, :2], 1.0, atol=1e-6)
    np.testing.assert_allclose(heights[:, 2:], np.repeat((2 + north / 4)[:, None], 2, axis=1), atol=1e-6)
    np.testing.assert_allclose(hits.depth, 4.0 - heights, atol=1e-5)  # rays start at 4, one above the highest vertex
    x = (vertices[faces[hits.face], 0] * hits.weights).sum(axis=-1)
    np.testing.assert_allclose(x, np.tile(np.arange(4) + 0.5, (4, 1)), atol=1e-6)


def test_rays_miss_beside_the_surface_but_not_between_triangles() -> None:
    vertices, faces = two_floors()
    hits = cast_down(vertices, faces, (-1.0, 5.0), 0.25, (24, 24))
    inside = np.zeros((24, 24), dtype=bool)
    inside[4:20, 4:20] = True
    assert ((hits.face >= 0) == inside).all()
