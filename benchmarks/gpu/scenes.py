"""Scenes of the GPU measurements: two spheres, a floor and a wall, with two distributions of scales."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from benchmarks.workload import PLACES, camera, room
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats

# The largest common scene first: it matters most, and time may run out.
SIZES = ((1_000_000, 1600, 1060), (300_000, 800, 800), (100_000, 800, 800), (3_000_000, 1600, 1060))
FIRST = ((300_000, 800, 800), (1_000_000, 1600, 1060))  # scenes of part 0: an object and a room
TOY = ((60, 32, 16),)


@dataclass(frozen=True, eq=False)
class GpuScene:
    """Splats on a device, and eight cameras, so that the cache does not hold the inputs of the next repeat."""

    name: str
    splats: Splats
    cameras: tuple[Camera, ...]


def gpu_scene(count: int, width: int, height: int, spread: str, device: torch.device) -> GpuScene:
    """Return scene A (scales spread by exp(0.4 N)) or B (elongated as if trained, scales spread by exp(0.8 N))."""
    splats = room(count)
    if spread == "B":
        generator = torch.Generator().manual_seed(1)
        size, shape = (torch.randn(count, 1, generator=generator) for _ in range(2))
        splats.log_scales += 0.69 * size + 0.5 * shape * torch.tensor([1.0, -1.0])  # 0.4^2 + 0.69^2 = 0.8^2
        splats.opacity_logits = 1.5 * torch.randn(count, generator=generator)
    near = [(x + 0.07, y - 0.05, z + 0.1) for x, y, z in PLACES]
    cameras = tuple(camera(width, height, place) for place in (*PLACES, *near))
    return GpuScene(scene_name(count, width, height, spread), splats.to(device), cameras)


def scene_name(count: int, width: int, height: int, spread: str) -> str:
    """Return the scene name, for instance ``1000000-1600x1060-A``."""
    return f"{count}-{width}x{height}-{spread}"
