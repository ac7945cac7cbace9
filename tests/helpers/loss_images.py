"""Cameras, rendered images and depths for loss tests."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera, look_at
from gs2d.losses import formulas
from gs2d.render.types import RenderOutput

CONSISTENCIES = [  # edges, weighted, per_splat, masked: each pair of values occurs at least once
    ("undefined", False, False, True),
    ("undefined", True, True, False),
    ("undefined", True, False, True),
    ("camera", False, False, False),
    ("camera", False, True, True),
]


def make_camera(width: int, height: int) -> Camera:
    """Return a camera without symmetries."""
    T = look_at(
        np.array([1.0, -2.0, 0.7]), np.zeros(3), np.array([0.1, 0.2, 1.0]), width=width, height=height, fx=1.0
    ).T_cam_world
    return Camera(width, height, 0.9 * width, 1.1 * width, 0.4 * width, 0.55 * height, T)


def wide_camera(height: int, width: int) -> Camera:
    """Return a camera without symmetries, of any size from one pixel on."""
    T = make_camera(max(width, 1), max(height, 1)).T_cam_world
    return Camera(width, height, 0.9 * width + 2, 1.1 * width + 2, 0.4 * width, 0.55 * height, T)


def photographs(
    height: int, width: int, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a noisy rendering of a smooth target with some equal pixels, the target, and a mask."""
    g = torch.Generator().manual_seed(seed)
    target = formulas.blur(torch.rand(height, width, 3, generator=g, dtype=dtype))
    rendered = (target + 0.2 * torch.randn(height, width, 3, generator=g, dtype=dtype)).clamp(0, 1)
    rendered = torch.where(torch.rand(height, width, 1, generator=g) < 0.1, target, rendered)
    return rendered, target, torch.rand(height, width, generator=g) < 0.8


def geometry(
    height: int, width: int, seed: int = 0, empty: float = 0.05, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rendered normals, depth with holes, alpha and a mask."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=dtype)

    depth = torch.where(rand(height, width) < empty, 0.0, 2 + rand(height, width))
    return rand(height, width, 3) - 0.5, depth, rand(height, width), rand(height, width) < 0.85


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Return the relative Frobenius norm of a difference."""
    return float((found.double() - expected).norm() / expected.norm().clamp(min=1e-30))


def make_output(height: int, width: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> RenderOutput:
    """Return random images like those of a rasterizer; all require gradients."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64).to(dtype)

    return RenderOutput(
        color=rand(height, width, 3).requires_grad_(),
        alpha=rand(height, width).requires_grad_(),
        normal=(rand(height, width, 3) - 0.5).requires_grad_(),
        depth_mean=(1 + rand(height, width)).requires_grad_(),
        depth_median=(1 + rand(height, width)).requires_grad_(),
        distortion=rand(height, width).requires_grad_(),
        radii=torch.zeros(0),
    )


def plane_depth(camera: Camera, normal_world: np.ndarray, offset: float) -> Tensor:
    """Return the exact z-depth [H, W] of the plane {X: normal . X = offset}."""
    i, j = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, np.ones_like(i)], axis=-1)
    rays_world = rays @ camera.rotation  # z = 1 along each ray
    return torch.from_numpy((offset - normal_world @ camera.center) / (rays_world @ normal_world))
