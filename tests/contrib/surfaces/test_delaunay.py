"""Meshes from Delaunay tetrahedra: closed, accurate, without sheets; native code agrees with Qhull and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from scipy.spatial import Delaunay

from gs2d.contrib.surfaces.delaunay import extract_delaunay
from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import ProtocolError
from gs2d.kernels.library import load
from gs2d.meshing.depth_maps import RenderedView
from gs2d.meshing.evidence import areas
from gs2d.meshing.extract import ExtractOptions
from gs2d.meshing.minimum_cut import UNIT, Lines, cast_votes, minimum_cut_on_cpu
from gs2d.meshing.tetrahedra import CUBE, FACES, Tetrahedra, divide
from surface_shapes import orbit, rays, sphere_depth

BOX = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]])


def ball(count: int = 14, *, size: int = 48) -> list[RenderedView]:
    """Render exact depth of a unit ball from all around, over nothing."""
    made = []
    for camera in orbit(count, 4.0, size=size, focal=1.3 * size):
        color = np.full((camera.height, camera.width, 3), (200, 40, 90), np.uint8)
        made.append(RenderedView(camera, sphere_depth(camera, 1.0), color))
    return made


def open_edges(mesh: Mesh) -> int:
    """Return the number of edges that do not belong to exactly two faces."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] != 2).sum())


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def volumes(space: Tetrahedra) -> np.ndarray:
    a, b, c, d = (space.xyz[space.corners[:, k]] for k in range(4))
    return np.asarray(((b - a) * np.cross(c - a, d - a)).sum(axis=1) / 6)


# -- tetrahedra --------------------------------------------------------------------------------------------------------
def test_tetrahedra_are_those_of_qhull() -> None:
    points = np.random.default_rng(1).normal(size=(300, 3))
    space = divide(points, np.zeros((0, 3)), load())
    both = (space.corners, Delaunay(space.xyz).simplices)
    ours, theirs = ({tuple(sorted(row)) for row in corners.tolist()} for corners in both)
    corner = len(points)  # near the corners of the cube, four of which lie on a sphere, either is right
    assert {row for row in ours if row[-1] < corner} == {row for row in theirs if row[-1] < corner}
    assert len([row for row in ours if row[-1] < corner]) > 1000


@pytest.mark.parametrize("kind", ["grid", "plane", "line", "duplicates"])
def test_degenerate_points_fill_the_cube_without_overlap(kind: str) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3)
    points = {
        "grid": grid,
        "plane": grid * [1, 1, 0],
        "line": grid * [1, 0, 0],
        "duplicates": np.concatenate([grid, grid]),
    }[kind]
    space = divide(points, np.zeros((0, 3)), load())
    assert volumes(space).min() > 0
    side = np.ptp(space.xyz, axis=0).max()
    assert volumes(space).sum() == pytest.approx(side**3)
    there = space.neighbours >= 0
    back = space.neighbours[space.neighbours[there], space.mirror[there]]
    np.testing.assert_array_equal(back, np.nonzero(there)[0])
    # every distinct place is a corner
    assert len(np.unique(points, axis=0)) == (space.first()[: len(points)] >= 0).sum()
    assert CUBE < 1 << 22  # the bound of the exact predicates


