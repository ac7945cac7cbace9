"""The reference backend: plain torch, any float dtype and device, with gradients by autograd.

The tests compare the other backends with it. It follows docs/math.md and is simple rather than fast: for each block of
pixels, all pairs with the splats that reach it are evaluated as dense [n, P] matrices (splats x pixels), front to back
along dimension 0.
"""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.backends import Backend, register_backend
from gs2d.render.reference_pairs import blend_weights, evaluate_pairs, pair_alpha
from gs2d.render.reference_projection import (
    PixelBlock,
    ScreenSplats,
    blocks,
    contains_pixel,
    cutoff_squared,
    project,
    ray_radii,
    screen_boxes,
    visible_rows,
)
from gs2d.render.types import Features, RasterSettings, RenderOutput

CHANNELS = 11  # before features: color 3, normal 3, alpha, depth_mean, depth_median, distortion, depth_transmittance
STEPS = 64  # of the bisection of the depth by transmittance: as exact as a double
MIN_SLOPE = 0.05  # of alpha per half width; bounds the gradient of pixels between two surfaces


@register_backend("reference")
class ReferenceBackend(Backend):
    """Plain torch, on any device, in float32 or float64."""

    name = "reference"
    about = "plain torch, slow; float32 and float64, any device"
    lowpass_depths = ("center", "plane")
    takes_rays = ray_gradients = slow = True

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view."""
        if gradient_rows is not None:
            splats = Splats(**{name: _only_rows(tensor, gradient_rows) for name, tensor in splats.items()})
            screen_probe = None if screen_probe is None else _only_rows(screen_probe, gradient_rows)
        return _rasterize(splats, camera, settings, screen_probe, None)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        return _rasterize(splats, camera, settings, screen_probe, features)

    @torch.no_grad()
    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Return the summed colour error of each splat [N]."""
        # Nearly transparent splats count, since opacity is ignored, but rule 6 skips all their pairs in blending.
        rows = visible_rows(splats, camera, settings, for_errors=True)
        screen = project(splats, rows, camera, settings)
        reach = torch.full_like(screen.opacity, settings.error_cutoff**2)
        if occlusion:  # nearer splats occlude with their whole blending footprint
            reach = reach.maximum(cutoff_squared(screen.opacity, settings))
        boxes = screen_boxes(screen, reach, camera, settings)

        errors = torch.zeros_like(screen.opacity)
        for block in blocks(boxes, camera, splats.dtype):
            part = screen.rows(block.splats)
            pairs = evaluate_pairs(part, block.points, settings)
            counts = pairs.near_enough & (pairs.rho <= settings.error_cutoff**2)  # [n, P]
            if mask is not None:
                counts &= mask.reshape(-1)[block.pixels]
            if occlusion:
                after = (1 - pair_alpha(part.opacity, pairs, settings)).cumprod(dim=0)
                counts &= after >= settings.transmittance_min
            truth = image.reshape(-1, 3)[block.pixels]  # [P, 3]
            difference = (part.color[:, None] - truth).abs().sum(dim=2)  # [n, P]
            errors.index_add_(0, block.splats, (difference * counts).sum(dim=1))
        out = torch.zeros(len(splats), dtype=splats.dtype, device=splats.device)
        out[rows] = errors
        return out


def _only_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """Return the same values; gradients reach only these rows."""
    shape = (-1, *[1] * (tensor.dim() - 1))
    return torch.where(rows.reshape(shape), tensor, tensor.detach()) if tensor.requires_grad else tensor


def _rasterize(
    splats: Splats, camera: Camera, settings: RasterSettings, screen_probe: Tensor | None, features: Features | None
) -> RenderOutput:
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
    if camera.rays is not None:
        longer = ray_radii(screen, cutoff_squared(screen.opacity, settings), camera, settings)
    radii = torch.zeros(len(splats), dtype=splats.dtype, device=splats.device)
    radii[rows] = torch.where(contains_pixel(boxes), longer, 0.0).to(splats.dtype)
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
    if camera.rays is not None:  # the shift of Tu.z and Tv.z as one of p
        half = half / half.new_tensor([camera.fx, camera.fy])
    return shift * z_c.detach()[:, None, None] * half


class _PerPixel(torch.autograd.Function):
    """Copy [n, 2] to every pixel; the backward pass sums absolute values (AbsGS), not a true gradient."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, probe: Tensor, pixels: int) -> Tensor:
        return probe[:, None].expand(-1, pixels, -1).clone()

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0].abs().sum(dim=1), None


# -- depth by transmittance (rule 22; docs/math.md, "Depth by transmittance") ------------------------------------------
def fraction_before(x: Tensor) -> Tensor:
    """Return F(x), the fraction of a splat's opacity up to ``x`` half widths behind its depth.

    The integral of the Epanechnikov kernel: 0 up to -1, 1 from 1 on, with a continuous slope.
    """
    x = x.clamp(-1, 1)
    return (2 + x * (3 - x * x)) / 4


def transmittance_at(z: Tensor, alpha: Tensor, inverse_depth: Tensor, width: float) -> Tensor:
    """Return T(z) = prod (1 - alpha_i F((z / z_i - 1) / width)) [P] at depths z [P], world units.

    ``alpha`` [n, P] is 0 for pairs that are not blended; ``inverse_depth`` is [n, P]. ``width`` is half the width of
    the interval as a fraction of the depth.
    """
    return (1 - alpha * fraction_before((z * inverse_depth - 1) / width)).prod(dim=0)


def depth_at_half(alpha: Tensor, inverse_depth: Tensor, total: Tensor, width: float) -> Tensor:
    """Return the depth [P] at which T has fallen by half of ``total``; 0 where nothing was blended.

    Bisection gives the value. The gradient is that of the implicit function, -(dT - dlevel) / (dT/dz), from one Newton
    step that does not change the value.
    """
    hit = total.detach() > 0
    with torch.no_grad():
        level = 1 - total / 2
        far = torch.where(alpha > 0, 1 / inverse_depth, 0.0).amax(dim=0) * (1 + width)
        near = torch.where(alpha > 0, 1 / inverse_depth, torch.inf).amin(dim=0) * (1 - width)
        near, far = torch.where(hit, near, 0.0), torch.where(hit, far, 1.0)
        for _ in range(STEPS):
            middle = (near + far) / 2
            behind = transmittance_at(middle, alpha, inverse_depth, width) <= level
            near, far = torch.where(behind, near, middle), torch.where(behind, middle, far)
        z = far
        x = ((z * inverse_depth - 1) / width).clamp(-1, 1)
        density = alpha * 0.75 * (1 - x * x) * inverse_depth / width / (1 - alpha * fraction_before(x))
        slope = transmittance_at(z, alpha, inverse_depth, width) * density.sum(dim=0)  # -dT/dz
        least = MIN_SLOPE * total / (width * z)
        slope = torch.where(hit, torch.maximum(slope, least), 1.0)
    change = transmittance_at(z, alpha, inverse_depth, width) - (1 - total / 2)
    return torch.where(hit, z + (change - change.detach()) / slope, 0.0)


PLAIN = ReferenceBackend()
