"""Surface scores of a run on a GPU, its kernels executed on the CPU: the figures are those of scipy."""

from __future__ import annotations

from dataclasses import astuple, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import emulate
from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.evaluation import dtu, visibility
from gs2d.evaluation import nearest as neighbours
from gs2d.evaluation.dtu import thin
from gs2d.evaluation.icp import icp
from gs2d.evaluation.nearest import Cloud
from gs2d.evaluation.surface import evaluate_surface
from oracle_scenes import grid_mesh, hills, tnt_scene

pytestmark = pytest.mark.timeout(120)
GPU = "cpu"  # where torch's part runs here


@pytest.fixture
def launched(emulator: emulate.Emulator, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Everything in ``gs2d.evaluation`` takes the CPU for a GPU; the names of the kernels that were launched."""
    names: list[str] = []

    def launch(name: str, *rest: object) -> None:
        names.append(name)
        emulator.launch(name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(neighbours, "_gpu", lambda device: (torch.device(device), SimpleNamespace(launch=launch)))
    for module in (neighbours, dtu, visibility):
        monkeypatch.setattr(module, "on_gpu", lambda device: True)
    return names


def a_mesh(shift: float) -> Mesh:
    return Mesh(*grid_mesh(12, 1.0, lambda x, y: hills(x, y) + shift * np.sin(5 * x)))


def test_a_surface_score_is_that_of_the_cpu(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = [look_at(np.array([x, 0.5, 3.0]), np.zeros(3), np.array([0, 1.0, 0]), width=40, height=40, fx=40)
               for x in (-1.0, 0.0, 1.0)]  # fmt: skip
    given = {"cameras": cameras, "samples": 400, "min_views": 2}
    score = evaluate_surface(a_mesh(0.02), a_mesh(0.0), device=GPU, **given)
    assert launched == ["nearest_8", "nearest_8"]
    monkeypatch.undo()
    expected = evaluate_surface(a_mesh(0.02), a_mesh(0.0), **given)
    np.testing.assert_allclose(astuple(replace(score, scores=(), clouds=None))[:5],
                               astuple(replace(expected, scores=(), clouds=None))[:5], rtol=1e-12)  # fmt: skip
    assert score.scores == expected.scores
    assert 0 < score.chamfer < 0.02


def test_a_point_cloud_as_truth_asks_for_one_neighbour(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = a_mesh(0.0).vertices
    score = evaluate_surface(a_mesh(0.02), cloud, device=GPU, samples=300)
    assert launched == ["nearest_1", "nearest_8"]
    monkeypatch.undo()
    assert score.accuracy == pytest.approx(evaluate_surface(a_mesh(0.02), cloud, samples=300).accuracy, rel=1e-12)


def test_the_thinned_points_are_those_of_the_cpu_in_their_order(
    launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (800, 3)) * [1, 0.5, 0.02]
    found = thin(points, 0.05, seed=3, slab_size=150, device=GPU)
    assert set(launched) == {"spread_points"}
    monkeypatch.undo()
    np.testing.assert_array_equal(found, thin(points, 0.05, seed=3, slab_size=150))
    assert 50 < len(found) < 400


def test_an_alignment_is_that_of_the_cpu(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tnt_scene(0)
    source = scene.scan[::20] * 1.01 + [0.01, 0, 0.02]
    found = icp(source, scene.scan, threshold=0.03, iterations=4, device=GPU)
    assert len(launched) == 1 + found.iterations >= 3
    monkeypatch.undo()
    expected = icp(source, scene.scan, threshold=0.03, iterations=4)
    np.testing.assert_allclose(found.T_target_source, expected.T_target_source, atol=1e-12)
    assert found.share == expected.share


def test_queries_are_asked_in_pieces(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(1).normal(size=(90, 3))
    whole = Cloud(points, device=GPU).nearest(points[::2] + 0.1, neighbours=8)
    monkeypatch.setattr(neighbours, "GPU_CHUNK", 7)
    pieces = Cloud(points, device=GPU).nearest(points[::2] + 0.1, neighbours=8)
    assert launched == ["nearest_8"] * 8
    for a, b in zip(whole, pieces, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("on", ["the CPU", "a GPU"])
def test_what_is_not_finite_is_refused(on: str, request: pytest.FixtureRequest) -> None:
    if on == "a GPU":
        request.getfixturevalue("launched")
    points = np.zeros((3, 3))
    for bad in (np.nan, np.inf):
        broken = np.array([[0.0, bad, 0]])
        with pytest.raises(DataError, match="finite points were expected"):
            Cloud(broken)
        with pytest.raises(DataError, match="finite queries were expected"):
            Cloud(points).nearest(broken)
    distances, index = Cloud(points[:0]).nearest(points)
    assert np.isinf(distances).all()
    assert index.tolist() == [[0]] * 3
