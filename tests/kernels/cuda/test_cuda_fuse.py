"""GPU fusion, emulated on the CPU, against the native library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import emulate
from depth_waves import waves
from gs2d.kernels.tsdf import FusionOnDevice
from gs2d.meshing.fusion_bounds import derive_limits, sample_depths
from gs2d.meshing.sampling import make_sampler
from gs2d.meshing.tsdf_volume import Volume, block_grid, integrator, invalid_volume, touched_blocks


@pytest.mark.parametrize("colored", [True, False])
def test_the_kernel_leaves_the_field_of_the_cpu_in_every_bit(emulator: emulate.Emulator, colored: bool) -> None:
    views = waves(4, colored=colored)
    limits = derive_limits([sample_depths(view) for view in views], [view.camera for view in views], voxel=0.08)
    limits = replace(limits, truncation=0.3)
    dims = block_grid(limits)
    keys = np.unique(np.concatenate([touched_blocks(view, limits, dims) for view in views]))
    assert 4 < len(keys) < 500

    def empty() -> Volume:
        return invalid_volume(limits, dims, keys, colored=colored)

    found, expected = empty(), empty()
    gpu = FusionOnDevice(emulator, torch.device("cpu"))
    with integrator([found], gpu) as add, integrator([expected], None) as add_too:
        for view in views:
            add(make_sampler(view, limits))
            add_too(make_sampler(view, limits))
    assert (expected.weight > 0).mean() > 0.1
    for name in ("tsdf", "weight", "color", "color_weight"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
