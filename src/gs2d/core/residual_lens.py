"""Residual distortion of images that were undistorted with slightly wrong coefficients (docs/math.md).

The pixel at y focal lengths from the principal point of the undistorted photograph shows the pinhole image at
x = y (1 + k1 |y|^2 + k2 |y|^4). Training distorts its rendering this way, with gradients by k1, k2 and the camera.
Later steps use photographs that were undistorted once by the inverse.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.camera import Camera

_NEWTON = 10  # iterations from x to y; convergence is quadratic


def through_lens(image: Tensor, camera: Camera, lens: Tensor) -> tuple[Tensor, Tensor]:
    """Distort a pinhole image with a residual lens.

    Parameters
    ----------
    image : Tensor [H, W, C]
        Rendering of ``camera``.
    camera : Camera
        A tensor ``intrinsics`` receives gradients.
    lens : Tensor [2]
        k1 and k2.

    Returns
    -------
    seen : Tensor [H, W, C]
        Cubic samples, differentiable by all three.
    inside : Tensor [H, W] bool
        Pixels inside the rendering; outside, its border is repeated.
    """
    focal, center = _numbers(camera, image)
    pixels = _centres(camera, image)
    y = (pixels - center) / focal
    k1, k2 = lens.to(image).unbind()
    square = y.square().sum(dim=2, keepdim=True)
    positions = pixels + (pixels - center) * square * (k1 + k2 * square)
    return sampled(image, positions), _within(positions, camera)


@torch.no_grad()
def straightened(image: Tensor, camera: Camera, lens: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Return the pinhole image of a photograph [H, W, C] with a residual lens, and its valid pixels [H, W].

    The inverse of :func:`through_lens`, up to resampling.
    """
    positions, inside = seen_at(camera, image, lens)
    return sampled(image, positions), inside


@torch.no_grad()
def seen_at(camera: Camera, like: Tensor, lens: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Return the source position in the photograph of each pinhole pixel: y of x, by Newton's method.

    Returns
    -------
    positions : Tensor [H, W, 2] px
        With dtype and device of ``like``.
    inside : Tensor [H, W] bool
    """
    focal, center = (part.double() for part in _numbers(camera, like))
    x = (_centres(camera, like).double() - center) / focal
    k1, k2 = lens
    far = x.norm(dim=2, keepdim=True)
    near = far.clone()
    for _ in range(_NEWTON):
        square = near.square()
        value = near * (1 + square * (k1 + k2 * square)) - far
        slope = (1 + square * (3 * k1 + 5 * k2 * square)).clamp_min(0.1)  # the lens folds only outside the image
        near = (near - value / slope).clamp_min(0)
    y = x * torch.where(far > 0, near / far.clamp_min(1e-12), torch.ones_like(far))
    positions = (y * focal + center).to(like.dtype)
    return positions, _within(positions, camera)


def _numbers(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return focal lengths [2] and principal point [2], px, from the tensor ``intrinsics`` if there is one."""
    fixed = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    numbers = (fixed if camera.intrinsics is None else camera.intrinsics).to(device=like.device, dtype=like.dtype)
    return numbers[:2], numbers[2:]


def _centres(camera: Camera, like: Tensor) -> Tensor:
    """Return the pixel centres [H, W, 2] px."""
    sides = (torch.arange(n, device=like.device, dtype=like.dtype) + 0.5 for n in (camera.height, camera.width))
    rows, columns = torch.meshgrid(*sides, indexing="ij")
    return torch.stack([columns, rows], dim=2)


def sampled(image: Tensor, positions: Tensor) -> Tensor:
    """Sample an image [H, W, C] bicubically at ``positions`` [H, W, 2] px; its border extends outwards.

    Bilinear sampling blurs the image, and training would compensate by sharper splats.
    """
    height, width, _ = image.shape
    grid = positions * (2.0 / positions.new_tensor([width, height])) - 1.0  # -1 and 1 are the outer edges
    planes = image.permute(2, 0, 1)[None]
    found = F.grid_sample(planes, grid[None], mode="bicubic", padding_mode="border", align_corners=False)
    return found[0].permute(1, 2, 0)


def _within(positions: Tensor, camera: Camera) -> Tensor:
    column, row = positions.detach().unbind(dim=2)
    return (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
