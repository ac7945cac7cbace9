"""Integration of views: by hand, on every instruction set, and errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gs2d.core.camera import Camera
from gs2d.errors import BackendError
from gs2d.kernels.library import available_variants
from gs2d.meshing.depth_maps import DepthMap, RenderedView, depth_map
from gs2d.meshing.sampling import make_sampler
from gs2d.meshing.tsdf_volume import (
    Volume,
    block_grid,
    fusion_backend,
    integrator,
    invalid_volume,
)
from surface_shapes import fuse, limits, orbit, sphere_depth

ARRAYS = ("keys", "tsdf", "weight", "color", "color_weight")
LIMITS = limits(1.3, 0.05)
VARIANTS = [*available_variants()] or [pytest.param("none", marks=pytest.mark.skip("the native library is not built"))]


def views(count: int = 6) -> list[DepthMap]:
    """Return a sphere with noise and holes, cut by the image borders; some of the views have weights and colours."""
    rng = np.random.default_rng(3)
    found = []
    for k, camera in enumerate(orbit(count, 2.2, size=64, focal=80.0)):
        depth = sphere_depth(camera, 1.0) + 0.01 * rng.standard_normal((64, 64))
        valid = rng.random((64, 64)) > 0.05
        weights = valid * rng.random((64, 64)) if k % 2 else valid
        color = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) if k % 3 else None
        found.append(depth_map(RenderedView(camera, depth, color, weights)))
    return found


def assert_same(found: Volume, expected: Volume) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert (expected.weight > 0).any()


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_field_depends_neither_on_threads_nor_on_the_instruction_set(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = views()
    expected = fuse(frames, LIMITS)
    assert expected.color_weight is not None
    assert (expected.color_weight > 0).any()
    monkeypatch.setenv("GS2D_CPU_VARIANT", variant)
    assert_same(fuse(frames, LIMITS, threads=3), expected)


def wall(depth: float) -> tuple[Volume, DepthMap, Camera]:
    """Return one block of 8^3 voxels of 0.25 from (-1, -1, 1) on, and a view from the origin of a wall."""
    camera = Camera(64, 64, 16.0, 16.0, 32.0, 32.0, np.eye(4))
    lim = replace(LIMITS, lower=(-1.0, -1.0, 1.0), upper=(0.5, 0.5, 2.5), voxel=0.25, truncation=1.0, depth_limit=9.0)
    color = np.full((64, 64, 3), 200, np.uint8)
    volume = invalid_volume(lim, block_grid(lim), np.zeros(1, np.int64), colored=True)
    return volume, depth_map(RenderedView(camera, np.full((64, 64), depth), color)), camera


def test_a_voxel_changes_as_computed_by_hand() -> None:
    """Voxels at z = 1, 1.25, ... 2.75, a truncation of 1, walls at 1.5 and then at 1.75.

    The first wall has distances 0.5, 0.25, 0, -0.25, -0.5, -0.75, -1, -1.25, with weight 1 down to -0.75, then 0. The
    second has 0.75, 0.5, 0.25, 0, -0.25, -0.5, -0.75, -1. The result is the mean of both; at z = 2.5 only the second
    counts. The colour of the voxel at z = 1 has the weight (1 - 0.5) + (1 - 0.75).
    """
    volume, first, camera = wall(1.5)
    second = depth_map(RenderedView(camera, np.full((64, 64), 1.75), np.full((64, 64, 3), 100, np.uint8)))
    with integrator([volume], None) as add:
        for item in (first, second):
            add(make_sampler(item, volume.limits))
    z = volume.tsdf[0].reshape(8, 8, 8)[4, 4]
    np.testing.assert_allclose(z, [0.625, 0.375, 0.125, -0.125, -0.375, -0.625, -0.75, 0.0], atol=1e-6)
    np.testing.assert_allclose(volume.weight[0].reshape(8, 8, 8)[4, 4], [2, 2, 2, 2, 2, 2, 1, 0], atol=1e-6)
    assert volume.color is not None
    assert volume.color_weight is not None
    assert volume.color_weight[0].reshape(8, 8, 8)[4, 4, 0] == pytest.approx(0.75)
    # 200 with weight 0.5, 100 with weight 0.25
    assert volume.color[0].reshape(8, 8, 8, 3)[4, 4, 0, 1] == pytest.approx(500 / 3, rel=1e-5)


@pytest.mark.parametrize("backend", ["auto", "cpu", "reference"])
def test_every_backend_without_fusion_of_its_own_uses_the_native_library(
    backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fusion_backend(backend).name == "cpu"
    monkeypatch.setattr("gs2d.kernels.library.FOLDER", tmp_path)
    with pytest.raises(BackendError, match="native CPU library"):
        fuse(views(1), LIMITS, backend=backend)


def test_an_unknown_backend_is_an_error() -> None:
    with pytest.raises(BackendError, match="reference"):
        fusion_backend("gpu")
