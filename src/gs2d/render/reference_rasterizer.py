"""The reference rasterizer: plain torch, any float dtype and device, with gradients by autograd.

It follows docs/math.md and is simple rather than fast: for each block of pixels, all pairs with the splats that reach
it are evaluated as dense [n, P] matrices (splats x pixels), front to back along dimension 0.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.reference_projection import (
    PixelBlock,
    ScreenSplats,
    blocks,
    cutoff_squared,
    holds_pixel,
    project,
    screen_boxes,
    visible_rows,
)
from gs2d.render.reference_transmittance import depth_at_half
from gs2d.render.types import Features, RasterSettings, RenderOutput

CHANNELS = 11  # before features: color 3, normal 3, alpha, depth_mean, depth_median, distortion, depth_transmittance


def rasterize(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    screen_probe: Tensor | None = None,
    features: Features | None = None,
) -> RenderOutput:
    """Render one view; see :func:`gs2d.render.api.rasterize`, which checks the arguments."""
    H, W = camera.height, camera.width
    rows = visible_rows(splats, camera, settings, for_errors=False)
    screen = project(splats, rows, camera, settings)
    boxes = screen_boxes(screen, cutoff_squared(screen.opacity, settings), camera, settings)
    probe = None if screen_probe is None else screen_probe[rows]
    further = None if features is None else Features(features.values[rows], features.background)
    channels = CHANNELS + (0 if features is None else features.values.shape[1])

    values, pixels = [_no_pixels(screen, probe, further, channels)], [rows[:0]]
    for block in blocks(boxes, camera, splats.dtype):
        # Checkpointing stores only the inputs of a block, so memory does not grow with the image.
        values.append(
            checkpoint(
                _blend_block,
                screen,
                block,
                probe,
                further,
                camera,
                settings,
                use_reentrant=False,
                preserve_rng_state=False,
            )
        )
        pixels.append(block.pixels)

    background = torch.tensor(settings.background, dtype=splats.dtype, device=splats.device)
    behind = [background, background.new_zeros(CHANNELS - 3), *([] if features is None else [features.background])]
    images = torch.cat(behind).repeat(H * W, 1)  # [H W, channels]
    images = images.index_put((torch.cat(pixels),), torch.cat(values)).reshape(H, W, channels)

    longer = (boxes[:, 2:] - boxes[:, :2]).amax(dim=1) / 2
    radii = torch.zeros(len(splats), dtype=splats.dtype, device=splats.device)
    radii[rows] = torch.where(holds_pixel(boxes), longer, 0.0).to(splats.dtype)
    return RenderOutput(
        color=images[..., 0:3] if features is None else torch.cat([images[..., 0:3], images[..., CHANNELS:]], dim=2),
        normal=images[..., 3:6],
        alpha=images[..., 6],
        depth_mean=images[..., 7],
        depth_median=images[..., 8],
        distortion=images[..., 9],
        radii=radii,
        depth_transmittance=images[..., 10] if settings.with_transmittance_depth else None,
    )


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
    """Evaluate intersection, low-pass filter and near test (rules 3, 4, 5).

    Parameters
    ----------
    screen : ScreenSplats
        n splats.
    points : Tensor [P, 2] px
    shift : Tensor [n, P, 2], optional
        Zeros added to (Tu.z, Tv.z), for their gradient (rule 13).
    """
    delta = points[None] - screen.center[:, None]  # [n, P, 2] px, from the projected centre
    h_u = delta[..., 0:1] * screen.Tw[:, None] - screen.Au[:, None]  # [n, P, 3]: the plane through pixel column x
    h_v = delta[..., 1:2] * screen.Tw[:, None] - screen.Av[:, None]
    if shift is not None:
        zero = torch.zeros_like(shift[..., :1])
        h_u = h_u - torch.cat([zero, zero, shift[..., 0:1]], dim=2)
        h_v = h_v - torch.cat([zero, zero, shift[..., 1:2]], dim=2)
    cross = torch.linalg.cross(h_u, h_v)  # (u, v, 1) up to scale: both planes contain the intersection

    rho2d = (delta * delta).sum(dim=2) / settings.clamp_px**2
    with torch.no_grad():  # branches have no gradient; comparisons with NaN are False, as required
        uv = cross[..., :2] / cross[..., 2:]
        z = (uv * screen.Tw[:, None, :2]).sum(dim=2) + screen.Tw[:, None, 2]
        hit = (cross[..., 2] != 0) & (z > 0) & z.isfinite()
        on_plane = hit & ((uv * uv).sum(dim=2) <= rho2d)

    # Pairs that do not use the plane get the splat's centre (0, 0, 1): rho3d 0, depth z_c, and no gradient.
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=points.dtype, device=points.device)
    cross = torch.where(on_plane[..., None], cross, centre)
    uv = cross[..., :2] / cross[..., 2:]
    rho = torch.where(on_plane, (uv * uv).sum(dim=2), rho2d)
    depth = (uv * screen.Tw[:, None, :2]).sum(dim=2) + screen.Tw[:, None, 2]
    if settings.lowpass_depth == "plane":
        depth = torch.where(hit & ~on_plane, _plane_depth_at(h_u, h_v, screen.Tw, hit & ~on_plane), depth)
    return Pairs(rho, depth, depth.detach() >= settings.near, uv)


def blend_weights(alpha: Tensor, settings: RasterSettings) -> tuple[Tensor, Tensor]:
    """Return weights w and incoming transmittance T of each pair (rule 7).

    Parameters
    ----------
    alpha : Tensor [n, P]
        0 for skipped pairs.

    Returns
    -------
    w : Tensor [n, P]
        0 for skipped pairs and after a pixel has stopped.
    T : Tensor [n, P]
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


