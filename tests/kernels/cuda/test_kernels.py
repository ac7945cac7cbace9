"""CUDA kernels, emulated on the CPU: list chunks, thread order, rejected input.

Images and gradients against the reference: tests/render/test_parity.py.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from emulate import Emulator
from gs2d.core.splats import Splats
from gs2d.errors import ShapeError
from gs2d.render.api import rasterize
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.reference_backend import PLAIN
from kernel_cases import SETTINGS, double, gradients, many_tiles, render
from render_scenes import IMAGES, front_camera, random_cotangents, splat, stack


def layers(count: int) -> Splats:
    """Return faint splats behind each other, all visible in every pixel of a small image."""
    parts = [splat((0.0, 0.0, 2.0 + 0.01 * i), (3.0, 3.0), 0.02, (i % 3 / 2, 0.5, 0.2)) for i in range(count)]
    return stack(*parts)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 65])
def test_lists_around_the_chunk_size_agree(emulator: Emulator, count: int) -> None:
    camera = front_camera(5, 3)
    scene = layers(count)
    low = render(emulator, scene, camera, SETTINGS)
    high = rasterize(double(scene), camera, SETTINGS, backend="reference")
    assert float((low.color.double() - high.color).abs().max()) < 1e-5
    cotangents = random_cotangents(np.random.default_rng(count), camera)
    low_grads = gradients(partial(render, emulator), scene, camera, cotangents, 2)
    high_grads = gradients(PLAIN.rasterize, double(scene), camera, cotangents, 2)
    for name in ("means", "opacity_logits", "sh0"):
        error = (low_grads[name].double() - high_grads[name]).norm() / high_grads[name].norm()
        assert float(error) < 1e-4, name


def test_a_pixel_that_stops_on_the_last_bit_of_a_chunk_stays_stopped(emulator: Emulator) -> None:
    """Entry 31 stops every pixel; 32 opaque splats behind it must change nothing, forward or backward."""
    front = stack(*(splat((0.0, 0.0, 2.0 + 0.01 * i), (3.0, 3.0), 0.25) for i in range(31)))
    behind = stack(*(splat((0.0, 0.0, 3.0 + 0.01 * i), (3.0, 3.0), 0.98, (0.0, 1.0, 0.0)) for i in range(33)))
    camera = front_camera(5, 3)
    settings = replace(SETTINGS, transmittance_min=1e-4)
    before = render(emulator, front, camera, settings)
    assert float(1 - before.alpha.max()) > 1e-4
    scene = stack(front, behind)
    after = render(emulator, scene, camera, settings)
    assert torch.equal(before.color, after.color)
    grads = gradients(partial(render, emulator), scene, camera, random_cotangents(np.random.default_rng(0), camera), 2)
    assert float(grads["sh0"][:31].abs().max()) > 0
    assert float(grads["sh0"][31:].abs().max()) == 0
    assert float(grads["opacity_logits"][31:].abs().max()) == 0


def test_the_order_of_threads_warps_and_blocks_does_not_change_images(emulator: Emulator) -> None:
    """A missing barrier would change them."""
    case = many_tiles()
    usual = render(emulator, case.splats, case.camera, SETTINGS)
    cotangents = random_cotangents(np.random.default_rng(1), case.camera)
    a = gradients(partial(render, emulator), case.splats, case.camera, cotangents, 4)
    for other in (replace(emulator, descending=True), replace(emulator, seed=1)):
        images = render(other, case.splats, case.camera, SETTINGS)
        for name in (*IMAGES, "radii"):
            assert torch.equal(getattr(usual, name), getattr(images, name)), name
        b = gradients(partial(render, other), case.splats, case.camera, cotangents, 4)
        for name in a:  # gradient sums depend on the thread order
            assert float((a[name] - b[name]).norm()) <= 1e-5 * float(a[name].norm()), name


def test_arguments_that_would_read_beyond_an_array_are_refused(emulator: Emulator) -> None:
    camera, scene = front_camera(), splat()
    with pytest.raises(ShapeError, match="sh_degree"):
        CudaBackend(launcher=emulator).rasterize(scene, camera, SETTINGS)  # degree 3, but only the first coefficient
    with pytest.raises(ShapeError, match="float32"):
        CudaBackend(launcher=emulator).rasterize(double(scene), camera, replace(SETTINGS, sh_degree=0))
