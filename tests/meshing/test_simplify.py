"""Simplification keeps the surface within an error in pixels, its outline and its colours."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.meshing.simplify import pixel_scale, simplify


def sheet(n: int = 30, height: float = 0.1, colors: np.ndarray | None = None) -> Mesh:
    """A square with waves along x."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    points = np.stack([x.ravel(), y.ravel(), height * np.sin(7 * x.ravel())], axis=1).astype(np.float32)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = [np.stack([corner, corner + 1, corner + n], 1), np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    return Mesh(points, np.concatenate(faces).astype(np.int32), colors)


def ball(n: int = 24) -> Mesh:
    """A closed sphere of radius 1 with 2 n (n - 1) faces."""
    a, e = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.linspace(-np.pi / 2, np.pi / 2, n + 1)[1:-1])
    ring = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    points = np.concatenate([ring, [[0, 0, -1], [0, 0, 1]]])
    i, faces = np.arange(n), []
    for row in range(n - 2):
        low, high = row * n, (row + 1) * n
        faces += [np.stack([low + i, low + (i + 1) % n, high + i], 1)]
        faces += [np.stack([low + (i + 1) % n, high + (i + 1) % n, high + i], 1)]
    faces += [np.stack([(i + 1) % n, i, np.full(n, n * (n - 1))], 1)]
    faces += [np.stack([(n - 2) * n + i, (n - 2) * n + (i + 1) % n, np.full(n, n * (n - 1) + 1)], 1)]
    return Mesh(points, np.concatenate(faces).astype(np.int32))


def camera(distance: float, focal: float = 400.0) -> Camera:
    at = np.array([0.5, 0.5, 0.0])
    return look_at(np.array([0.5, 0.5, distance]), at, np.array([0, 1.0, 0]), width=400, height=400, fx=focal)


def edge_counts(mesh: Mesh) -> np.ndarray:
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("error", [0.25, 1.0])
def test_the_surface_stays_within_the_error_in_pixels(error: float) -> None:
    mesh, view = sheet(120), camera(2.0)
    small = simplify(mesh, error=error, cameras=[view])
    wrong = 200.0 * np.abs(small.vertices[:, 2] - 0.1 * np.sin(7 * small.vertices[:, 0]))  # 200 px a world unit
    middle = small.vertices[small.faces].mean(axis=1)
    between = 200.0 * np.abs(middle[:, 2] - 0.1 * np.sin(7 * middle[:, 0]))
    assert len(small.faces) < 0.05 * len(mesh.faces)
    assert np.sqrt((wrong**2).mean()) < error
    assert np.sqrt((between**2).mean()) < 2 * error
    assert len(simplify(mesh, error=4 * error, cameras=[view]).faces) < 0.7 * len(small.faces)


def test_a_nearer_camera_keeps_more_faces() -> None:
    mesh = sheet(120)
    far, near = (simplify(mesh, error=0.5, cameras=[camera(z)]) for z in (8.0, 2.0))
    assert len(near.faces) > 1.3 * len(far.faces)


def test_a_flat_square_becomes_a_few_faces_with_its_outline() -> None:
    small = simplify(sheet(60, height=0.0), error=0.5, cameras=[camera(2.0)])
    a, b, c = (small.vertices[small.faces[:, k]].astype(np.float64) for k in range(3))
    assert len(small.faces) < 60
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(1.0, abs=5e-3)  # 1 px
    np.testing.assert_allclose(np.ptp(small.vertices[:, :2], axis=0), 1.0, atol=5e-3)


def test_a_small_detail_on_a_large_plane_stays() -> None:
    mesh = sheet(61, height=0.0)
    pin = 30 * 61 + 30
    mesh.vertices[pin, 2] = 0.02  # 4 px high, 1 of 3721 vertices
    assert simplify(mesh, error=0.5, cameras=[camera(2.0)]).vertices[:, 2].max() > 0.015


def test_a_closed_surface_stays_closed() -> None:
    small = simplify(ball(), faces=200)
    assert len(small.faces) <= 200
    assert (edge_counts(small) == 2).all()
    a, b, c = (small.vertices[small.faces[:, k]] for k in range(3))
    assert np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * math.pi, rel=0.06)


def test_a_closed_surface_is_a_manifold_for_another_program() -> None:
    manifold3d = pytest.importorskip("manifold3d")
    small = simplify(ball(), error=1.0, cameras=[camera(4.0)])
    solid = manifold3d.Manifold(manifold3d.Mesh(np.float32(small.vertices), small.faces.astype(np.uint32)))
    assert solid.status() == manifold3d.Error.NoError
    assert solid.volume() == pytest.approx(4 / 3 * math.pi, rel=0.03)


def test_an_open_surface_stays_a_manifold() -> None:
    holed = sheet(40)
    holed = dataclasses.replace(holed, faces=holed.faces[np.random.default_rng(2).random(len(holed.faces)) > 0.2])
    assert (edge_counts(simplify(holed, faces=100)) <= 2).all()


def test_a_coloured_pattern_keeps_more_faces_than_a_plain_wall() -> None:
    x, _ = np.meshgrid(np.arange(60), np.arange(60))
    stripes = np.repeat(np.where(x.ravel() < 30, 20, 230).astype(np.uint8)[:, None], 3, axis=1)
    plain, striped = (sheet(60, 0.0, colors) for colors in (np.full_like(stripes, 128), stripes))
    few, many = (simplify(mesh, error=0.5, cameras=[camera(2.0)]) for mesh in (plain, striped))
    assert (few.colors == 128).all()
    assert len(many.faces) > len(few.faces)
    left, right = many.vertices[:, 0] < 0.4, many.vertices[:, 0] > 0.6
    assert np.ptp(many.colors[left]) < 30
    assert np.ptp(many.colors[right]) < 30


def test_what_needs_no_simplification_is_returned_unchanged() -> None:
    mesh = sheet(10)
    assert simplify(mesh, error=0.0) is mesh
    assert simplify(mesh, faces=len(mesh.faces)) is mesh


def test_the_scale_is_that_of_the_nearest_camera_and_else_the_median() -> None:
    points = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 1.0], [90.0, 0.0, 0.0]])
    scale = pixel_scale(points, [camera(2.0), camera(4.0)])
    np.testing.assert_allclose(scale, [200.0, 400.0, 300.0])
    np.testing.assert_array_equal(pixel_scale(points[2:], [camera(2.0)]), [1.0])
