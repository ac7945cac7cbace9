"""Cameras with rays, and splats around them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.rays import ray_map
from render_scenes import front_camera


def pinhole_rays(camera: Camera, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the rays [H, W, 3] of a pinhole camera; z is 1."""
    x = (torch.arange(camera.width, dtype=dtype) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=dtype) + 0.5 - camera.cy) / camera.fy
    x, y = torch.meshgrid(x, y, indexing="xy")
    return torch.stack([x, y, torch.ones_like(x)], dim=2)


def directions(kind: str, width: int, height: int) -> Tensor:
    """Return the rays of a "pinhole", of a "fisheye" of 220 degrees with dark corners, or of a "panorama"."""
    camera = front_camera(width, height, width / (2 if kind == "pinhole" else math.tau))
    rays = pinhole_rays(camera)
    x, y = rays[..., 0], rays[..., 1]
    if kind == "panorama":
        y = y * (math.pi / 2) / y.abs().max() * (1 - 1 / height)
        return torch.stack([x.sin() * y.cos(), y.sin(), x.cos() * y.cos()], dim=2)
    if kind == "fisheye":
        radius = torch.hypot(x, y)
        angle = radius / radius[height // 2].max() * math.radians(110)
        side = angle.sin() / radius
        return torch.stack([x * side, y * side, angle.cos()], dim=2) * (angle <= math.radians(110))[..., None]
    return rays


def ray_camera(kind: str, dtype: torch.dtype = torch.float64, width: int = 75, height: int = 50) -> Camera:
    """Return a camera at the origin with these rays."""
    return replace(front_camera(width, height, 40.0), rays=ray_map(directions(kind, width, height)).to(dtype))


def splats_around(seed: int, count: int = 150) -> Splats:
    """Return splats of many sizes on all sides of the origin, some of which contain it or are seen edge-on."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means, quats = normal(count, 3) * 1.5, normal(count, 4)
    quats[:5] = torch.tensor([1.0, 0, 0, 0])
    means[:5, 2] = 0  # edge-on
    scales = torch.rand(count, 2, generator=generator, dtype=torch.float64) ** 3 * 0.6 + 1e-3
    return Splats(means, quats, scales.log(), normal(count) + 0.5, normal(count, 1, 3) * 0.5, normal(count, 15, 3) / 10)
