"""Pairs of splat and pixel in the reference rasterizer: intersection, alpha and blending weights (rules 3 to 7).

All pairs of n splats and P pixels are dense matrices, front to back along dimension 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from gs2d.core.transforms import perpendicular
from gs2d.render.reference_projection import ScreenSplats
from gs2d.render.types import RasterSettings


@dataclass(frozen=True)
class Pairs:
    """n splats x P pixels, in blending order along dimension 0."""

    rho: Tensor  # [n, P]
    depth: Tensor  # [n, P] world units; z_c where the pair does not use the plane, so always finite
    near_enough: Tensor  # [n, P] bool: passes the near test of rule 5
    uv: Tensor  # [n, P, 2] standard deviations; 0 where the pair does not use the plane


def evaluate_pairs(
    screen: ScreenSplats, points: Tensor, settings: RasterSettings, shift: Tensor | None = None
) -> Pairs:
    """Evaluate intersection, low-pass filter and near test (rules 3, 4, 5) of n splats at ``points`` of a PixelBlock.

    ``shift`` [n, P, 2] are zeros added to (Tu.z, Tv.z), for their gradient (rule 13).
    """
    planes = _planes_of_pixels if points.shape[1] == 2 else _planes_of_rays
    h_u, h_v, Tw, offset2 = planes(screen, points, shift)
    cross = torch.linalg.cross(h_u, h_v)  # (u, v, 1) up to scale: both planes contain the intersection

    rho2d = offset2 / settings.clamp_px**2
    with torch.no_grad():  # branches have no gradient; comparisons with NaN are False, as required
        uv = cross[..., :2] / cross[..., 2:]
        z = (uv * Tw[..., :2]).sum(dim=2) + Tw[..., 2]
        hit = (cross[..., 2] != 0) & (z > 0) & z.isfinite()
        on_plane = hit & ((uv * uv).sum(dim=2) <= rho2d)

    # Pairs that do not use the plane get the splat's centre (0, 0, 1): rho3d 0, depth z_c, and no gradient.
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=points.dtype, device=points.device)
    cross = torch.where(on_plane[..., None], cross, centre)
    uv = cross[..., :2] / cross[..., 2:]
    rho = torch.where(on_plane, (uv * uv).sum(dim=2), rho2d)
    depth = torch.where(on_plane, (uv * Tw[..., :2]).sum(dim=2) + Tw[..., 2], screen.Tw[:, None, 2])
    if settings.lowpass_depth == "plane":
        depth = torch.where(hit & ~on_plane, _plane_depth_at(h_u, h_v, Tw, hit & ~on_plane), depth)
    return Pairs(rho, depth, depth.detach() >= settings.near, uv)


def _planes_of_pixels(screen: ScreenSplats, points: Tensor, shift: Tensor | None) -> tuple[Tensor, ...]:
    """Return the planes through the pixel's column and row, Tw, and the squared distance from the projected centre.

    The first three are rows [n, P or 1, 3] that act on (u, v, 1).
    """
    delta = points[None] - screen.center[:, None]  # [n, P, 2] px, from the projected centre
    h_u = delta[..., 0:1] * screen.Tw[:, None] - screen.Au[:, None]  # [n, P, 3]: the plane through pixel column x
    h_v = delta[..., 1:2] * screen.Tw[:, None] - screen.Av[:, None]
    if shift is not None:
        zero = torch.zeros_like(shift[..., :1])
        h_u = h_u - torch.cat([zero, zero, shift[..., 0:1]], dim=2)
        h_v = h_v - torch.cat([zero, zero, shift[..., 1:2]], dim=2)
    return h_u, h_v, screen.Tw[:, None], (delta * delta).sum(dim=2)


def _planes_of_rays(screen: ScreenSplats, points: Tensor, shift: Tensor | None) -> tuple[Tensor, ...]:
    """Return the same for rays (rule 25): two planes that contain the ray, and the depth along it."""
    ray, centre = points[:, :3], normalize(screen.center, dim=1)
    axes = torch.cat([perpendicular(ray), ray[:, None]], dim=1)  # [P, 3, 3]
    H = torch.stack([screen.Au, screen.Av, screen.center], dim=2)  # [n, 3, 3]: x_cam = H (u, v, 1)
    rows = torch.einsum("pki,nij->npkj", axes, H)  # [n, P, 3, 3]
    if shift is not None:
        moved = torch.einsum("npi,nij,pkj->npk", shift, perpendicular(centre.detach()), axes)
        rows = rows + pad(moved[..., None], (2, 0))
    away = centre[:, None] - ray
    return (*rows.unbind(dim=2), points[:, 3] * (away * away).sum(dim=2))


def blend_weights(alpha: Tensor, settings: RasterSettings) -> tuple[Tensor, Tensor]:
    """Return weights w and incoming transmittance T [n, P] of each pair (rule 7) from alpha [n, P].

    Alpha is 0 for skipped pairs; w is 0 for them and after a pixel has stopped.
    """
    with torch.no_grad():
        live = (1 - alpha).cumprod(dim=0) >= settings.transmittance_min  # monotone: once False, False to the end
    alpha = torch.where(live, alpha, 0.0)
    after = (1 - alpha).cumprod(dim=0)
    T = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    return alpha * T, T


def pair_alpha(opacity: Tensor, pairs: Pairs, settings: RasterSettings) -> Tensor:
    """Return alpha [n, P] of rule 6: 0 for skipped pairs; gradients pass the limit alpha_max unchanged."""
    alpha = opacity[:, None] * torch.exp(-pairs.rho / 2)
    kept = (alpha.detach() >= settings.alpha_min) & pairs.near_enough
    limited = alpha + (alpha.clamp(max=settings.alpha_max) - alpha).detach()
    return torch.where(kept, limited, 0.0)


def _plane_depth_at(h_u: Tensor, h_v: Tensor, Tw: Tensor, where: Tensor) -> Tensor:
    """Return the ray-plane depth [n, P] of filtered pairs with constant (u, v), as in the official code."""
    with torch.no_grad():
        cross = torch.linalg.cross(h_u, h_v)
        uv = torch.where(where[..., None], cross[..., :2] / cross[..., 2:], 0.0)
    return (uv * Tw[..., :2]).sum(dim=2) + Tw[..., 2]
