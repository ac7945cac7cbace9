"""Fusion bounds follow the observations of all views; disagreement between views widens the truncation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.errors import ProtocolError
from gs2d.meshing.consistency import depth_noise
from gs2d.meshing.depth_maps import DepthMap, RenderedView, depth_map
from gs2d.meshing.extract import ExtractOptions, extract
from gs2d.meshing.fusion_bounds import (
    DepthSample,
    FusionBounds,
    backproject,
    derive_limits,
    sample_depths,
    widen_truncation,
)
from surface_shapes import box_depth, orbit, sphere_depth

UP = np.array([0, 0, 1.0])


def sample(points: np.ndarray, depths: np.ndarray, footprint: float = 1e-4) -> DepthSample:
    return DepthSample(points, depths, np.full(len(depths), footprint), np.zeros(3))


def line(count: int, low: float, high: float) -> np.ndarray:
    """Return points on the x axis; y and z stay within 0.1."""
    t = np.linspace(0, 1, count)
    return np.stack([low + (high - low) * t, 0.1 * np.cos(9 * t), 0.1 * np.sin(9 * t)], axis=1)


CAMERA = look_at(np.array([0, -5.0, 0]), np.zeros(3), UP, width=64, height=64, fx=64)


def limits_of(maps: list[DepthMap], **options: float) -> FusionBounds:
    return derive_limits([sample_depths(m) for m in maps], [m.camera for m in maps], **options)  # type: ignore[arg-type]


def test_backprojected_pixels_project_back() -> None:
    camera = Camera(80, 60, 70.0, 75.0, 33.0, 28.0, CAMERA.T_cam_world)
    rows, columns = np.array([0, 10, 59]), np.array([0, 70, 79])
    pixels, z = camera.project(backproject(camera, np.array([1.0, 2.0, 3.0]), rows, columns))
    np.testing.assert_allclose(pixels, np.stack([columns + 0.5, rows + 0.5], axis=1))
    np.testing.assert_allclose(z, [1, 2, 3])


def test_the_voxel_is_the_percentile_box_divided_by_the_resolution() -> None:
    """For 1000 points from 0 to 100, the 1st to 99th percentile span 98."""
    lim = derive_limits([sample(line(1000, 0, 100), np.full(1000, 5.0))], [CAMERA], resolution=98)
    assert lim.voxel == pytest.approx(1.0)
    assert lim.truncation == pytest.approx(5.0)
    assert lim.lower[0] == pytest.approx(1 - 0.25 * 98)
    assert lim.upper[0] == pytest.approx(99 + 0.25 * 98)
    assert lim.cut_fraction == 0


def test_the_voxel_is_not_finer_than_half_a_pixel() -> None:
    lim = derive_limits([sample(line(1000, 0, 100), np.full(1000, 5.0), footprint=3.0)], [CAMERA], resolution=98)
    assert lim.voxel == pytest.approx(1.5)
    assert derive_limits([sample(line(10, 0, 1), np.ones(10), 3.0)], [CAMERA], voxel=0.1).voxel == 0.1


def test_a_far_background_is_left_out_and_reported() -> None:
    """A fifth of the pixels show mountains at 200 times the depth of the rest: box and voxel follow the rest."""
    near, far = sample(line(800, 0, 1), np.full(800, 5.0)), sample(line(200, -900, 900), np.full(200, 1000.0))
    lim = derive_limits([near, far], [CAMERA], resolution=98)
    assert lim.depth_limit == 20.0  # 4 times the median
    assert lim.voxel == pytest.approx(0.01)
    assert lim.cut_fraction == pytest.approx(0.2)


def test_a_single_near_camera_does_not_set_the_depth_limit() -> None:
    far, near = sample(line(900, 0, 1), np.linspace(4, 6, 900)), sample(line(100, 0, 1), np.full(100, 0.3))
    lim = derive_limits([far, near], [CAMERA])
    assert lim.depth_limit > 6


def test_a_bbox_is_fused_whole() -> None:
    box = np.array([[-1.0, -1, -1], [1, 3, 1]])
    lim = derive_limits([sample(line(100, 0, 1), np.full(100, 1.0))], [CAMERA], bbox=box, resolution=100)
    assert (lim.lower, lim.upper) == ((-1, -1, -1), (1, 3, 1))
    assert lim.voxel == pytest.approx(0.04)
    assert lim.depth_limit == pytest.approx(8.0)  # the camera at y = -5 looks along y: the far face is at depth 8


@pytest.mark.parametrize(
    "options",
    [
        {"voxel": 0.0},
        {"voxel": -1.0},
        {"truncation": float("nan")},
        {"depth_limit": 0.0},
        {"resolution": 0},
        {"bbox": np.zeros((2, 3))},
        {"bbox": np.zeros((3, 2))},
        {"bbox": np.array([[-1, -9, -1], [1, -8, 1]])},  # behind the camera
        {"depth_limit": 0.5},  # in front of everything
    ],
)
def test_invalid_limits_are_one_line_errors(options: dict) -> None:
    with pytest.raises(ProtocolError) as error:
        derive_limits([sample(line(100, 0, 1), np.ones(100))], [CAMERA], **options)
    assert "\n" not in str(error.value)


# noise


def orbit_maps(error: float, seed: int = 0) -> list[DepthMap]:
    """Return depth maps of a unit sphere from all around, each with smooth waves of standard deviation ``error``."""
    rng = np.random.default_rng(seed)
    maps = []
    for camera in orbit(24, 3.0, size=96, focal=120.0):
        v, u = np.mgrid[0:96, 0:96]
        k, phase = rng.normal(0, 0.15, (12, 2)), rng.uniform(0, 2 * np.pi, 12)
        waves = np.cos(u[..., None] * k[:, 0] + v[..., None] * k[:, 1] + phase).sum(-1) / np.sqrt(6)
        depth = sphere_depth(camera, 1.0)
        maps.append(depth_map(RenderedView(camera, np.where(depth > 0, depth + error * waves, 0))))
    return maps


def noise_of(maps: list[DepthMap]) -> float | None:
    return depth_noise(maps, [sample_depths(m) for m in maps], limits_of(maps))


def test_disagreement_is_as_large_as_the_error() -> None:
    """The difference of two errors of sigma has standard deviation sqrt(2) sigma.

    75 % of its positive half lie below 1.15 times that, 1.63 sigma. Slanted surfaces add to it.
    """
    noise = noise_of(orbit_maps(0.02))
    assert noise is not None
    assert 1.2 * 0.02 < noise < 2.5 * 0.02


def test_occlusion_is_not_disagreement() -> None:
    """A small box in front of a wall, from several sides: some views do not see parts of the wall."""
    eyes = [np.array([x, -4.0, z]) for x in (-1, 0, 1) for z in (0, 1)]
    cameras = [look_at(eye, np.zeros(3), UP, width=96, height=96, fx=80) for eye in eyes]
    maps = []
    for camera in cameras:
        small = box_depth(camera, np.array([-0.4, -1.5, -0.4]), np.array([0.4, -1.0, 0.4]))
        wall = box_depth(camera, np.array([-3, 0.0, -3]), np.array([3, 0.5, 3]))
        maps.append(depth_map(RenderedView(camera, np.where(small > 0, small, wall))))
    noise = noise_of(maps)
    assert noise is not None
    assert noise < 0.01


def test_the_truncation_follows_the_noise_within_bounds() -> None:
    lim = replace(limits_of(orbit_maps(0.0)), voxel=0.01, truncation=0.05, side=10.0)
    assert widen_truncation(lim, 0.001).truncation == 0.05
    assert widen_truncation(lim, 0.006).truncation == pytest.approx(0.12)
    assert widen_truncation(lim, 0.05).truncation == pytest.approx(0.20)
    assert widen_truncation(replace(lim, side=3.6), 0.05).truncation == pytest.approx(0.09)
    assert widen_truncation(replace(lim, side=1.0), 0.05).truncation == 0.05
    assert widen_truncation(lim, 0.006).depth_noise == 0.006


def test_noisy_maps_are_fused_better_with_a_wider_truncation() -> None:
    frames = [RenderedView(m.camera, m.depth) for m in orbit_maps(0.02)]
    wide = extract(frames, ExtractOptions(voxel=0.007), threads=1)
    narrow = extract(frames, ExtractOptions(voxel=0.007, truncation=0.035), threads=1)
    assert wide.limits.truncation == pytest.approx(0.025 * wide.limits.side)  # 0.049

    def error(mesh_vertices: np.ndarray) -> float:
        return float(np.abs(np.linalg.norm(mesh_vertices, axis=1) - 1).mean())

    assert error(wide.mesh.vertices) < 0.8 * error(narrow.mesh.vertices)
