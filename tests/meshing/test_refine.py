"""Photometric refinement: the gradient, the operators, and meshes that get closer to the surface."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import BackendError
from gs2d.kernels.library import Library, load
from gs2d.meshing.bending import Curvature, solve, split_edges
from gs2d.meshing.marching_cubes import components
from gs2d.meshing.raycast import cast_camera
from gs2d.meshing.refine import Refinement, RefineSettings, choose_neighbours, coarse_to_fine
from gs2d.meshing.warped_ncc import (
    DrawnMesh,
    GreyImage,
    MatchSettings,
    Pull,
    Surface,
    brightness_share,
    draw_mesh,
    gather_vertices,
    match_views,
)

SIDE = 14  # vertices along a sheet
EVERYTHING = MatchSettings(radius=2, texture=1e-30, poor=-3, good=-2, occluded=0.5, grazing=0.0)  # all weights are 1


@pytest.fixture(scope="module")
def exact() -> Library:
    try:
        return load("f64")
    except BackendError:
        pytest.skip("the float64 kernels are not built")


@pytest.fixture(scope="module")
def fast() -> Library:
    try:
        return load()
    except BackendError:
        pytest.skip("the native kernels are not built")


def sheet(side: int = SIDE, height: float = 0.1) -> Mesh:
    """Return a wavy sheet around z = 0, seen from above in counter-clockwise order."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    z = height * np.sin(3 * x) * np.cos(2 * y)
    at = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.reshape(-1) for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return Mesh(np.stack([x, y, z], axis=2).reshape(-1, 3), faces)


def camera_at(x: float, y: float, size: int = 60) -> Camera:
    return look_at(np.array([x, y, 2.2]), np.zeros(3), np.array([0, 1.0, 0]), width=size, height=size, fx=0.9 * size)


def waves(points: np.ndarray) -> np.ndarray:
    """Return the grey value of surface points [..., 3]."""
    x, y = points[..., 0], points[..., 1]
    return np.asarray(0.5 + 0.2 * np.sin(9 * x + 3 * y) + 0.2 * np.cos(8 * y - 5 * x * y))


def points_of(camera: Camera, drawn: DrawnMesh) -> np.ndarray:
    """Return the surface points [H, W, 3] of the pixels."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=2)
    return np.asarray((drawn.depth[..., None] * rays - camera.T_cam_world[:3, 3]) @ camera.rotation)


def photograph(mesh: Mesh, camera: Camera) -> GreyImage:
    hits = cast_camera(mesh.vertices, mesh.faces, camera)
    drawn = DrawnMesh(hits.face, hits.depth)
    return GreyImage(camera, np.where(drawn.face >= 0, waves(points_of(camera, drawn)), 0.1))


def pulled(
    vertices: np.ndarray, pair: tuple[GreyImage, GreyImage], settings: MatchSettings, library: Library
) -> tuple[float, Pull]:
    """Return the energy of one pair, and its derivatives by the heights of a sheet's vertices."""
    faces, view, other = sheet().faces, *pair
    here, there = (draw_mesh(vertices, faces, item.camera, library) for item in pair)
    dtype = np.float32 if library.dtype.itemsize == 4 else np.float64
    by_pixel = Pull.zeros(here.depth.shape, dtype)
    match_views(view, other, here.depth, there.depth, settings, by_pixel, library)
    surface = Surface(vertices, faces, np.tile([0.0, 0, 1], (len(vertices), 1)))
    pull = Pull.zeros(len(vertices))
    gather_vertices(surface, view.camera, here.face, by_pixel, pull, settings, library)
    return float(by_pixel.sums[0]), pull


@cache
def pair_and_start() -> tuple[tuple[GreyImage, GreyImage], np.ndarray]:
    """Two photographs of a sheet, and its vertices with noise."""
    truth = sheet()
    rng = np.random.default_rng(0)
    pair = photograph(truth, camera_at(0.2, 0.1)), photograph(truth, camera_at(0.8, -0.1))
    return pair, truth.vertices + rng.normal(0, 0.01, truth.vertices.shape)


@pytest.mark.parametrize("vertex", [45, 75, 90, 120])
def test_the_gradient_is_that_of_finite_differences(exact: Library, vertex: int) -> None:
    pair, vertices = pair_and_start()
    _, pull = pulled(vertices, pair, EVERYTHING, exact)
    step = np.zeros_like(vertices)
    step[vertex, 2] = 1e-5
    higher, lower = (pulled(vertices + sign * step, pair, EVERYTHING, exact)[0] for sign in (1, -1))
    assert pull.gradient[vertex] == pytest.approx((higher - lower) / 2e-5, rel=1e-5)
    assert pull.curvature[vertex] > 0


