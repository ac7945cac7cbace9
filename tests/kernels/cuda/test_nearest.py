"""Nearest neighbours on a GPU, executed on the CPU by the emulator, against scipy's trees."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

import emulate
from gs2d.errors import ShapeError
from gs2d.kernels.cuda.nearest import LEAF, build_tree, choose_spread, find_nearest

pytestmark = pytest.mark.timeout(120)


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    surface = rng.normal(size=(700, 3))
    surface /= np.linalg.norm(surface, axis=1, keepdims=True)
    return {
        "surface": surface,
        "plane": np.column_stack([rng.uniform(-1, 1, (500, 2)), np.zeros(500)]),
        "lattice": np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3),  # ties everywhere
        "duplicates": np.repeat(rng.normal(size=(20, 3)), 30, axis=0),
        "one place": np.full((300, 3), 0.5),
        "far outliers": np.concatenate([surface * 1e-3, [[1e12, 0, 0], [0, -1e15, 1e15]]]),
        "two clusters": np.concatenate([surface, surface * 1e-9 + 1e6]),
        "one": np.array([[1.0, 2, 3]]),
        "a full leaf": rng.normal(size=(LEAF, 3)),
        "a leaf and one": rng.normal(size=(LEAF + 1, 3)),
    }


@pytest.mark.parametrize("name", clouds())
@pytest.mark.parametrize("neighbours", [1, 8])
def test_distances_are_those_of_scipy(emulator: emulate.Emulator, name: str, neighbours: int) -> None:
    points = clouds()[name]
    rng = np.random.default_rng(1)
    size = np.ptp(points, axis=0).max() or 1.0
    chosen = points[rng.integers(0, len(points), 150)]
    queries = np.concatenate([chosen, chosen + 0.03 * size * rng.normal(size=(150, 3)), [[1e9, 1e9, -1e9]]])
    tree = build_tree(torch.from_numpy(points))
    distances, index = find_nearest(tree, torch.from_numpy(queries), launcher=emulator, neighbours=neighbours)
    k = min(neighbours, len(points))
    expected = cKDTree(points).query(queries, k=range(1, k + 1))[0]
    np.testing.assert_allclose(distances[:, :k].numpy(), expected, rtol=1e-15)
    # the index is of a point at that distance, and no point is found twice
    away = np.linalg.norm(points[index[:, :k].numpy()] - queries[:, None], axis=2)
    np.testing.assert_allclose(away, expected, rtol=1e-15)
    assert all(len(set(row)) == k for row in index[:, :k].tolist())
    assert torch.isinf(distances[:, k:]).all()
    assert (index[:, k:] == len(points)).all()


def test_only_what_is_nearer_than_the_limit_is_found(emulator: emulate.Emulator) -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]], dtype=torch.float64)
    queries = torch.tensor([[0.25, 0, 0], [2.0, 0, 0], [9, 0, 0]], dtype=torch.float64)
    distances, index = find_nearest(build_tree(points), queries, launcher=emulator, limit=1.0)
    # (2, 0, 0) is exactly 1 from both of its neighbours: as in scipy that is not nearer
    assert distances.squeeze(1).tolist() == [0.25, float("inf"), float("inf")]
    assert index.squeeze(1).tolist() == [0, 3, 3]


def test_an_empty_cloud_has_no_neighbours_and_no_queries_have_no_answers(emulator: emulate.Emulator) -> None:
    none = torch.zeros(0, 3, dtype=torch.float64)
    distances, index = find_nearest(build_tree(none), torch.ones(5, 3, dtype=torch.float64), launcher=emulator)
    assert torch.isinf(distances).all()
    assert index.tolist() == [[0]] * 5
    distances, _ = find_nearest(build_tree(torch.ones(4, 3, dtype=torch.float64)), none, launcher=emulator)
    assert distances.shape == (0, 1)


def test_a_tree_is_balanced_and_its_boxes_hold_what_is_below() -> None:
    points = torch.from_numpy(clouds()["far outliers"])
    tree = build_tree(points)
    leaves = len(tree.points) // LEAF
    assert leaves == 128  # 702 points: 88 leaves would do
    assert sorted(tree.index.tolist()) == [*range(702), *[702] * (1024 - 702)]
    lone = tree.points[tree.index < 702]
    assert torch.equal(lone, points[tree.index[tree.index < 702]])
    for node in range(1, 2 * leaves):
        depth = node.bit_length() - 1
        width = len(tree.points) >> depth
        inside = tree.points[(node - (1 << depth)) * width :][:width]
        inside = inside[inside[:, 0].isfinite()]
        low, high = tree.boxes[node, :3], tree.boxes[node, 3:]
        if len(inside):
            assert torch.equal(low, inside.amin(dim=0))
            assert torch.equal(high, inside.amax(dim=0))
        else:
            assert torch.isinf(low).all()
            assert (high == -torch.inf).all()


def test_a_search_looks_at_few_points_whatever_their_distribution() -> None:
    """A thread's own walk in Python: visits of leaves, which are what a search costs."""
    for name, points in clouds().items():
        tree = build_tree(torch.from_numpy(points))
        visits = [leaves_visited(tree, query) for query in points[:: max(1, len(points) // 20)]]
        assert np.mean(visits) <= 12, (name, visits)


def leaves_visited(tree, query: np.ndarray) -> int:
    boxes, points = tree.boxes.numpy(), tree.points.numpy()
    leaves, best, visited = len(points) // LEAF, np.inf, 0
    todo = [1]
    while todo:
        node = todo.pop()
        away = np.maximum(np.maximum(boxes[node, :3] - query, query - boxes[node, 3:]), 0)
        if not np.square(away).sum() < best:
            continue
        if node >= leaves:
            visited += 1
            at = points[(node - leaves) * LEAF :][:LEAF]
            best = min(best, np.square(at - query).sum(axis=1).min())
        else:
            gaps = [np.square(np.maximum(np.maximum(boxes[c, :3] - query, query - boxes[c, 3:]), 0)).sum()
                    for c in (2 * node, 2 * node + 1)]  # fmt: skip
            todo += [2 * node + int(gaps[1] >= gaps[0]), 2 * node + int(gaps[1] < gaps[0])]  # the nearer comes first
    return visited


@pytest.mark.parametrize("seed", [0, 1])
def test_points_that_keep_a_distance_are_those_of_a_greedy_choice_one_by_one(seed: int, tmp_path_factory) -> None:
    emulator = emulate.Emulator(tmp_path_factory.mktemp("spread"), seed=seed)
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 1, (600, 3)) * [1, 1, 0.05]
    points[100:110] = points[0]  # duplicates
    points[200] = points[1] + [0.25, 0, 0]  # exactly the radius away: too near
    taken: list[int] = []
    for i, point in enumerate(points):
        if not taken or np.linalg.norm(points[taken] - point, axis=1).min() > 0.07:
            taken.append(i)
    found = choose_spread(torch.from_numpy(points), 0.07, launcher=emulator)
    assert np.flatnonzero(found.numpy()).tolist() == taken
    assert 30 < len(taken) < 400


def test_what_is_exactly_the_radius_away_is_too_near(emulator: emulate.Emulator) -> None:
    line = torch.zeros(5, 3, dtype=torch.float64)
    line[:, 0] = torch.arange(5) * 0.25
    assert choose_spread(line, 0.25, launcher=emulator).tolist() == [True, False, True, False, True]
    assert choose_spread(line[:0], 0.25, launcher=emulator).tolist() == []


def test_other_shapes_and_types_are_refused(emulator: emulate.Emulator) -> None:
    with pytest.raises(ShapeError, match=r"points must be \[P, 3\] float64"):
        build_tree(torch.zeros(4, 3))
    tree = build_tree(torch.zeros(4, 3, dtype=torch.float64))
    with pytest.raises(ShapeError, match=r"queries must be \[Q, 3\] float64 on cpu"):
        find_nearest(tree, torch.zeros(4, 3), launcher=emulator)
    with pytest.raises(ShapeError, match="neighbours must be one of"):
        find_nearest(tree, torch.zeros(4, 3, dtype=torch.float64), launcher=emulator, neighbours=3)
