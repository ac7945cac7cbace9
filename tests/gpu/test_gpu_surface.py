"""Surface scores on a GPU are those of the CPU: neighbours, thinning, visibility, and what is made of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.evaluation.dtu import thin
from gs2d.evaluation.nearest import Cloud
from gs2d.evaluation.surface import evaluate_surface
from gs2d.evaluation.visibility import depth_buffer, visible_counts
from gs2d.render.backends import Backend
from oracle_scenes import grid_mesh, hills

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(300)]
POINTS = 300_000


def a_mesh(cells: int, shift: float = 0.0) -> Mesh:
    return Mesh(*grid_mesh(cells, 1.0, lambda x, y: hills(x, y) + shift * np.sin(5 * x)))


@pytest.mark.parametrize("neighbours", [1, 8])
def test_the_nearest_points_are_those_of_scipy(gpu: Backend, neighbours: int) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(POINTS, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[::50] = points[0]  # duplicates
    points[0] = [1e9, 0, 0]  # and something far away
    queries = points[: POINTS // 3] + 0.01 * rng.normal(size=(POINTS // 3, 3))
    distances, index = Cloud(points, device=gpu.device).nearest(queries, neighbours=neighbours)
    expected = cKDTree(points).query(queries, k=range(1, neighbours + 1), workers=-1)[0]
    np.testing.assert_allclose(distances, expected, rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(points[index] - queries[:, None], axis=2), expected, rtol=1e-14)


def test_the_thinned_points_are_those_of_the_cpu_in_their_order(gpu: Backend) -> None:
    points = np.random.default_rng(1).uniform(0, 1, (POINTS, 3)) * [1, 1, 0.01]
    found = thin(points, 0.004, slab_size=POINTS // 4, device=gpu.device)
    np.testing.assert_array_equal(found, thin(points, 0.004, slab_size=POINTS // 4))
    assert 0 < len(found) < len(points)


def test_what_cameras_see_is_the_same(gpu: Backend) -> None:
    """Sums of products may round differently there: a point at the very limit, a pixel at the very edge."""
    eyes = [np.array([2 * np.cos(a), 2 * np.sin(a), 1.5]) for a in range(6)]
    cameras = [look_at(e, np.zeros(3), np.array([0, 0, 1.0]), width=300, height=200, fx=250) for e in eyes]
    mesh = a_mesh(300)
    here, there = (depth_buffer(mesh, cameras[0], device=device) for device in ("cpu", gpu.device))
    assert (np.isfinite(here) != np.isfinite(there)).sum() <= 4
    both = np.isfinite(here) & np.isfinite(there)
    assert both.mean() > 0.1
    assert np.median(np.abs(here[both] - there[both])) < 1e-12
    points = a_mesh(100).vertices
    counts = [visible_counts(points, mesh, cameras, tolerance=0.01, device=d) for d in ("cpu", gpu.device)]
    assert (counts[0] != counts[1]).mean() < 1e-3
    assert 0 < counts[0].mean() < 6


def test_a_score_is_that_of_the_cpu(gpu: Backend) -> None:
    mesh, truth = a_mesh(200, shift=0.01), a_mesh(150)
    here, there = (evaluate_surface(mesh, truth, samples=POINTS // 3, device=device) for device in ("cpu", gpu.device))
    assert there.chamfer == pytest.approx(here.chamfer, rel=1e-9)
    assert [row.f_score for row in there.scores] == pytest.approx([row.f_score for row in here.scores], abs=1e-4)