def test_drawn_meshes_are_those_of_the_ray_caster(exact: Library) -> None:
    _, vertices = pair_and_start()
    camera = camera_at(0.2, 0.1)
    hits, drawn = cast_camera(vertices, sheet().faces, camera), draw_mesh(vertices, sheet().faces, camera, exact)
    np.testing.assert_array_equal(drawn.face, hits.face)
    np.testing.assert_allclose(drawn.depth, hits.depth, rtol=1e-6)


def test_single_precision_gives_the_numbers_of_double_precision(exact: Library, fast: Library) -> None:
    pair, vertices = pair_and_start()
    masked = tuple(GreyImage(item.camera, item.grey, item.grey < 0.85) for item in pair)
    settings = MatchSettings(occluded=0.1)
    expected, precise = pulled(vertices, (masked[0], masked[1]), settings, exact)
    found, pull = pulled(vertices, (masked[0], masked[1]), settings, fast)
    assert found == pytest.approx(expected, rel=1e-3)
    for here, there in ((pull.gradient, precise.gradient), (pull.curvature, precise.curvature)):
        assert np.abs(there).max() > 0
        np.testing.assert_allclose(here, there, atol=1e-4 * np.abs(there).max())


def test_occluded_and_masked_pixels_pull_nothing(fast: Library) -> None:
    pair, vertices = pair_and_start()
    for view, other in (pair, pair[::-1]):
        nothing = GreyImage(other.camera, other.grey, np.zeros(other.grey.shape, bool))
        assert not pulled(vertices, (view, nothing), EVERYTHING, fast)[1].gradient.any()
    faces, camera = sheet().faces, pair[0].camera
    drawn = draw_mesh(vertices, faces, camera, fast)
    by_pixel = Pull.zeros(drawn.depth.shape, np.float32)
    match_views(*pair, drawn.depth, 0.4 * drawn.depth, EVERYTHING, by_pixel, fast)  # something is in front
    assert not by_pixel.gradient.any()


def test_photographs_that_show_other_things_hardly_pull(fast: Library) -> None:
    pair, vertices = pair_and_start()
    rng = np.random.default_rng(1)
    noise = GreyImage(pair[1].camera, rng.random(pair[1].grey.shape))
    settings = MatchSettings(radius=3)
    pull = pulled(vertices, (pair[0], noise), settings, fast)[1]
    assert pull.curvature.sum() < 0.05 * pulled(vertices, pair, settings, fast)[1].curvature.sum()


def test_the_share_of_brightness_tells_reflections_from_texture_and_exposure(fast: Library) -> None:
    pair, vertices = pair_and_start()
    faces = sheet().faces
    depths = [draw_mesh(vertices, faces, item.camera, fast).depth for item in pair]
    exposed = GreyImage(pair[1].camera, 0.6 * pair[1].grey)
    across = np.linspace(0.0, 0.5, exposed.grey.shape[1])
    shiny = GreyImage(exposed.camera, exposed.grey + across)

    def share(*others: GreyImage) -> float:
        beside = [(other, depths[1]) for other in others]
        found, weight, compared = brightness_share(pair[0], depths[0], beside, MatchSettings(occluded=0.1), fast)
        assert ((compared > 0) <= (weight > 0)).all()
        return float(np.median(found[compared > 0]))

    assert share(exposed) < 0.05
    assert share(shiny) > 0.3
    assert share(shiny, exposed, shiny) == pytest.approx(share(shiny), rel=0.1)  # the lower median of the neighbours
    assert share(shiny, exposed) == pytest.approx(share(exposed), abs=0.02)
    assert share(exposed, shiny, exposed) < 0.05
    assert not np.any(brightness_share(pair[0], depths[0], [], MatchSettings(), fast))


def test_outlines_are_not_compared() -> None:
    depth = np.full((20, 30), 2.0)
    depth[:, 15:] = 3.0
    inner = DrawnMesh(np.zeros((20, 30), np.int32), depth).inner(focal=40.0)
    assert inner[10].tolist() == [True] * 12 + [False] * 6 + [True] * 12
    tilted = 1 / np.linspace(0.3, 0.5, 30)[None].repeat(20, axis=0)
    assert DrawnMesh(np.zeros((20, 30), np.int32), tilted).inner(focal=40.0).all()


# -- operators ---------------------------------------------------------------------------------------------------------
def ball(radius: float = 1.0) -> Mesh:
    """Return a sphere: an octahedron whose edges are halved three times."""
    corners = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]], np.int32)
    for limit in (1.0, 0.5, 0.28):
        corners, faces, _ = split_edges(corners, faces, np.full(len(corners), limit), np.zeros((len(corners), 0)))
        corners = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    return Mesh(radius * corners, faces)


