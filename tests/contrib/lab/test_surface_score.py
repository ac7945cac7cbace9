"""Surface metrics: distances worked by hand, and only what cameras see counts."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from gs2d.contrib.lab.surface_score import (
    distances_to_mesh,
    evaluate_surface,
    face_areas,
    sample_surface,
    triangle_distances,
)
from gs2d.contrib.lab.visibility import visible_counts
from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh
from gs2d.meshing.raycast import cast_camera


def square(height: float, half: float = 1.0, cells: int = 1) -> Mesh:
    """A horizontal square of 2 cells^2 triangles at z = height."""
    line = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(line, line)
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    i = np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)
    a, b, c, d = i.ravel(), (i + 1).ravel(), (i + cells + 2).ravel(), (i + cells + 1).ravel()
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))


def merged(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]).astype(np.int32)
    return Mesh(np.concatenate([m.vertices for m in meshes]), faces)


def from_above(count: int = 3, height: float = 5.0) -> list[Camera]:
    """Cameras that look straight down on the whole square, a little apart."""
    eyes = [np.array([0.3 * np.cos(a), 0.3 * np.sin(a), height]) for a in 2 * np.pi * np.arange(count) / count]
    return [look_at(e, e * [1, 1, 0], np.array([0, 1.0, 0]), width=100, height=100, fx=120) for e in eyes]


# distances


def test_distances_to_the_plane_edges_and_corners_of_a_triangle() -> None:
    triangle = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0]])
    points = np.array([[1, 1, 2.0], [2, -3, 4], [-3, -4, 0], [7, 0, 4], [4, 3, 0], [0, 0, 0]])
    # above the inside: 2; beside the edge y = 0: (3, 4) -> 5; at the corner: 5; beyond (4,0,0): 5;
    # beside 3x + 4y = 12: (12 + 12 - 12) / 5 = 2.4; on it: 0
    expected = [2, 5, 5, 5, 2.4, 0]
    got = triangle_distances(torch.from_numpy(points), torch.from_numpy(triangle).expand(len(points), 3, 3)).numpy()
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_distances_agree_with_trimesh_on_a_crumpled_mesh() -> None:
    rng = np.random.default_rng(1)
    mesh = square(0.0, cells=12)
    crumpled = Mesh(mesh.vertices + rng.normal(0, 0.03, mesh.vertices.shape), mesh.faces)
    queries = rng.uniform(-1, 1, (300, 3)) * [1, 1, 0.2]
    _, expected, _ = trimesh.proximity.closest_point_naive(
        trimesh.Trimesh(crumpled.vertices, crumpled.faces, process=False), queries
    )
    np.testing.assert_allclose(distances_to_mesh(queries, crumpled, samples=20000), expected, atol=1e-9)


# samples


def test_samples_are_area_weighted_and_reproducible() -> None:
    mesh = merged(square(0.0, half=1.0), square(1.0, half=2.0))  # areas 4 and 16
    assert face_areas(mesh).tolist() == [2.0, 2.0, 8.0, 8.0]
    one, two = sample_surface(mesh, 10_000, seed=3), sample_surface(mesh, 10_000, seed=3)
    np.testing.assert_array_equal(one.points, two.points)
    assert not np.array_equal(one.points, sample_surface(mesh, 10_000, seed=4).points)
    np.testing.assert_allclose(one.points[:, 2], one.faces >= 2, atol=1e-12)
    # stratified: each face has its share within one point at each end
    np.testing.assert_allclose(np.bincount(one.faces), [1000, 1000, 4000, 4000], atol=2)
    high = one.points[one.faces >= 2]
    assert np.abs(high.mean(0)[:2]).max() < 4 * (4 / np.sqrt(12)) / np.sqrt(8000)  # uniform: four standard errors
    quarter = ((high[:, 0] > 0) & (high[:, 1] > 0)).mean()
    assert abs(quarter - 0.25) < 0.02


# visibility


def depths(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Depth [H, W] world units of the nearest face, 0 where there is none."""
    return cast_camera(mesh.vertices.astype(np.float64), mesh.faces, camera).depth


def test_depth_equals_another_ray_caster(shared: Callable[[str], Path]) -> None:
    """Against the published depth maps of test views, float16: within 0.002."""
    folder = shared("rendered_bottle")
    mesh = read_mesh(folder / "mesh_gt.ply")
    info = json.loads((folder / "transforms_test.json").read_text())
    focal = 200 / np.tan(info["camera_angle_x"] / 2)
    T = np.linalg.inv(np.array(info["frames"][0]["transform_matrix"]) @ np.diag([1.0, -1, -1, 1]))
    got = depths(mesh, Camera(400, 400, focal, focal, 200.0, 200.0, T))
    expected = np.load(folder / "depth_test" / "r_0.npy").astype(np.float64)
    assert ((got > 0) != (expected > 0)).sum() <= 2
    both = (got > 0) & (expected > 0)
    assert both.sum() > 10_000
    assert np.abs(got - expected)[both].max() < 0.003


def test_a_closed_surface_has_no_pinholes() -> None:
    camera = look_at(np.array([1, 2, 4.0]), np.zeros(3), np.array([0, 1.0, 0]), width=200, height=200, fx=150)
    rng = np.random.default_rng(0)
    mesh = square(0.0, half=20.0, cells=40)
    jitter = rng.uniform(-0.2, 0.2, mesh.vertices.shape) * [1, 1, 0]
    assert (depths(Mesh(mesh.vertices + jitter, mesh.faces), camera) > 0).all()


