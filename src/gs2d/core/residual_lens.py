"""What is left of a lens whose distortion was taken out with coefficients that are a little off (docs/math.md).

A photograph whose lens was taken out should be the picture of a pinhole. If it is a little off, its pixel at y focal
lengths from the principal point shows what a pinhole shows at x = y (1 + k1 |y|^2 + k2 |y|^4). Training looks through
that at what it renders, which has gradients by k1, k2 and the camera; everything later sees photographs that were
straightened, once, by the inverse.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.camera import Camera

_NEWTON = 10  # steps from x to y: residual lenses are weak, and each step squares what is left


def through_lens(picture: Tensor, camera: Camera, lens: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the photograph of a camera with this lens shows of a pinhole's picture.

    Parameters
    ----------
    picture : Tensor [H, W, C]
        Rendered by ``camera``.
    camera : Camera
        Its ``intrinsics``, where they learn, get their part of the gradient.
    lens : Tensor [2]
        k1 and k2.

    Returns
    -------
    seen : Tensor [H, W, C]
        Cubic samples, with gradients by all three.
    inside : Tensor [H, W] bool
        Where the picture reaches; beyond it its border is repeated.
    """
    focal, center = _numbers(camera, picture)
    pixels = _centres(camera, picture)
    y = (pixels - center) / focal
    k1, k2 = lens.to(picture).unbind()
    square = y.square().sum(dim=2, keepdim=True)
    places = pixels + (pixels - center) * square * (k1 + k2 * square)
    return sampled(picture, places), _within(places, camera)


@torch.no_grad()
def straightened(picture: Tensor, camera: Camera, lens: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Return the pinhole picture that a photograph [H, W, C] with this lens shows, and where [H, W] it does.

    The inverse of :func:`through_lens`, to the resampling.
    """
    places, inside = seen_at(camera, picture, lens)
    return sampled(picture, places), inside


@torch.no_grad()
def seen_at(camera: Camera, like: Tensor, lens: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Return where a photograph shows what belongs into each pixel of the pinhole: y of x, by Newton.

    Returns
    -------
    places : Tensor [H, W, 2] px
        Of the type of ``like``, where that is.
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
        slope = (1 + square * (3 * k1 + 5 * k2 * square)).clamp_min(0.1)  # it folds beyond what a picture shows
        near = (near - value / slope).clamp_min(0)
    y = x * torch.where(far > 0, near / far.clamp_min(1e-12), torch.ones_like(far))
    places = (y * focal + center).to(like.dtype)
    return places, _within(places, camera)


def _numbers(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """Focal lengths [2] and principal point [2] px, those that learn where there are such."""
    given = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    numbers = (given if camera.intrinsics is None else camera.intrinsics).to(device=like.device, dtype=like.dtype)
    return numbers[:2], numbers[2:]


def _centres(camera: Camera, like: Tensor) -> Tensor:
    """Centres of the pixels [H, W, 2] px."""
    sides = (torch.arange(n, device=like.device, dtype=like.dtype) + 0.5 for n in (camera.height, camera.width))
    rows, columns = torch.meshgrid(*sides, indexing="ij")
    return torch.stack([columns, rows], dim=2)


def sampled(picture: Tensor, places: Tensor) -> Tensor:
    """Return cubic samples of a picture [H, W, C] at places [H, W, 2] px; its border extends outwards.

    Linear ones blur what is a pixel wide, and training would sharpen the splats against it.
    """
    height, width, _ = picture.shape
    grid = places * (2.0 / places.new_tensor([width, height])) - 1.0  # -1 and 1 are the outer edges
    planes = picture.permute(2, 0, 1)[None]
    found = F.grid_sample(planes, grid[None], mode="bicubic", padding_mode="border", align_corners=False)
    return found[0].permute(1, 2, 0)


def _within(places: Tensor, camera: Camera) -> Tensor:
    column, row = places.detach().unbind(dim=2)
    return (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
