"""Fusion on a GPU equals the field of the CPU: it uses no fused or approximate operations."""

from __future__ import annotations

import numpy as np
import pytest

from depth_waves import waves
from gs2d.meshing.fusion_bounds import derive_limits, sample_depths
from gs2d.render.backends import Backend
from surface_shapes import fuse

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("colored", [True, False])
def test_the_field_is_that_of_the_cpu_in_every_bit(gpu: Backend, colored: bool) -> None:
    views = waves(12, colored=colored)
    limits = derive_limits([sample_depths(view) for view in views], [view.camera for view in views], voxel=0.03)
    found, expected = (fuse(views, limits, backend=name) for name in (gpu.name, "cpu"))
    assert (expected.weight > 0).any()
    for name in ("keys", "tsdf", "weight", "color", "color_weight"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
