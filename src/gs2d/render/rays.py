"""Cameras with any ray per pixel instead of a pinhole (rule 25; docs/math.md, "Rays")."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError

MAX_DENSITY = 1e12  # pixels per steradian, of pixels without a ray


def ray_map(rays: Tensor) -> Tensor:
    """Return what ``Camera.rays`` holds: unit rays and pixels per steradian [H, W, 4], from directions [H, W, 3].

    Directions are in the camera frame and of any length; 0 or not finite: the pixel has no ray and shows the
    background. Rays of neighbouring pixels should be neighbours: their differences give the size of a pixel, which has
    no gradient. Pixels with neighbours in a row or a column only are taken as square, those with none have no ray.
    """
    check_shapes({"rays": (rays, "H W 3")})
    if not rays.is_floating_point():
        raise ShapeError(f"rays must be float32 or float64, got {rays.dtype}")
    rays = torch.where(rays.isfinite().all(dim=2, keepdim=True), rays, 0.0)  # NaN would reach the gradient
    length = rays.norm(dim=2, keepdim=True)
    shown = (length > 0) & length.isfinite()
    unit = torch.where(shown, rays / torch.where(shown, length, 1.0), 0.0)
    with torch.no_grad():
        steps = []
        for dim in (0, 1):  # the mean of the steps from the pixel before and to the pixel behind
            both = shown.narrow(dim, 1, shown.shape[dim] - 1) & shown.narrow(dim, 0, shown.shape[dim] - 1)
            step = torch.cat([unit.double().diff(dim=dim), torch.ones_like(both)], dim=2) * both
            before, behind = (pad(step, (0, 0) * (2 - dim) + ends + (0, 0) * dim) for ends in ((1, 0), (0, 1)))
            sums = before + behind
            steps.append(sums[..., :3] / sums[..., 3:].clamp(min=1))
        sides = torch.stack(steps).norm(dim=-1)  # [2, H, W] radians
        area = torch.linalg.cross(*steps).norm(dim=2)  # steradians
        area = torch.where(sides.amin(dim=0) > 0, area, sides.amax(dim=0) ** 2)
        density = (1 / area[..., None]).clamp(max=MAX_DENSITY).to(rays)
    return torch.cat([torch.where(density < MAX_DENSITY, unit, 0.0), density], dim=2)
