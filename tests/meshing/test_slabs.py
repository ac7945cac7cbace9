"""Slab-wise surface extraction gives a byte-identical mesh while only part of the volume is in memory."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.meshing.depth_maps import DepthMap, RenderedView, depth_map
from gs2d.meshing.fusion_bounds import derive_limits, sample_depths
from gs2d.meshing.slabs import fused_surface, slabs
from gs2d.meshing.tsdf_volume import block_bytes, find_blocks, fuse_blocks
from surface_shapes import fuse, marching_cubes, orbit, sphere_depth


def maps(*, colored: bool) -> list[DepthMap]:
    """Render a ball from all around, with colours that differ from pixel to pixel."""
    random = np.random.default_rng(0)
    found = []
    for camera in orbit(6, 4.0, size=32, focal=40.0):
        color = random.integers(0, 255, (camera.height, camera.width, 3)).astype(np.uint8) if colored else None
        found.append(depth_map(RenderedView(camera, sphere_depth(camera, 1.0), color)))
    return found


@pytest.mark.parametrize("colored", [False, True])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.6])
def test_the_mesh_does_not_depend_on_slabs(colored: bool, fraction: float) -> None:
    seen = maps(colored=colored)
    limits = derive_limits([sample_depths(item) for item in seen], [item.camera for item in seen], voxel=0.05)
    blocks = find_blocks(seen, limits)
    most = int(fraction * blocks.nbytes)
    assert len(list(slabs(blocks, most))) > 1
    whole = marching_cubes(fuse(seen, limits))
    parts = fused_surface(seen, limits, blocks, slab_bytes=most)
    assert len(whole.faces) > 1000
    np.testing.assert_array_equal(parts.vertices, whole.vertices)
    np.testing.assert_array_equal(parts.faces, whole.faces)
    assert parts.faces.dtype == whole.faces.dtype
    assert (parts.colors is None) == (whole.colors is None) == (not colored)
    if colored:
        np.testing.assert_array_equal(parts.colors, whole.colors)


def test_slabs_respect_the_memory_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = maps(colored=False)
    limits = derive_limits([sample_depths(item) for item in seen], [item.camera for item in seen], voxel=0.04)
    blocks = find_blocks(seen, limits)
    most = blocks.nbytes // 2
    held: list[int] = []

    def recorded(*arguments: object, **options: object) -> object:
        volume = fuse_blocks(*arguments, **options)  # type: ignore[arg-type]
        held.append(len(volume.keys) * block_bytes(blocks.colored))
        return volume

    monkeypatch.setattr("gs2d.meshing.slabs.fuse_blocks", recorded)
    fused_surface(seen, limits, blocks, slab_bytes=most)
    assert len(held) > 1
    assert max(held) <= most
    rows = list(slabs(blocks, block_bytes(False)))  # no layer fits: each is a slab, together with the next one
    assert [start for start, _, _ in rows[1:]] == [own for _, own, _ in rows[:-1]]
    assert (rows[0][0], rows[-1][1]) == (0, len(blocks.keys))
