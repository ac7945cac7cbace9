"""CPU kernels against the reference on random scenes: images, radii, errors and gradients.

A few scenes run in every test run, two thousand in `make test-all`. The comparison follows ``test_parity``: the
reference uses float64 on the same float32 inputs, decisions may flip for about one pair in 1e5, and gradients are
compared only away from thresholds.

Every second scene has values at the limits of float32. The kernels compute what lies behind a splat as the pixel minus
what lies in front, which cannot resolve a small gradient next to one of 1e14; tolerances are therefore relative to the
largest gradient. ``KNOWN`` lists the one plain scene in a thousand with a larger gradient error
(docs/notebook/reliability.md).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import render_oracle
from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, contraction, random_camera, random_cotangents, random_splats, requiring_grad

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))
GRADIENT_ERROR = 5e-3  # relative
OF_LARGEST = 1e-5  # with extreme values: relative to the attribute's largest gradient
KNOWN = {708}  # a disc 0.04 degrees from edge-on: inverting its frame loses digits; error 1.1 %


def has_edges(seed: int) -> bool:
    return seed % 2 == 1


def random_scene(seed: int) -> tuple[Splats, Camera]:
    """Return a random scene; in every second, some splats have values of any magnitude in float32."""
    rng = np.random.default_rng(10_000 + seed)
    camera = random_camera(rng)
    camera = camera.resized(min(camera.width, 20), min(camera.height, 20))
    splats = random_splats(rng, camera, int(rng.integers(1, 30))).to(dtype=torch.float32)
    if has_edges(seed):
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh0"):
            values = getattr(splats, name).numpy()
            chosen = rng.uniform(size=values.shape) < 0.05
            with np.errstate(over="ignore", under="ignore"):
                edges = (rng.choice([-1.0, 1.0], values.shape) * 2.0 ** rng.uniform(-149, 128, values.shape)).astype(
                    np.float32
                )
            values[chosen] = np.clip(edges, -3.4e38, 3.4e38)[chosen]
    return splats, camera


def gradients(native: Backend | None, splats: Splats, camera: Camera, seed: int) -> dict[str, Tensor]:
    scene = requiring_grad(splats)
    run = PLAIN.rasterize if native is None else native.rasterize
    cotangents = random_cotangents(np.random.default_rng(seed), camera)
    contraction(run(scene, camera, SETTINGS), cotangents).backward()
    return {name: getattr(scene, name).grad for name in ATTRIBUTES}


def compare(native: Backend, seeds: range) -> None:
    different, pixels, wrong_radii, count, compared = 0, 0, 0, 0, 0
    errors: list[float] = []
    beyond: list[tuple[int, str, float, float]] = []
    for seed in seeds:
        splats, camera = random_scene(seed)
        double = splats.to(dtype=torch.float64)
        low, high = native.rasterize(splats, camera, SETTINGS), PLAIN.rasterize(double, camera, SETTINGS)
        for name in IMAGES:
            a, b = getattr(low, name).double(), getattr(high, name)
            assert bool(a.isfinite().all()), (seed, name)
            off = (a - b).abs() / b.abs().clamp(min=1)
            different += int((off > 2 / 255).sum())
            pixels += off.numel()
        wrong_radii += int(((low.radii.double() - high.radii).abs() > 1e-3 * (1 + high.radii)).sum())
        count += len(splats)
        got = gradients(native, splats, camera, seed)
        assert all(bool(grad.isfinite().all()) for grad in got.values()), seed
        small = camera.resized(min(camera.width, 8), min(camera.height, 8))
        few = splats.rows(torch.arange(min(len(splats), 12)))
        with np.errstate(all="ignore"):
            margin = render_oracle.render(few, small, SETTINGS).margin
        if margin >= 1e-4:
            compared += 1
            ours, theirs = (
                gradients(backend, scene, small, seed)
                for backend, scene in ((native, few), (None, few.to(dtype=torch.float64)))
            )
            largest = max(float(expected.norm()) for expected in theirs.values())
            for name, expected in theirs.items():
                size, error = float(expected.norm()), float((ours[name].double() - expected).norm())
                if size > 1e-3:
                    errors.append(error / size)
                    if error > GRADIENT_ERROR * size + (OF_LARGEST * largest if has_edges(seed) else 0.0):
                        beyond.append((seed, name, error / size, margin))
    assert different / pixels < 4e-4, (different, pixels)
    assert wrong_radii <= max(1, 3e-3 * count), (wrong_radii, count)
    print(f"gradients of {compared} of {len(seeds)} scenes: median {np.median(errors):.1e}, most {max(errors):.1e}")
    assert compared >= len(seeds) // 4, compared
    assert np.median(errors) < 1e-5
    assert {seed for seed, *_ in beyond} == KNOWN & set(seeds), beyond


def test_random_scenes_agree_with_the_reference(native: Backend) -> None:
    compare(native, range(40))


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("block", range(4))
def test_two_thousand_random_scenes_agree_with_the_reference(native: Backend, block: int) -> None:
    compare(native, range(500 * block, 500 * (block + 1)))