# -- votes and cut -----------------------------------------------------------------------------------------------------
def spans(space: Tetrahedra, start: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a ray enters and leaves each tetrahedron [T], and the facet it leaves through; inf if it misses."""
    rates, heights = np.empty((2, *space.corners.shape))
    for k in range(4):
        p, q, r = (space.xyz[space.corners[:, i]] for i in FACES[k])
        normal = np.cross(q - p, r - p)  # inwards
        rates[:, k], heights[:, k] = normal @ direction, (normal * (start - p)).sum(axis=1)
    distance = -heights / rates
    enters = np.maximum(np.where(rates > 0, distance, 0).max(axis=1), 0)
    leaving = np.where(rates < 0, distance, np.inf)
    leaves, facet = leaving.min(axis=1), leaving.argmin(axis=1)
    met = leaves > enters + 1e-9
    return np.where(met, enters, np.inf), np.where(met, leaves, np.inf), facet


def test_votes_are_those_of_every_line_with_every_tetrahedron() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    space = divide(points, np.full((1, 3), 3.0), load())
    ends, weights, sigma, surfaces = np.arange(200, dtype=np.int32), rng.uniform(0.5, 2, 200), 0.1, 150
    votes = cast_votes(space, Lines(ends, 3.0 * points, np.full(200, sigma), weights, surfaces), load())
    facets, full, cameras = (np.zeros_like(votes[name]) for name in ("facets", "full", "cameras"))
    for line, weight in enumerate(np.rint(UNIT * weights)):
        start, away = space.xyz[line], 3.0 * points[line] - space.xyz[line]
        length = np.linalg.norm(away)
        enters, leaves, facet = spans(space, start, away / length)
        crossed = np.flatnonzero(leaves < length)
        across = space.neighbours[crossed, facet[crossed]], space.mirror[crossed, facet[crossed]]
        facets[across] += np.floor(weight * (1 - np.exp(-0.5 * (leaves[crossed] / sigma) ** 2)) + 0.5).astype(np.int32)
        cameras[(enters < length) & (leaves >= length)] = 1
        if line < surfaces:
            enters, leaves, _ = spans(space, start, -away / length)
            full[(enters < sigma) & (leaves >= sigma)] += int(weight)
    np.testing.assert_array_equal(votes["facets"], facets)
    np.testing.assert_array_equal(votes["full"], full)
    np.testing.assert_array_equal(votes["cameras"], cameras)
    assert (full > 0).sum() > 50
    assert facets.sum() > 0


def test_the_cut_has_the_cost_of_scipys_maximum_flow_and_the_smallest_source_side() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        neighbours = Delaunay(rng.normal(size=(rng.integers(6, 120), 3))).neighbors.astype(np.int32)
        count = len(neighbours)
        node, arc = np.nonzero(neighbours >= 0)
        mirror = np.zeros(neighbours.shape, np.uint8)
        mirror[node, arc] = (neighbours[neighbours[node, arc]] == node[:, None]).argmax(axis=1)
        capacity = (rng.integers(0, 20, neighbours.shape) * (rng.random(neighbours.shape) < 0.8)).astype(np.int32)
        capacity[neighbours < 0] = 0
        terminal = (rng.integers(-60, 60, count) * (rng.random(count) < 0.4)).astype(np.int32)
        graph = np.zeros((count + 2, count + 2), np.int32)  # with source and sink
        graph[node, neighbours[node, arc]] = capacity[node, arc]
        graph[count, :count], graph[:count, count + 1] = np.maximum(terminal, 0), np.maximum(-terminal, 0)
        side, flow = minimum_cut_on_cpu(load(), neighbours, mirror, capacity.copy(), terminal.copy())
        expected = maximum_flow(csr_array(graph), count, count + 1)
        left = csr_array(graph - expected.flow.toarray())
        reached = breadth_first_order(left, count, return_predecessors=False)
        assert flow == expected.flow_value
        np.testing.assert_array_equal(np.flatnonzero(side), np.sort(reached[reached < count]))


# -- surfaces ----------------------------------------------------------------------------------------------------------
def test_exact_depth_of_a_ball_gives_a_closed_accurate_surface() -> None:
    found = extract_delaunay(ball(size=32), ExtractOptions(bbox=BOX))
    distance = np.linalg.norm(found.mesh.vertices, axis=1)
    assert open_edges(found.mesh) == 0
    assert volume(found.mesh) == pytest.approx(4 / 3 * np.pi, rel=0.05)
    assert np.abs(distance - 1).mean() < 0.2 * found.limits.pixel_footprint
    assert found.mesh.colors is not None
    np.testing.assert_array_equal(np.unique(found.mesh.colors, axis=0), [[200, 40, 90]])
    assert found.backend == "cpu"


def test_watertight_closes_what_no_view_shows_and_the_open_surface_ends_there() -> None:
    frames = ball(size=96)
    for frame in frames:
        # pixels of the cap above z = 0.2 are invalid
        start, step = rays(frame.camera)
        frame.depth[(start + step * frame.depth[..., None])[..., 2] > 0.2] = 0
    opened, closed = (extract_delaunay(frames, ExtractOptions(bbox=BOX, watertight=w)).mesh for w in (False, True))
    assert open_edges(opened) > 10
    assert opened.vertices[:, 2].max() < 0.3
    assert open_edges(closed) == 0
    cap = np.pi * 0.8**2 * (3 - 0.8) / 3  # between the plane and the ball
    assert 4 / 3 * np.pi - 1.5 * cap < volume(closed) < 4 / 3 * np.pi * 1.05


def test_lines_of_sight_to_the_sky_remove_what_few_views_show_there() -> None:
    def area_beside(sky: float) -> float:
        frames, center = ball(size=96), (0.0, 0.0, 1.5)
        for number, frame in enumerate(frames):
            empty = frame.depth == 0
            frame.depth[empty] = sky
            false = sphere_depth(frame.camera, 0.3, center)
            if 5 <= number < 9:  # views from beside show a second ball above the first
                frame.depth[empty & (false > 0)] = false[empty & (false > 0)]
        mesh = extract_delaunay(frames, ExtractOptions(bbox=1.3 * BOX)).mesh
        middle = mesh.vertices[mesh.faces].mean(axis=1)
        return float(areas(mesh)[np.linalg.norm(middle - center, axis=1) < 0.4].sum())

    assert area_beside(0.0) > 0.05
    assert area_beside(np.inf) < 0.01


def test_the_memory_limit_bounds_the_number_of_points(monkeypatch: pytest.MonkeyPatch) -> None:
    fine = extract_delaunay(ball(), ExtractOptions(bbox=BOX))
    monkeypatch.setattr("gs2d.contrib.surfaces.delaunay.BYTES_A_POINT", ExtractOptions().max_bytes // 300)
    coarse = extract_delaunay(ball(), ExtractOptions(bbox=BOX))
    assert len(fine.mesh.vertices) > 1000
    assert 100 < len(coarse.mesh.vertices) <= 300
    assert volume(coarse.mesh) == pytest.approx(4 / 3 * np.pi, rel=0.1)


def test_bad_input_is_one_line() -> None:
    with pytest.raises(ProtocolError, match="needs two or more views, got 1; use --method tsdf"):
        extract_delaunay(ball()[:1])
    far = np.array([[50.0, 50, 50], [51, 51, 51]])
    with pytest.raises(ProtocolError, match="no depth is inside the limits"):
        extract_delaunay(ball(), ExtractOptions(bbox=far))
    camera = look_at((0, 0, -4), (0, 0, 0), (0, 1, 0), width=16, height=16, fx=20)
    empty = [RenderedView(camera, np.zeros((16, 16)))] * 2
    with pytest.raises(ProtocolError, match="expected depth maps with valid pixels, got none"):
        extract_delaunay(empty)
