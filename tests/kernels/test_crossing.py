"""Splats whose disc reaches the camera plane have no ellipse: culling by tiles and blocks changes no bit.

With ``exact_masks=False``, such a splat enters every tile and is evaluated at every pixel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels.library import Library
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, random_camera, random_splats, requiring_grad

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.7))
KINDS = ("crossing", "crossing", "near_plane", "huge", "edge_on", "plain")


def crossing_scene(seed: int, count: int = 60) -> tuple[Splats, Camera]:
    """Return a scene of many tiles, most splats crossing the camera plane; some are slivers, some 1000 times larger."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng).resized(int(rng.integers(40, 130)), int(rng.integers(40, 100)))
    splats = random_splats(rng, camera, count, KINDS)
    stretch = rng.choice([0.0, 0.0, 0.0, -9.0, 3.0, 7.0], size=(count, 2))
    aside = rng.normal(size=(count, 3)) * rng.choice([0.0, 0.5, 3.0], size=(count, 1))
    splats = replace(
        splats, log_scales=splats.log_scales + torch.tensor(stretch), means=splats.means + torch.tensor(aside)
    )
    return splats, camera


def everything(
    library: Library, splats: Splats, camera: Camera, settings: RasterSettings, *, exact: bool
) -> dict[str, Tensor]:
    """Return images, radii, gradients and splat errors of one view, by name."""
    leaves = requiring_grad(splats.to(dtype=library.dtype))
    probe = torch.zeros(len(splats), 4, dtype=library.dtype, requires_grad=True)
    backend = CpuBackend(library, exact_masks=exact)
    output = backend.rasterize(leaves, camera, settings, probe)
    generator = torch.Generator().manual_seed(1)
    images = [getattr(output, name) for name in IMAGES]
    torch.autograd.backward(images, [torch.randn(i.shape, generator=generator, dtype=i.dtype) for i in images])
    found = {name: getattr(output, name).detach() for name in (*IMAGES, "radii")}
    found |= {f"d_{name}": tensor.grad for name, tensor in (*leaves.items(), ("probe", probe))}  # type: ignore[misc]
    photo = torch.rand(camera.height, camera.width, 3, generator=generator, dtype=library.dtype)
    for occlusion in (False, True):
        found[f"errors_{occlusion}"] = backend.splat_errors(leaves.detach(), camera, photo, settings, None, occlusion)
    return found


@pytest.mark.parametrize("change", [{}, {"near": 0.02, "error_cutoff": 5.0}, {"near_plane_policy": "box"}], ids=str)
def test_culling_splats_without_an_ellipse_changes_no_bit(any_native: Library, change: dict[str, float]) -> None:
    settings = replace(SETTINGS, **change)  # type: ignore[arg-type]
    seen = 0
    for seed in range(8):
        splats, camera = crossing_scene(seed)
        culled, full = (everything(any_native, splats, camera, settings, exact=exact) for exact in (True, False))
        for name, tensor in full.items():
            assert torch.equal(culled[name], tensor), (seed, name)
        seen += int((full["d_sh0"][full["radii"] == max(camera.width, camera.height) / 2] != 0).any(2).sum())
    assert seen > 15  # of the crossing splats


# --------------------------------------------------------------------------------------------- outlines against pixels


def outlines(rng: np.random.Generator, lanes: int, kind: str) -> np.ndarray:
    """Return random inputs of outline_of [11, lanes]: au, bu, av, bv, ai, bi, iz, cx, cy, k, disc2."""
    coefficients = rng.normal(size=(6, lanes)) * 10 ** rng.uniform(-3, 0, size=(6, lanes))
    iz, k = 10 ** rng.uniform(-1.5, 0.5, lanes), rng.uniform(0.01, 4, lanes)
    center = rng.uniform(-30, 90, size=(2, lanes))
    if kind == "far":  # centre far outside the image: large terms cancel in a visible pixel
        center *= 10 ** rng.uniform(1, 4, size=(2, lanes))
        dx, dy = rng.uniform(0, [[64], [48]], size=(2, lanes)) - center
        inverse, part = rng.uniform(0.1, 6, lanes), 0.6 * k * rng.normal(size=(2, lanes))
        wanted = (*(part * inverse), inverse - iz)  # X, Y and I - iz at that pixel
        for row, value in zip((0, 2, 4), wanted, strict=True):
            coefficients[row + 1] = (value - coefficients[row] * dx) / dy
    if kind == "extreme":
        coefficients *= 10.0 ** rng.integers(-30, 31, size=(6, lanes))
    if kind == "not finite":
        coefficients[rng.integers(0, 6, lanes), np.arange(lanes)] = rng.choice([np.nan, np.inf, -np.inf], lanes)
    if kind == "along the axes":
        coefficients[rng.integers(0, 6, lanes), np.arange(lanes)] = 0
        coefficients[rng.integers(0, 6, lanes), np.arange(lanes)] = 0
    return np.stack([*coefficients, iz, *center, k, 0.5 * k**2])