def _blend_block(
    screen: ScreenSplats,
    block: PixelBlock,
    probe: Tensor | None,
    features: Features | None,
    camera: Camera,
    settings: RasterSettings,
) -> Tensor:
    """Blend all channels of the pixels of a block [P, channels]."""
    screen = screen.rows(block.splats)
    shift = None if probe is None else _probe_shift(probe[block.splats], screen.Tw[:, 2], len(block.pixels), camera)
    pairs = evaluate_pairs(screen, block.points, settings, shift)
    alphas = pair_alpha(screen.opacity, pairs, settings)
    w, T = blend_weights(alphas, settings)  # [n, P]

    background = torch.tensor(settings.background, dtype=w.dtype, device=w.device)
    alpha = w.sum(dim=0)  # [P] = 1 - T_final
    color = w.T @ screen.color + (1 - alpha)[:, None] * background
    normal = w.T @ screen.normal

    hit = alpha > 0
    depth_mean = torch.where(hit, (w * pairs.depth).sum(dim=0) / torch.where(hit, alpha, 1.0), 0.0)
    order = torch.arange(1, len(w) + 1, device=w.device)[:, None]  # [n, 1]
    last = torch.where((w > 0) & (T > 0.5), order, 0).amax(dim=0)  # [P], 0 = none (rule 9)
    depth_median = torch.where(last > 0, pairs.depth.gather(0, (last - 1).clamp(min=0)[None])[0], 0.0)

    # The constant far / (far - near) of the mapped depth cancels in differences and would cost float32 precision.
    m = -(settings.far * settings.near / (settings.far - settings.near)) / pairs.depth
    before = [(w * power).cumsum(dim=0) - w * power for power in (torch.ones_like(m), m, m * m)]  # A, M1, M2 so far
    distortion = (w * (m * m * before[0] - 2 * m * before[1] + before[2])).sum(dim=0)  # rule 10
    depth_transmittance = torch.zeros_like(alpha)
    if settings.with_transmittance_depth:
        blended = torch.where(w > 0, alphas, 0.0)
        depth_transmittance = depth_at_half(blended, 1 / pairs.depth, alpha, settings.depth_width(camera))
    channels = torch.stack([alpha, depth_mean, depth_median, distortion, depth_transmittance], dim=1)
    images = [color, normal, channels]
    if features is not None:
        images.append(w.T @ features.values[block.splats] + (1 - alpha)[:, None] * features.background)
    return torch.cat(images, dim=1)


def _no_pixels(screen: ScreenSplats, probe: Tensor | None, features: Features | None, channels: int) -> Tensor:
    """Return an empty [0, channels] attached to the graph, so that an empty view has zero gradients."""
    parts = [getattr(screen, f.name) for f in fields(screen)] + ([] if probe is None else [probe])
    parts += [] if features is None else [features.values]
    return torch.cat([part.flatten()[:0] for part in parts]).reshape(0, channels)


def _probe_shift(probe: Tensor, z_c: Tensor, pixels: int, camera: Camera) -> Tensor:
    """Return the zeros added to (Tu.z, Tv.z) of each pair [n, P, 2], whose gradient is that of rule 13."""
    shift = probe[:, None, :2].expand(-1, pixels, -1)
    if probe.shape[1] == 4:
        shift = shift + _PerPixel.apply(probe[:, 2:], pixels)
    half = torch.tensor([camera.width / 2, camera.height / 2], dtype=probe.dtype, device=probe.device)
    return shift * z_c.detach()[:, None, None] * half


class _PerPixel(torch.autograd.Function):
    """Copy [n, 2] to every pixel; the backward pass sums absolute values (AbsGS), not a true gradient."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, probe: Tensor, pixels: int) -> Tensor:
        return probe[:, None].expand(-1, pixels, -1).clone()

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0].abs().sum(dim=1), None


def _plane_depth_at(h_u: Tensor, h_v: Tensor, Tw: Tensor, where: Tensor) -> Tensor:
    """Return the ray-plane depth [n, P] of filtered pairs with constant (u, v), as in the official code."""
    with torch.no_grad():
        cross = torch.linalg.cross(h_u, h_v)
        uv = torch.where(where[..., None], cross[..., :2] / cross[..., 2:], 0.0)
    return (uv * Tw[:, None, :2]).sum(dim=2) + Tw[:, None, 2]
