"""The native rasterizer for cameras with rays compared with the reference, and its culling. Rules: tests/render."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels.library import Library
from gs2d.render.api import rasterize, splat_errors, splat_sums
from gs2d.render.backends import Backend
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.types import RasterSettings
from ray_cameras import ray_camera, splats_around
from render_scenes import IMAGES, requiring_grad

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.7), with_transmittance_depth=True)
KINDS = ("pinhole", "fisheye", "panorama")


def everything(
    splats: Splats, camera: Camera, backend: Backend | str, settings: RasterSettings = SETTINGS
) -> dict[str, Tensor]:
    """Return all images, radii, gradients, splat errors and sums of pixels of one view, by name."""
    leaves = requiring_grad(splats)
    probe = torch.zeros(len(splats), 4, dtype=splats.dtype, requires_grad=True)
    output = rasterize(leaves, camera, settings, backend=backend, screen_probe=probe)
    names, generator = (*IMAGES, "depth_transmittance"), torch.Generator().manual_seed(3)
    images = {name: getattr(output, name) for name in names}
    given = [torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image) for image in images.values()]
    torch.autograd.backward(list(images.values()), given)
    found = {name: image.detach() for name, image in images.items()} | {"radii": output.radii, "d_probe": probe.grad}
    found |= {f"d_{name}": leaf.grad for name, leaf in leaves.items()}
    target = torch.rand(camera.height, camera.width, 8, generator=generator, dtype=torch.float64).to(splats.dtype)
    for occlusion in (False, True):
        own = splat_errors(splats, camera, target[..., :3].contiguous(), settings, backend=backend, occlusion=occlusion)
        found[f"errors_{occlusion}"] = own
    found["sums"], _ = splat_sums(splats, camera, target, settings, backend=backend)
    return {name: tensor for name, tensor in found.items() if tensor is not None}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mip_px", [0.0, 0.5])
def test_the_float64_build_equals_the_reference_to_rounding(native64: Library, kind: str, mip_px: float) -> None:
    splats, camera = splats_around(0), ray_camera(kind)
    settings = replace(SETTINGS, mip_px=mip_px)
    expected, found = (everything(splats, camera, backend, settings) for backend in ("reference", CpuBackend(native64)))
    assert expected.keys() == found.keys()
    assert expected["alpha"].mean() > 0.05
    for name, tensor in expected.items():
        # The search for the depth by transmittance ends at a tolerance.
        error = (found[name] - tensor).abs().max() / tensor.abs().max()
        assert error < (1e-7 if name.startswith("d_") else 1e-11), (name, error)


@pytest.mark.parametrize("kind", KINDS)
def test_culling_does_not_change_a_single_bit(any_native: Library, kind: str) -> None:
    """The reference, with which the float64 build agrees, evaluates every splat in every pixel."""
    splats, camera = splats_around(1).to(dtype=any_native.dtype), ray_camera(kind, any_native.dtype)
    culled, whole = (everything(splats, camera, CpuBackend(any_native, exact_masks=exact)) for exact in (True, False))
    assert all(torch.equal(culled[name], whole[name]) for name in culled)


@pytest.mark.parametrize("kind", KINDS)
def test_every_instruction_set_agrees_with_float64_on_any_number_of_threads(
    native: Library, native64: Library, kind: str
) -> None:
    splats, camera = splats_around(2), ray_camera(kind)
    exact = everything(splats, camera, CpuBackend(native64))
    results = []
    for threads in (1, 3):
        native.use_threads(threads)
        results.append(everything(splats.to(dtype=torch.float32), ray_camera(kind, torch.float32), CpuBackend(native)))
    native.use_threads(2)
    for name, tensor in results[0].items():
        assert torch.equal(tensor, results[1][name]), name
        error = (tensor - exact[name]).abs()
        assert error.mean() / exact[name].abs().mean() < 1e-3, (name, error)
