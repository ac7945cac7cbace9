"""Marching cubes gives closed, oriented surfaces without seams, and only in observed space."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.core.mesh import Mesh
from gs2d.meshing.marching_cubes import components, keep_components
from gs2d.meshing.tsdf_volume import BLOCK, Volume
from surface_shapes import area, dense, edge_uses, is_closed_manifold, limits, marching_cubes, signed_volume, volume_of


def sphere(radius: float) -> object:
    return lambda p: np.linalg.norm(p, axis=1) - radius


def smooth_noise(seed: int, n: int) -> object:
    """Return random waves, positive at the border of the cube of side 2, so that every surface is closed."""
    rng = np.random.default_rng(seed)
    k, phase = rng.normal(size=(n, 3)) * 4, rng.uniform(0, 2 * np.pi, n)

    def field(p: np.ndarray) -> np.ndarray:
        return np.cos(p @ k.T + phase).sum(1) / np.sqrt(n) + np.maximum(0, 20 * (np.abs(p).max(1) - 0.7))

    return field


def white_noise(seed: int) -> object:
    """Return independent signs at every voxel, positive at the border: all 256 cases and all ambiguous faces."""

    def field(p: np.ndarray) -> np.ndarray:
        values = np.random.default_rng(seed).normal(size=len(p))
        return np.where(np.abs(p).max(1) > 0.85, 1.0, values)

    return field


def test_a_sphere_has_its_radius_and_is_closed_and_faces_outward() -> None:
    lim = limits(1.0, 2 / 40)
    mesh = marching_cubes(volume_of(sphere(0.7), lim, 5))
    assert is_closed_manifold(mesh)
    assert signed_volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=5e-3)
    # the chord of a linear zero crossing: error below h^2 / (8 r) = 0.05^2 / 5.6
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.7).max() < 0.05**2 / 5.6 * 1.01
    assert components(mesh).max() == 0


@pytest.mark.parametrize("seed", range(4))
def test_random_smooth_fields_give_the_surface_of_scikit_image(seed: int) -> None:
    measure = pytest.importorskip("skimage.measure")
    lim = limits(1.0, 2 / 40)
    volume = volume_of(smooth_noise(seed, 24), lim, 5)
    mesh = marching_cubes(volume)
    vertices, faces, _, _ = measure.marching_cubes(dense(volume), 0.0, spacing=(lim.voxel,) * 3)
    oracle = Mesh(vertices - 1.0, faces)
    assert is_closed_manifold(mesh)
    assert len(mesh.vertices) == pytest.approx(len(vertices), rel=2e-3)  # Lewiner adds a vertex in some ambiguous cells
    assert area(mesh) == pytest.approx(area(oracle), rel=2e-3)
    assert signed_volume(mesh) == pytest.approx(signed_volume(oracle), rel=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_with_every_ambiguous_case_is_closed(seed: int) -> None:
    mesh = marching_cubes(volume_of(white_noise(seed), limits(1.0, 2 / 32), 4))
    _, uses, upward = edge_uses(mesh)
    assert (uses == 2).all()
    assert (upward == 1).all()


def test_zeros_on_voxels_create_no_holes_or_degenerate_triangles() -> None:
    mesh = marching_cubes(volume_of(lambda p: np.rint((np.abs(p).max(1) - 0.5) * 8) / 8, limits(1.0, 2 / 16), 2))
    assert is_closed_manifold(mesh)
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    assert np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).min() > 0


def test_blocks_in_any_partition_give_the_same_surface() -> None:
    """A plane through 4^3 blocks: no edge inside the box has fewer than two faces."""
    lim = limits(1.0, 2 / 32)
    mesh = marching_cubes(volume_of(lambda p: p @ np.array([0.3, 0.5, 0.81]) - 0.111, lim, 4))
    edges, uses, _ = edge_uses(mesh)
    ends = mesh.vertices[edges[uses == 1]]  # [E, 2, 3]
    inner = (np.abs(ends) < 1 - 1.01 * lim.voxel).all(axis=(1, 2)) & (ends < 1 - 1.6 * lim.voxel).all(axis=(1, 2))
    assert not inner.any()
    assert components(mesh).max() == 0


def test_unknown_voxels_create_no_surface() -> None:
    lim = limits(1.0, 2 / 32)
    valid = volume_of(sphere(0.7), lim, 4)
    weight = valid.weight.copy()
    weight[valid.blocks[:, 0] >= 2] = 0.5  # half of space is below the minimum weight
    half = Volume(lim, valid.dims, valid.keys, valid.tsdf, weight, None, None)
    mesh = marching_cubes(half, min_weight=1.0)
    boundary = lim.lower[0] + 2 * BLOCK * lim.voxel
    assert len(mesh.faces) > 100
    assert mesh.vertices[:, 0].max() < boundary
    assert marching_cubes(half, min_weight=0.5).vertices[:, 0].max() == pytest.approx(0.7, abs=0.01)
    nothing = Volume(lim, valid.dims, valid.keys, valid.tsdf, np.zeros_like(weight), None, None)
    assert len(marching_cubes(nothing, min_weight=0.0).faces) == 0


def test_missing_blocks_are_unknown_space() -> None:
    lim = limits(1.0, 2 / 32)
    full = volume_of(sphere(0.7), lim, 4)
    rows = np.flatnonzero(full.blocks[:, 2] != 1)
    part = Volume(lim, full.dims, full.keys[rows], full.tsdf[rows], full.weight[rows], None, None)
    mesh = marching_cubes(part)
    low, high = lim.lower[2] + BLOCK * lim.voxel, lim.lower[2] + 2 * BLOCK * lim.voxel
    z = mesh.vertices[:, 2]
    assert not ((z > low + 1e-6) & (z < high - 1e-6)).any()
    assert (z > high).any()
    assert (z < low).any()


def test_vertex_colours_are_interpolated_without_uncoloured_ends() -> None:
    lim = limits(1.0, 2 / 16)
    plain = volume_of(lambda p: p[:, 2] - 0.05, lim, 2)
    color = np.full((*plain.tsdf.shape, 3), 90.0, np.float32)
    color[plain.tsdf < 0] = [10.0, 20.0, 30.0]
    weights = np.ones_like(plain.tsdf)
    # voxels lie at -1 + k/8: the plane z = 0.05 is 0.4 of the way from voxel 8 (below) to voxel 9 (above)
    mixed = marching_cubes(Volume(lim, plain.dims, plain.keys, plain.tsdf, plain.weight, color, weights))
    assert mixed.colors is not None
    assert (mixed.colors == [42, 48, 54]).all()  # 0.6 * 10 + 0.4 * 90 = 42
    weights[plain.tsdf > 0] = 0
    below = marching_cubes(Volume(lim, plain.dims, plain.keys, plain.tsdf, plain.weight, color, weights))
    assert below.colors is not None
    assert (below.colors == [10, 20, 30]).all()


def strips() -> Mesh:
    """Return three pieces of 2, 1 and 2 faces, an unused vertex, and colours that encode the vertex index."""
    faces = np.array([[0, 1, 2], [5, 6, 7], [1, 3, 2], [8, 9, 10], [9, 11, 10]], np.int32)
    vertices = np.arange(36, dtype=np.float32).reshape(12, 3)
    return Mesh(vertices, faces, np.repeat(np.arange(12, dtype=np.uint8)[:, None], 3, axis=1))


def test_small_components_and_unused_vertices_are_removed() -> None:
    kept = keep_components(strips(), min_faces=2)
    assert kept.colors is not None
    assert kept.colors[:, 0].tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert kept.faces.tolist() == [[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]]
    largest = keep_components(strips(), min_faces=1, keep=1)
    assert largest.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert len(keep_components(strips(), min_faces=3).vertices) == 0
    assert len(keep_components(keep_components(strips(), min_faces=3), min_faces=1).faces) == 0
