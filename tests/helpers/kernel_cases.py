"""Scenes for the CUDA kernels, and functions that run them in the emulator and the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

import render_oracle
from emulate import Emulator
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.types import RasterSettings, RenderOutput
from render_scenes import KINDS, contraction, random_camera, random_splats, requiring_grad

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))


def render(
    launcher: Emulator,
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    probe: Tensor | None = None,
) -> RenderOutput:
    """Render through the public function."""
    return rasterize(splats, camera, settings, backend=CudaBackend(launcher=launcher), screen_probe=probe)


@dataclass(frozen=True)
class Case:
    """A random scene, float32."""

    seed: int
    splats: Splats
    camera: Camera


def cases(count: int, kinds: tuple[str, ...] = KINDS) -> Iterator[Case]:
    """Return random cases: every third seed has small splats, every third large splats in many layers."""
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = random_camera(rng)
        splats = random_splats(rng, camera, int(rng.integers(1, 60)), kinds)
        splats = replace(splats, log_scales=splats.log_scales + 0.7 * (seed % 3))
        yield Case(seed, splats.to(dtype=torch.float32), camera)


def double(splats: Splats) -> Splats:
    return splats.to(dtype=torch.float64)


def quantile(values: Tensor, q: float) -> float:
    """Compute a quantile without torch's size limit."""
    return float(np.quantile(values.numpy(), q))


def cases_with_margins(count: int = 60) -> list[Case]:
    """Return small scenes in which no decision is within 1e-4 of its threshold (depth ties excluded)."""
    clear = []
    for case in cases(count, tuple(kind for kind in KINDS if kind != "twins")):
        camera = case.camera.resized(min(case.camera.width, 8), min(case.camera.height, 8))
        splats = case.splats.rows(torch.arange(min(len(case.splats), 12)))
        if render_oracle.render(splats, camera, SETTINGS).margin >= 1e-4:
            clear.append(Case(case.seed, splats, camera))
    assert len(clear) >= count // 5
    return clear


def gradients(
    run: Callable[..., RenderOutput],
    splats: Splats,
    camera: Camera,
    cotangents: dict[str, Tensor],
    columns: int,
    settings: RasterSettings = SETTINGS,
) -> dict[str, Tensor]:
    """Return vector-Jacobian products of all parameters and the probe."""
    scene = requiring_grad(splats)
    probe = torch.zeros(len(splats), columns, dtype=splats.dtype, requires_grad=True)
    contraction(run(scene, camera, settings, probe), cotangents).backward()
    assert probe.grad is not None
    grads = {name: tensor.grad for name, tensor in scene.items()} | {"signed": probe.grad[:, :2]}
    if columns == 4:
        grads["absolute"] = probe.grad[:, 2:]
    assert all(grad is not None and bool(grad.isfinite().all()) for grad in grads.values())
    return {name: grad for name, grad in grads.items() if grad is not None}


def many_tiles() -> Case:
    rng = np.random.default_rng(5)
    camera = random_camera(rng).resized(70, 45)  # not a multiple of 16, 8 or 4
    splats = random_splats(rng, camera, 150)
    return Case(5, replace(splats, log_scales=splats.log_scales - 0.7).to(dtype=torch.float32), camera)


def crossing_tiles(seed: int) -> Case:
    """Return a scene with all kinds of splats, most of them crossing the camera plane, in many tiles."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng).resized(90, 70)
    splats = random_splats(rng, camera, 60, ("crossing", "crossing", "near_plane", "huge", "edge_on", "plain"))
    splats = replace(splats, means=splats.means + torch.tensor(rng.normal(size=(60, 3)) * rng.choice([0, 2], (60, 1))))
    return Case(seed, splats.to(dtype=torch.float32), camera)