def test_split_edges_keep_the_surface_closed_and_of_the_same_area() -> None:
    mesh = sheet(side=5, height=0.0)
    rng = np.random.default_rng(2)
    limit = rng.uniform(0.05, 0.6, len(mesh.vertices))
    vertices, faces, values = split_edges(mesh.vertices, mesh.faces, limit, np.stack([limit, limit], axis=1))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)[:, 2] / 2
    assert area.min() > 0
    assert area.sum() == pytest.approx(4.0)
    assert len(np.unique(components(Mesh(vertices, faces)))) == 1
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    single = vertices[unique[counts == 1], :2]  # [n, 2 ends, 2]
    assert (np.abs(single) == 1).all(axis=1).any(axis=1).all()  # on the border: no crack inside
    length = np.linalg.norm(vertices[unique[:, 0]] - vertices[unique[:, 1]], axis=1)
    assert (length <= values[unique, 0].mean(axis=1) + 1e-12).all()


def test_curvature_is_exact_on_spheres_and_planes() -> None:
    mesh = ball(radius=2.0)
    curvature = Curvature.of(mesh.vertices, mesh.faces, mesh.vertices / 2.0)
    np.testing.assert_allclose(curvature.values, -0.5, rtol=1e-9)
    assert curvature.areas.sum() == pytest.approx(4 * np.pi * 4, rel=0.05)
    flat = sheet(height=0.0)
    up = np.tile([0.0, 0, 1], (len(flat.vertices), 1))
    plane = Curvature.of(flat.vertices, flat.faces, up)
    assert np.abs(plane.values).max() == 0
    bump = 1e-5 * np.sin(3 * flat.vertices[:, 0])
    bent = Curvature.of(flat.vertices + bump[:, None] * up, flat.faces, up)
    assert np.abs(bent.values).max() > 1e-5
    np.testing.assert_allclose(plane.change @ bump, bent.values, atol=1e-9)


def test_smoothed_curvature_keeps_bends_and_leaves_noise_out() -> None:
    mesh = ball()
    rng = np.random.default_rng(3)
    rough = mesh.vertices * (1 + rng.normal(0, 2e-3, (len(mesh.vertices), 1)))
    curvature = Curvature.of(rough, mesh.faces, mesh.vertices)
    kept = curvature.smooth(3)
    assert kept.mean() == pytest.approx(-1.0, rel=0.02)
    assert (kept + 1).std() < 0.3 * (curvature.values + 1).std()


def test_the_solver_solves() -> None:
    mesh = ball()
    curvature = Curvature.of(mesh.vertices, mesh.faces, mesh.vertices)
    matrix = csr_array(curvature.graph + 0.1 * eye_array(len(mesh.vertices)))
    expected = np.sin(5 * mesh.vertices[:, 0])
    found = solve(matrix, matrix @ expected, steps=400, tolerance=1e-9)
    np.testing.assert_allclose(found, expected, atol=1e-6)


# -- refinement --------------------------------------------------------------------------------------------------------
CAMERAS = [camera_at(x, y, size=96) for x, y in ((-0.6, -0.5), (0.6, -0.5), (0.6, 0.5), (-0.6, 0.5), (0.0, 0.0))]
QUICK = RefineSettings(factors=(1,), first_steps=8, face_pixels=1.0, split_pixels=40.0)


@cache
def photographs_of(textured: bool) -> tuple[GreyImage, ...]:
    truth = sheet(side=60)
    taken = [photograph(truth, camera) for camera in CAMERAS]
    return tuple(item if textured else GreyImage(item.camera, np.full_like(item.grey, 0.5)) for item in taken)


def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(0.1 * np.sin(3 * x) * np.cos(2 * y))


def rough_sheet() -> Mesh:
    mesh = sheet(side=24)
    rng = np.random.default_rng(4)
    noise = rng.normal(0, 0.02, len(mesh.vertices)) + 0.02 * np.cos(4 * mesh.vertices[:, 0])
    colors = rng.integers(0, 255, (len(mesh.vertices), 3)).astype(np.uint8)
    return Mesh(mesh.vertices + noise[:, None] * [0, 0, 1], mesh.faces, colors)


def error(mesh: Mesh) -> float:
    """Return the mean height above the true sheet, away from its border."""
    x, y, z = mesh.vertices.T
    inner = np.maximum(np.abs(x), np.abs(y)) < 0.8
    return float(np.abs(z - heights(x, y))[inner].mean())


