"""Unbounded scenes: one closed mesh across levels of voxels, with far ground and no shell around the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cascade_scenes import BALL, GROUND, cascade_of, fused_levels, mesh_of, outdoor_frames, volumes_of
from gs2d.contrib.surfaces.unbounded import extract_unbounded, find_cascade_blocks
from gs2d.core.camera import look_at
from gs2d.errors import ProtocolError
from gs2d.meshing.depth_maps import RenderedView, depth_map
from gs2d.meshing.extract import Extraction, ExtractOptions
from gs2d.meshing.marching_cubes import components
from gs2d.meshing.tsdf_volume import block_bytes
from surface_shapes import edge_uses, is_closed_manifold, rays, signed_volume


# -- joins -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("center", "radius"),
    [((0.3, 0.1, 0.2), 1.3), ((2.0, 1.0, 0.0), 3.1), ((0.0, 0.0, 0.0), 2.3), ((0.5, 0.5, 0.5), 2.2)],
)
def test_a_sphere_across_levels_is_one_closed_accurate_surface(
    center: tuple[float, float, float], radius: float
) -> None:
    """The second sphere crosses all three joins.

    Linear interpolation errs by at most h^2 / (8 R): 0.02 voxel of 1/16 at R = 1. Cells at a join reach three voxels of
    the finer level, so the tolerance is four times as large there.
    """
    cascade = cascade_of(4)
    volumes = volumes_of(cascade, lambda p: np.linalg.norm(p - np.asarray(center), axis=1) - radius)
    mesh = mesh_of(volumes, cascade)
    assert is_closed_manifold(mesh)
    assert components(mesh).max() == 0
    assert signed_volume(mesh) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    error = np.abs(np.linalg.norm(mesh.vertices - np.asarray(center), axis=1) - radius)
    level = np.minimum(cascade.level_of(mesh.vertices.astype(np.float64)), 3)
    assert len(np.unique(level)) > 1
    assert (error < 0.03 * cascade.levels[0].voxel * 2.0**level).all()


def test_random_fields_give_a_closed_surface_across_levels() -> None:
    """Random values at every voxel, positive at the border of the outermost level: all 256 cases, on all joins."""
    cascade = cascade_of(3)
    rng = np.random.default_rng(3)
    volumes = volumes_of(cascade, lambda p: np.where(np.abs(p).max(axis=1) > 3.6, 1.0, rng.normal(size=len(p))))
    mesh = mesh_of(volumes, cascade)
    _, uses, upward = edge_uses(mesh)
    assert len(mesh.faces) > 50_000
    assert (uses % 2 == 0).all()  # no border
    assert (2 * upward == uses).all()  # both directions equally often
    assert (uses == 2).mean() > 0.999


# -- shapes at several distances ---------------------------------------------------------------------------------------
def test_near_and_far_spheres_are_accurate_to_a_fraction_of_a_voxel() -> None:
    """Spheres of radius R = 1.5, 5 and 20 around a ring of cameras, so that the distance equals the radius."""
    cameras = [
        look_at(0.3 * np.array([np.cos(a), np.sin(a), 0.0]), np.array([np.cos(a), np.sin(a), z]) * 10,
                np.array([0, 0, 1.0]), width=64, height=64, fx=28.0)
        for z in (-1.0, 0.0, 1.0) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]  # fmt: skip
    for radius in (1.5, 5.0, 20.0):
        cascade = cascade_of(6)
        maps = []
        for camera in cameras:
            origin, step = rays(camera)  # inside the sphere: |o + s d| = R, the farther root
            a, b, c = (step**2).sum(-1), step @ origin, origin @ origin - radius**2
            maps.append(depth_map(RenderedView(camera, (-b + np.sqrt(b * b - a * c)) / a)))
        mesh = fused_levels(maps, cascade)
        distance = np.linalg.norm(mesh.vertices, axis=1)
        voxel = cascade.levels[0].voxel * 2.0 ** cascade.level_of(mesh.vertices.astype(np.float64))
        assert len(mesh.faces) > 500
        assert (np.abs(distance - radius) < 0.5 * voxel).all()
        assert np.mean(np.abs(distance - radius) / voxel) < 0.12


def test_a_plane_through_all_levels_has_one_layer_without_holes() -> None:
    """Ground at z = -0.3 under a camera that looks along it: only its border is open; every column is crossed once."""
    cascade = cascade_of(5)
    eyes = [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    maps = []
    for x, y in eyes:
        camera = look_at(
            np.array([x, y, 12.0]), np.array([x, y, 0.0]), np.array([0, 1.0, 0]), width=256, height=256, fx=110
        )
        maps.append(depth_map(RenderedView(camera, np.full((256, 256), 12.3))))
    mesh = fused_levels(maps, cascade)
    assert np.abs(mesh.vertices[:, 2] + 0.3).max() < 0.02 * cascade.levels[0].voxel
    edges, uses, _ = edge_uses(mesh)
    assert uses.max() == 2
    rim = mesh.vertices[edges[uses == 1]].reshape(-1, 3)
    assert np.abs(rim[:, :2]).max(axis=1).min() > 12.0  # no open edge at the joins at 1, 2, 4 and 8
    t = mesh.vertices[mesh.faces].astype(np.float64)
    area = 0.5 * np.abs(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])[:, 2]).sum()
    x, y = np.abs(rim[:, 0]).max(), np.abs(rim[:, 1]).max()
    assert area == pytest.approx(4 * x * y, rel=0.05)  # once, not twice


# -- the sky -----------------------------------------------------------------------------------------------------------
def outdoors(sky: str, seed: int = 0) -> Extraction:
    return extract_unbounded(outdoor_frames(sky, seed=seed), ExtractOptions(resolution=64), threads=1)


@pytest.mark.parametrize("sky", ["unseen", "thin", "scattered", "cards"])
def test_sky_creates_no_shell_and_the_ground_extends_far(sky: str) -> None:
    result = outdoors(sky)
    v = result.mesh.vertices.astype(np.float64)
    assert result.levels >= 6
    assert not (v[:, 2] > BALL + 0.2).any()
    ground = v[np.abs(v[:, 2] - GROUND) < 0.3]
    assert np.linalg.norm(ground[:, :2], axis=1).max() > 15  # five times the distance of the cameras
    away = np.minimum(np.abs(np.linalg.norm(v, axis=1) - BALL), np.abs(v[:, 2] - GROUND))
    distance = np.abs(v).max(axis=1)
    assert (away < 0.6 * result.limits.voxel * np.maximum(1, 2 * distance / (result.limits.side / 2))).all()
    assert result.mesh.colors is not None
    assert (result.mesh.colors == 128).all()


def test_memory_of_all_levels_is_bounded_and_the_error_suggests_a_voxel() -> None:
    frames = outdoor_frames("unseen", views=8, size=48)
    result = extract_unbounded(frames, ExtractOptions(voxel=0.03), threads=1)
    assert result.volume_bytes % block_bytes(colored=True) == 0
    bound = result.volume_bytes // 2
    with pytest.raises(ProtocolError, match="use a voxel of about") as caught:
        extract_unbounded(frames, ExtractOptions(voxel=0.03, max_bytes=bound), threads=1)
    named = float(str(caught.value).split("use a voxel of about ")[1].split(" ")[0])
    assert extract_unbounded(frames, ExtractOptions(voxel=named, max_bytes=bound), threads=1).volume_bytes <= bound


@pytest.mark.parametrize("colored", [True, False])
@pytest.mark.parametrize(("levels", "slab_bytes"), [(4, 1), (4, 300_000), (9, 300_000)])
def test_the_mesh_of_all_levels_does_not_depend_on_slabs(levels: int, slab_bytes: int, colored: bool) -> None:
    maps = [depth_map(f) for f in outdoor_frames("unseen", views=6, size=48)]
    maps = maps if colored else [replace(item, color=None) for item in maps]
    cascade = cascade_of(levels, depth_limit=6.0)  # some of the nine levels have no blocks
    whole = fused_levels(maps, cascade)
    blocks = find_cascade_blocks(maps, cascade)
    assert sum(part.nbytes for part in blocks) > 2 * slab_bytes  # several slabs
    parts = fused_levels(maps, cascade, slab_bytes=slab_bytes)
    assert len(whole.faces) > 1000
    np.testing.assert_array_equal(parts.vertices, whole.vertices)
    np.testing.assert_array_equal(parts.faces, whole.faces)
    assert (parts.colors is not None) == colored
    if colored:
        np.testing.assert_array_equal(parts.colors, whole.colors)
