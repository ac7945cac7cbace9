"""Fusion on a GPU, executed on the CPU by the emulator, against numpy."""

from __future__ import annotations

from dataclasses import replace

import emulate
import numpy as np
import pytest
import torch

from gs2d.camera import look_at
from gs2d.mesh.frames import DepthMap, Frame, depth_map
from gs2d.mesh.fuse import touched_blocks
from gs2d.mesh.integrate import add_in_numpy, add_on_gpu
from gs2d.mesh.limits import derive_limits, sample_depths
from gs2d.mesh.sampling import prepare
from gs2d.mesh.volume import Volume, block_grid, unknown_volume

pytestmark = pytest.mark.timeout(120)


def waves(count: int, *, colored: bool) -> list[DepthMap]:
    """A wavy wall with holes from several places: weights in every other view, no colours in the third."""
    rng = np.random.default_rng(0)
    found = []
    for k in range(count):
        eye = np.array([0.3 * k - 0.4, -2.0, 0.1 * k])
        camera = look_at(eye, np.zeros(3), np.array([0.0, 0.1, 1.0]), width=20, height=16, fx=24.0)
        depth = 2.0 + 0.1 * np.sin(np.arange(20.0)) + 0.02 * rng.standard_normal((16, 20))
        valid = rng.random((16, 20)) > 0.1
        color = rng.random((16, 20, 3)) if colored and k != 2 else None
        found.append(depth_map(Frame(camera, depth, color, valid * rng.random((16, 20)) if k % 2 else valid)))
    return found


@pytest.mark.parametrize("colored", [True, False])
def test_the_kernel_leaves_the_field_of_numpy_in_every_bit(emulator: emulate.Emulator, colored: bool) -> None:
    views = waves(4, colored=colored)
    limits = derive_limits([sample_depths(view) for view in views], [view.camera for view in views], voxel=0.08)
    limits = replace(limits, truncation=0.3)
    dims = block_grid(limits)
    keys = np.unique(np.concatenate([touched_blocks(view, limits, dims) for view in views]))
    assert 4 < len(keys) < 500

    def empty() -> Volume:
        return unknown_volume(limits, dims, keys, colored=colored, frames=4)

    found, expected = empty(), empty()
    with add_on_gpu([found], emulator, torch.device("cpu")) as add, add_in_numpy([expected], 1) as add_too:
        for view in views:
            add(prepare(view, limits))
            add_too(prepare(view, limits))
    assert (expected.weight > 0).mean() > 0.1
    for name in ("tsdf", "weight", "color", "color_weight"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