def refined(mesh: Mesh, library: Library, *, textured: bool = True) -> Mesh:
    images = photographs_of(textured)
    return Refinement(mesh, CAMERAS, lambda index, _factor: images[index], QUICK, library).run(lambda _done: None)


def test_refinement_moves_a_rough_sheet_to_the_surface(fast: Library) -> None:
    mesh = rough_sheet()
    before = mesh.vertices.copy()
    result = refined(mesh, fast)
    assert error(result) < 0.4 * error(mesh)
    assert (mesh.vertices == before).all()
    assert result.colors is not None
    assert len(result.colors) == len(result.vertices)


def test_without_texture_noise_is_smoothed_and_the_surface_stays(fast: Library) -> None:
    mesh = rough_sheet()
    result = refined(mesh, fast, textured=False)
    assert error(result) < error(mesh)
    moved = result.vertices[:, 2] - mesh.vertices[:, 2]
    assert np.abs(moved).mean() < 0.03
    assert abs(moved.mean()) < 0.002


def test_photographs_do_not_move_surface_whose_brightness_depends_on_the_view(fast: Library) -> None:
    truth, taken = sheet(side=60), list[GreyImage]()
    for number, item in enumerate(photographs_of(True)):
        x = points_of(item.camera, draw_mesh(truth.vertices, truth.faces, item.camera, fast))[..., 0]
        taken.append(GreyImage(item.camera, item.grey + 0.4 * np.sin(2 * number + 2 * x)))
    mesh, bare = rough_sheet(), refined(rough_sheet(), fast, textured=False)
    result = Refinement(mesh, CAMERAS, lambda index, _factor: taken[index], QUICK, fast).run(lambda _done: None)
    # Smoothed as surface without texture is, and not moved further (a matt one: 0.4).
    assert error(result) > 0.6 * error(mesh)
    assert error(result) == pytest.approx(error(bare), rel=0.1)


def test_parts_as_thin_as_their_outlines_keep_their_shape(fast: Library) -> None:
    mesh = rough_sheet()
    rod = Mesh(mesh.vertices * [1.0, 0.03, 1.0], mesh.faces)
    images, settings = photographs_of(True), replace(QUICK, face_pixels=1e-3)
    result = Refinement(rod, CAMERAS, lambda index, _factor: images[index], settings, fast).run(lambda _done: None)
    np.testing.assert_allclose(result.vertices[: len(rod.vertices)], rod.vertices, atol=1e-12)


def test_the_result_does_not_depend_on_the_number_of_threads(fast: Library) -> None:
    found = []
    for threads in (1, 3):
        fast.use_threads(threads)
        found.append(refined(rough_sheet(), fast).vertices.tobytes())
    assert found[0] == found[1]


def test_work_is_counted_to_its_end(fast: Library) -> None:
    images, heard = photographs_of(True), list[int]()
    settings = RefineSettings(factors=(2, 1), first_steps=1, steps=1)

    def read(index: int, factor: int) -> GreyImage:
        item = images[index]
        return GreyImage(item.camera.downscaled(factor), item.grey[::factor, ::factor])

    refinement = Refinement(rough_sheet(), CAMERAS, read, settings, fast)
    refinement.run(heard.append)
    assert heard == [*range(1, 11), 14, 18, 22, 26, 30]
    assert refinement.work == 30


def test_photographs_are_halved_down_to_a_shorter_side() -> None:
    assert coarse_to_fine([camera_at(0, 0, size=400)], 350) == (1,)
    assert coarse_to_fine([camera_at(0, 0, size=size) for size in (300, 1600, 1600)], 350) == (4, 2, 1)
    assert coarse_to_fine([], 350) == (1,)


def test_neighbours_see_the_same_surface_at_good_angles(fast: Library) -> None:
    behind = look_at(np.array([0, 0, -2.2]), np.zeros(3), np.array([0, 1.0, 0]), width=96, height=96, fx=86.0)
    settings = RefineSettings(neighbours=3)
    chosen = choose_neighbours(sheet(), [*CAMERAS, CAMERAS[0], behind], settings, fast)
    assert [len(item) for item in chosen[:5]] == [3] * 5
    assert chosen[6] == ()  # it sees the back
    assert 5 not in chosen[0]  # no baseline
    assert not any(6 in item for item in chosen)


def test_a_mesh_that_no_photograph_sees_stays_as_it_is(fast: Library) -> None:
    mesh = rough_sheet()
    away = Mesh(mesh.vertices + np.array([0, 0, 50.0]), mesh.faces, mesh.colors)
    assert refined(away, fast) is away