def test_occlusion_does_not_depend_on_units() -> None:
    """A capture in kilometres: all of it is nearer to the cameras than a millimetre is in metres."""
    small = 1e-4
    cameras = [Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, scaled(c.T_cam_world, small)) for c in from_above(3)]
    mesh = square(0.0)
    points = np.array([[0, 0, 0.0], [0, 0, -0.5]])
    tiny = Mesh(mesh.vertices * small, mesh.faces)
    assert visible_counts(points * small, tiny, cameras, tolerance=0.01 * small).tolist() == [3, 0]


def scaled(T_cam_world: np.ndarray, scale: float) -> np.ndarray:
    T = T_cam_world.copy()
    T[:3, 3] *= scale
    return T


# scores


def test_parallel_squares_have_their_distance_both_ways() -> None:
    score = evaluate_surface(square(0.1), square(0.0), thresholds=[0.09, 0.11], samples=1000)
    assert score.accuracy == pytest.approx(0.1)
    assert score.completeness == pytest.approx(0.1)
    assert score.chamfer == pytest.approx(0.1)
    assert [(s.precision, s.recall, s.f_score) for s in score.scores] == [(0, 0, 0), (1, 1, 1)]
    assert score.diagonal == pytest.approx(8**0.5)
    assert (score.mesh_hidden, score.truth_hidden, score.reason) == (0, 0, None)


def test_half_of_a_square_has_full_precision_and_half_recall() -> None:
    whole = square(0.0, cells=2)
    half = Mesh(whole.vertices, whole.faces[whole.vertices[whole.faces].mean(1)[:, 0] < 0])
    score = evaluate_surface(half, whole, thresholds=[1e-6], samples=20_000)
    (at,) = score.scores
    assert at.precision is not None
    assert at.precision > 0.999  # a point beside the edge of a large face may miss it
    assert at.recall == pytest.approx(0.5, abs=0.01)
    assert at.f_score == pytest.approx(2 / 3, abs=0.01)
    assert score.accuracy == pytest.approx(0, abs=1e-5)
    assert score.completeness == pytest.approx(0.25, abs=0.01)  # half the points, at 0 to 1 from the half square


def test_true_surface_seen_by_few_cameras_is_not_scored() -> None:
    truth = merged(square(0.0), square(-1.0))  # the lower one is hidden
    cameras = from_above(3)
    score = evaluate_surface(square(0.0), truth, cameras=cameras, thresholds=[0.01], samples=4000)
    assert score.scores[0].recall == 1
    assert score.truth_hidden == pytest.approx(0.5, abs=0.05)  # slanted views see a rim of it past the edge
    everything = evaluate_surface(square(0.0), truth, thresholds=[0.01], samples=4000)
    assert everything.scores[0].recall == pytest.approx(0.5, abs=0.01)
    with pytest.raises(DataError, match="no camera sees any part"):
        evaluate_surface(square(0.0), truth, cameras=cameras[:2], samples=100)


def test_view_counts_of_the_data_are_used() -> None:
    truth = merged(square(0.0), square(-1.0))
    seen = np.array([5, 5, 2, 2])
    score = evaluate_surface(square(0.0), truth, view_counts=seen, thresholds=[0.01], samples=4000)
    assert score.scores[0].recall == 1
    assert score.truth_hidden == pytest.approx(0.5, abs=0.001)
    low = evaluate_surface(square(0.0), truth, view_counts=seen, min_views=2, thresholds=[0.01], samples=4000)
    assert low.scores[0].recall == pytest.approx(0.5, abs=0.001)
    with pytest.raises(DataError, match="one count for each of 4"):
        evaluate_surface(square(0.0), truth, view_counts=seen[:3])


def test_invisible_reconstructed_surface_is_not_scored() -> None:
    inside = merged(square(0.0), square(-0.5, half=0.5))  # a second sheet below, hidden by the first
    score = evaluate_surface(inside, square(0.0), cameras=from_above(3), thresholds=[0.01], samples=4000)
    assert score.scores[0].precision == 1
    assert score.mesh_hidden == pytest.approx(0.2, abs=0.02)  # 1 of 5
    above = merged(square(0.0), square(0.5, half=0.5))  # a sheet above is in every picture
    punished = evaluate_surface(above, square(0.0), cameras=from_above(3), thresholds=[0.01], samples=4000)
    assert punished.scores[0].precision is not None
    assert punished.scores[0].precision < 0.85


def test_reconstruction_on_unseen_true_surface_is_correct() -> None:
    truth = merged(square(0.0), square(-1.0))
    score = evaluate_surface(square(-1.0), truth, view_counts=np.array([3, 3, 0, 0]), thresholds=[0.01], samples=1000)
    assert score.scores[0].precision == 1
    assert score.scores[0].recall == 0


def test_a_mesh_in_another_frame_is_scored_in_the_units_of_the_truth() -> None:
    """truth = 2 R mesh + t: a mesh 0.1 off in its own frame is 0.2 off in the truth's."""
    c, s = np.cos(0.7), np.sin(0.7)
    T = np.eye(4)
    T[:3, :3] = 2 * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    T[:3, 3] = [5, -3, 1]
    flat = square(0.0)
    truth = Mesh(flat.vertices @ T[:3, :3].T + T[:3, 3], flat.faces)
    score = evaluate_surface(square(0.1), truth, cameras=from_above(3), T_truth_mesh=T, thresholds=[0.25], samples=1000)
    assert score.accuracy == pytest.approx(0.2)
    assert score.completeness == pytest.approx(0.2)
    assert score.scores[0].f_score == 1
    T[0, 0] *= 1.1
    with pytest.raises(DataError, match="one positive scale"):
        evaluate_surface(flat, truth, T_truth_mesh=T)


def test_an_empty_truth_is_a_data_error() -> None:
    with pytest.raises(DataError, match="finite points"):
        evaluate_surface(square(0.0), np.zeros((0, 3)))
