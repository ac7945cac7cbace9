"""The native kernels against the reference: hundreds of random scenes, every image, every gradient.

The kernels compute in float32, the reference judges in float64 on the same (float32) inputs. Decisions at thresholds
may flip for a pair in 1e5 or so; so images are compared by quantiles and a count of outliers, and gradients by relative
Frobenius norm on scenes in which every decision keeps a margin.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import render_oracle
import torch
from render_scenes import IMAGES, KINDS, contraction, random_camera, random_cotangents, random_splats, requiring_grad
from torch import Tensor

from gs2d.camera import Camera
from gs2d.render import reference, reference_errors
from gs2d.render.backend import Backend
from gs2d.render.types import RasterSettings
from gs2d.splats import ATTRIBUTES, Splats

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))
SCENES = 300


def scenes(count: int, kinds: tuple[str, ...] = KINDS) -> Iterator[tuple[int, Splats, Camera]]:
    """Seed, float32 splats, camera. Every third seed has large splats and many layers."""
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = random_camera(rng)
        splats = random_splats(rng, camera, int(rng.integers(1, 60)), kinds)
        splats = replace(splats, log_scales=splats.log_scales + 0.7 * (seed % 3))
        yield seed, splats.to(dtype=torch.float32), camera


def double(splats: Splats) -> Splats:
    return splats.to(dtype=torch.float64)


def quantile(values: Tensor, q: float) -> float:
    """Without torch's limit on the size."""
    return float(np.quantile(values.numpy(), q))


def test_images_agree_on_hundreds_of_random_scenes(cpu: Backend) -> None:
    differences: dict[str, list[Tensor]] = {name: [] for name in IMAGES}
    for _, splats, camera in scenes(SCENES):
        low = cpu.rasterize(splats, camera, SETTINGS)
        high = reference.rasterize(double(splats), camera, SETTINGS)
        for name in IMAGES:
            a, b = getattr(low, name).double(), getattr(high, name)
            assert a.shape == b.shape
            assert bool(a.isfinite().all()), name
            if name.startswith("depth"):
                a, b = a / b.clamp(min=0.1), b / b.clamp(min=0.1)
            differences[name].append((a - b).abs().flatten())
    for name, parts in differences.items():
        merged = torch.cat(parts)
        flips = float((merged > 2 / 255).double().mean())
        assert quantile(merged, 0.5) < 1e-6, name
        assert quantile(merged, 0.999) < 1e-4, name
        assert flips < 2e-4, (name, flips)


def test_radii_agree(cpu: Backend) -> None:
    total = wrong = 0
    for _, splats, camera in scenes(SCENES):
        low = cpu.rasterize(splats, camera, SETTINGS).radii.double()
        high = reference.rasterize(double(splats), camera, SETTINGS).radii
        total += len(splats)
        wrong += int(((low - high).abs() > 1e-3 * (1 + high)).sum())
    assert total > 5000
    assert wrong <= 2e-3 * total, (wrong, total)


@pytest.mark.parametrize("columns", [2, 4])
def test_gradients_agree_where_every_decision_has_a_margin(cpu: Backend, columns: int) -> None:
    """Random cotangents on all images at once; relative Frobenius norm per attribute."""
    errors: dict[str, list[float]] = {name: [] for name in (*ATTRIBUTES, "signed", "absolute")}
    compared = 0
    for seed, splats, camera in scenes(SCENES, tuple(kind for kind in KINDS if kind != "twins")):
        if seed % 2 == columns // 4:
            continue
        camera = camera.resized(min(camera.width, 8), min(camera.height, 8))
        splats = splats.rows(torch.arange(min(len(splats), 12)))
        if render_oracle.render(splats, camera, SETTINGS).margin < 1e-4:
            continue
        compared += 1
        cotangents = random_cotangents(np.random.default_rng(seed), camera)
        low = gradients(cpu, splats, camera, cotangents, columns)
        high = gradients(None, double(splats), camera, cotangents, columns)
        for name, expected in high.items():
            norm = float(expected.norm())
            if norm > 1e-3:
                errors[name].append(float((low[name].double() - expected).norm()) / norm)
    assert compared >= 40
    for name, values in errors.items():
        if values:
            assert np.median(values) < 1e-5, (name, np.median(values))
            assert np.quantile(values, 0.9) < 1e-4, (name, np.quantile(values, 0.9))
            assert max(values) < 2e-3, (name, max(values))


