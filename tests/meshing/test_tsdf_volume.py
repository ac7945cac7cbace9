"""Fusion reproduces known shapes: closed, in one layer, at the right position, in bounded memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.errors import ProtocolError
from gs2d.meshing.depth_maps import DepthMap, RenderedView, Spool, depth_map
from gs2d.meshing.extract import ExtractOptions, extract
from gs2d.meshing.fusion_bounds import derive_limits, sample_depths
from gs2d.meshing.marching_cubes import components
from gs2d.meshing.tsdf_volume import FULL_WEIGHT_BEHIND, block_bytes
from surface_shapes import (
    box_depth,
    edge_uses,
    fuse,
    is_closed_manifold,
    limits,
    marching_cubes,
    orbit,
    rays,
    signed_volume,
    sphere_depth,
    sphere_frames,
)

LIMITS = limits(1.3, 0.03)


def maps(frames: list[RenderedView]) -> list[DepthMap]:
    return [depth_map(frame) for frame in frames]


def test_a_sphere_seen_from_all_round_is_closed_and_has_its_radius() -> None:
    mesh = marching_cubes(fuse(maps(sphere_frames(orbit(30, 3.0))), LIMITS))
    assert is_closed_manifold(mesh)
    assert components(mesh).max() == 0
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(np.sqrt((radius**2).mean()) - 1) < 0.1 * LIMITS.voxel
    assert np.abs(radius - 1).max() < 0.6 * LIMITS.voxel
    assert signed_volume(mesh) > 0


def test_an_oblique_plane_is_flat_to_a_small_part_of_a_voxel() -> None:
    """Plane z = 4 + 0.8 x before the camera at the origin: depth 4 / (1 - 0.8 x') at the pixel ray (x', y', 1).

    Nearest-pixel depth would be wrong by up to half a pixel of 0.02 world units times 0.8: 0.4 voxel along z.
    """
    camera = Camera(160, 120, 200.0, 200.0, 80.0, 60.0, np.eye(4))
    slope = (np.arange(160) + 0.5 - 80) / 200
    depth = np.broadcast_to(4 / (1 - 0.8 * slope), (120, 160))
    lim = replace(limits(1.0, 0.02), lower=(-1.0, -0.8, 3.2), upper=(0.8, 0.8, 4.8))
    mesh = marching_cubes(fuse([depth_map(RenderedView(camera, depth))], lim))
    error = (mesh.vertices[:, 2] - 4 - 0.8 * mesh.vertices[:, 0]) / np.hypot(1, 0.8)
    assert np.abs(error).max() < 0.02 * lim.voxel


def test_no_depth_is_invented_across_a_depth_edge() -> None:
    """Two walls at 2 and 3 meet at the middle column: no vertex lies between them.

    Observed space behind the near wall ends at this column; its side face is only as deep as the full weight.
    """
    camera = Camera(64, 64, 80.0, 80.0, 32.0, 32.0, np.eye(4))
    depth = np.where(np.arange(64) < 32, 2.0, 3.0) * np.ones((64, 1))
    lim = replace(limits(1.0, 0.02), lower=(-1.0, -0.5, 1.5), upper=(1.0, 0.5, 3.5))
    mesh = marching_cubes(fuse([depth_map(RenderedView(camera, depth))], lim))
    z = mesh.vertices[:, 2]
    near = z < 2 + FULL_WEIGHT_BEHIND * lim.truncation + lim.voxel
    assert (np.abs(z[near & (np.abs(mesh.vertices[:, 0]) > 0.05)] - 2) < 0.01).all()
    assert (np.abs(z[~near] - 3) < 0.01).all()
    assert (z < 2.5).any()
    assert (z > 2.5).any()


def test_unobserved_space_creates_no_shell() -> None:
    """One camera sees half a sphere: the mesh is one open sheet, with nothing behind it or around the image border."""
    camera = look_at(np.array([0, -3.0, 0]), np.zeros(3), np.array([0, 0, 1.0]), width=160, height=160, fx=200)
    depth = sphere_depth(camera, 1.0)
    mesh = marching_cubes(fuse([depth_map(RenderedView(camera, depth))], limits(1.3, 0.02)))
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.02
    assert mesh.vertices[:, 1].max() < -1 / 3 + 0.05  # the silhouette seen from distance 3 is at y = -1/3
    _, uses, _ = edge_uses(mesh)
    assert uses.max() == 2
    assert (uses == 1).any()


@pytest.mark.parametrize("thickness_voxels", [3.0, 6.0])
def test_a_thin_plate_seen_from_both_sides_has_two_faces_and_no_other_layer(thickness_voxels: float) -> None:
    voxel = 0.02
    half = 0.5 * thickness_voxels * voxel
    low, high = np.array([-0.6, -0.6, -half]), np.array([0.6, 0.6, half])
    cameras = orbit(36, 3.0, size=160, focal=220.0)
    frames = [RenderedView(camera, box_depth(camera, low, high)) for camera in cameras]
    mesh = marching_cubes(fuse(maps(frames), limits(0.8, voxel)))
    inner = np.abs(mesh.vertices[:, :2]).max(1) < 0.5
    height = np.abs(mesh.vertices[inner, 2])
    assert np.abs(height - half).max() < 0.75 * voxel  # every vertex is on one of the two faces
    centers = mesh.vertices[mesh.faces].mean(1)
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    normals = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    flat = np.abs(centers[:, :2]).max(1) < 0.5
    assert (normals[flat, 2] * centers[flat, 2] > 0).all()  # both face outward
    area = 0.5 * np.abs(normals[flat, 2]).sum()
    assert area == pytest.approx(2.0, rel=0.05)  # two sheets of 1.0 x 1.0, once each


def test_invalid_pixels_are_ignored() -> None:
    camera = orbit(1, 3.0)[0]
    depth = sphere_depth(camera, 1.0)
    valid = np.zeros(depth.shape, bool)
    with pytest.raises(ProtocolError, match="no depth"):
        fuse([depth_map(RenderedView(camera, depth, valid=valid))], LIMITS)
    valid[:, :48] = True
    left = depth_map(RenderedView(camera, np.where(depth > 0, depth, np.nan), valid=valid))
    assert (left.depth[:, 48:] == 0).all()
    assert np.isfinite(left.depth).all()
    mesh = marching_cubes(fuse([left], LIMITS))
    x, _ = camera.project(mesh.vertices)
    assert x[:, 0].max() < 48.5


def test_pixel_weights_are_used() -> None:
    """Two views from the same position, of walls at 2.00 and 2.04, weighted 3 to 1: the wall is at 2.01."""
    camera = Camera(64, 64, 80.0, 80.0, 32.0, 32.0, np.eye(4))
    one = np.ones((64, 64))
    frames = [RenderedView(camera, 2.00 * one, valid=3 * one), RenderedView(camera, 2.04 * one, valid=1 * one)]
    lim = replace(limits(1.0, 0.02), lower=(-0.5, -0.5, 1.5), upper=(0.5, 0.5, 2.5), truncation=0.2)
    mesh = marching_cubes(fuse(maps(frames), lim))
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.01, atol=1e-4)


def test_free_space_clears_a_phantom_that_other_views_look_through() -> None:
    cameras = orbit(60, 3.0, size=64, focal=80.0)
    frames = sphere_frames(cameras, 0.9)
    phantom = np.asarray(frames[0].depth).copy()
    phantom[28:36, 28:36] = 1.95  # 0.15 in front of the surface
    for position in (0, 30):  # at any position in the order
        order = [*frames[1 : 1 + position], RenderedView(cameras[0], phantom), *frames[1 + position :]]
        mesh = marching_cubes(fuse(maps(order), LIMITS))
        assert np.linalg.norm(mesh.vertices, axis=1).max() < 0.92


def test_colours_come_from_the_views_that_see_the_surface() -> None:
    cameras = orbit(30, 3.0)
    frames = []
    for camera in cameras:
        depth = sphere_depth(camera, 1.0)
        o, d = rays(camera)
        point = o + depth[..., None] * d
        color = np.where(point[..., 2:] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])  # red above, blue below
        frames.append(RenderedView(camera, depth, color, depth > 0))
    mesh = marching_cubes(fuse(maps(frames), LIMITS))
    assert mesh.colors is not None
    top, bottom = mesh.vertices[:, 2] > 0.1, mesh.vertices[:, 2] < -0.1
    assert mesh.colors[top, 0].min() > 230
    assert mesh.colors[top, 2].max() < 25
    assert mesh.colors[bottom, 2].min() > 230


def test_the_result_does_not_depend_on_threads() -> None:
    frames = maps(sphere_frames(orbit(6, 3.0)))
    one, three = fuse(frames, LIMITS), fuse(frames, LIMITS, threads=3)
    np.testing.assert_array_equal(one.tsdf, three.tsdf)
    np.testing.assert_array_equal(one.weight, three.weight)


def test_memory_is_bounded_and_the_error_names_a_voxel_that_fits() -> None:
    frames = maps(sphere_frames(orbit(10, 3.0)))
    lim = limits(1.3, 0.01)
    max_bytes = 1500 * block_bytes(False)
    with pytest.raises(ProtocolError, match="use a voxel of about") as error:
        fuse(frames, lim, max_bytes=max_bytes)
    assert "\n" not in str(error.value)
    voxel = float(str(error.value).split("voxel of about ")[1].split(" ")[0])
    volume = fuse(frames, limits(1.3, voxel), max_bytes=max_bytes)
    assert 0.3 * max_bytes < len(volume.keys) * block_bytes(colored=False) <= max_bytes


def test_a_spool_can_be_read_repeatedly() -> None:
    camera = orbit(1, 3.0)[0]
    depth = sphere_depth(camera, 1.0)
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (96, 96, 3), dtype=np.uint8)
    frames = [
        RenderedView(camera, depth),
        RenderedView(camera, depth, color),
        RenderedView(camera, depth, color, rng.random((96, 96))),
    ]
    spool = Spool(iter(frames))
    assert len(spool) == 3
    for _ in range(2):
        for item, expected in zip(spool, maps(frames), strict=True):
            for name in ("depth", "color", "weight"):
                a, b = getattr(item, name), getattr(expected, name)
                assert (a is None and b is None) or np.array_equal(a, b), name


def test_an_orbit_at_uneven_distances_keeps_the_whole_scene() -> None:
    """One camera close to the wall, the others far: a cause of circular holes in other implementations."""
    wall = np.array([-2.0, 0.0, -2.0]), np.array([2.0, 0.2, 2.0])
    eyes = [np.array([x, -y, 0.0]) for x, y in ((0.0, 0.4), (-1.0, 4.0), (1.0, 4.0), (0.0, 5.0))]
    up = np.array([0, 0, 1.0])
    cameras = [look_at(e, np.array([e[0], 0, 0]), up, width=128, height=128, fx=110) for e in eyes]
    frames = [RenderedView(c, box_depth(c, *wall)) for c in cameras]
    derived = derive_limits([sample_depths(depth_map(f)) for f in frames], cameras, resolution=100)
    assert derived.depth_limit > 5
    mesh = extract(frames, ExtractOptions(resolution=100), threads=1).mesh
    front = np.abs(mesh.vertices[:, 1]) < 0.05
    assert mesh.vertices[front].min(0)[0] < -1.9
    assert mesh.vertices[front].max(0)[0] > 1.9