def test_gradients_of_each_image_alone_agree(cpu: Backend) -> None:
    """So that a wrong sign in a small channel is not drowned by a large one."""
    for name in IMAGES:
        errors = []
        for seed, splats, camera in scenes(40, ("plain", "tiny", "edge_on", "crossing")):
            camera = camera.resized(min(camera.width, 8), min(camera.height, 8))
            splats = splats.rows(torch.arange(min(len(splats), 12)))
            if render_oracle.render(splats, camera, SETTINGS).margin < 1e-4:
                continue
            cotangents = {name: random_cotangents(np.random.default_rng(seed), camera)[name]}
            low = gradients(cpu, splats, camera, cotangents, 4)
            high = gradients(None, double(splats), camera, cotangents, 4)
            a = torch.cat([low[attribute].double().flatten() for attribute in ATTRIBUTES])
            b = torch.cat([high[attribute].flatten() for attribute in ATTRIBUTES])
            if float(b.norm()) > 1e-3:
                errors.append(float((a - b).norm() / b.norm()))
        assert len(errors) >= 8, name
        assert np.median(errors) < 2e-5, (name, errors)
        assert max(errors) < 2e-3, (name, errors)


def gradients(
    backend: Backend | None, splats: Splats, camera: Camera, cotangents: dict[str, Tensor], columns: int
) -> dict[str, Tensor]:
    """Vector-Jacobian products of all parameters and the probe; None is the reference."""
    scene = requiring_grad(splats)
    probe = torch.zeros(len(splats), columns, dtype=splats.dtype, requires_grad=True)
    run = reference.rasterize if backend is None else backend.rasterize
    contraction(run(scene, camera, SETTINGS, probe), cotangents).backward()
    grads = {name: tensor.grad for name, tensor in scene.items()}
    assert probe.grad is not None
    grads["signed"] = probe.grad[:, :2]
    if columns == 4:
        grads["absolute"] = probe.grad[:, 2:]
    assert all(grad is not None and bool(grad.isfinite().all()) for grad in grads.values())
    return {name: grad for name, grad in grads.items() if grad is not None}


def test_gradients_are_finite_on_every_scene(cpu: Backend) -> None:
    for seed, splats, camera in scenes(100):
        gradients(cpu, splats, camera, random_cotangents(np.random.default_rng(seed), camera), 4)


@pytest.mark.parametrize("occlusion", [False, True])
def test_splat_errors_agree(cpu: Backend, occlusion: bool) -> None:
    relative = []
    for seed, splats, camera in scenes(150):
        rng = np.random.default_rng(seed)
        image = torch.tensor(rng.uniform(size=(camera.height, camera.width, 3)), dtype=torch.float32)
        mask = torch.tensor(rng.uniform(size=(camera.height, camera.width)) < 0.8) if seed % 2 else None
        low = cpu.splat_errors(splats, camera, image, SETTINGS, mask, occlusion).double()
        high = reference_errors.splat_errors(double(splats), camera, image.double(), SETTINGS, mask, occlusion)
        assert low.shape == high.shape
        relative.append((low - high).abs() / high.clamp(min=1))
    merged = torch.cat(relative)
    assert quantile(merged, 0.5) < 1e-6
    assert quantile(merged, 0.97) < 1e-4
    assert float((merged > 0.05).double().mean()) < 0.01  # one flipped pixel of a few


def test_unused_degrees_and_missing_coefficients_agree(cpu: Backend) -> None:
    for seed, splats, camera in scenes(20, ("plain",)):
        for held, degree in ((15, 0), (15, 2), (3, 1), (0, 0)):
            part = replace(splats, shN=splats.shN[:, :held].contiguous())
            settings = replace(SETTINGS, sh_degree=degree)
            low = cpu.rasterize(part, camera, settings).color.double()
            high = reference.rasterize(double(part), camera, settings).color
            assert quantile((low - high).abs(), 0.99) < 1e-4, (seed, held, degree)
