"""Reference implementation of splat errors: the inner sum of the paper's E_i (rule 17; docs/math.md)."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.reference_projection import blocks, cutoff_squared, project, screen_boxes, visible_rows
from gs2d.render.reference_rasterizer import evaluate_pairs, pair_alpha
from gs2d.render.types import RasterSettings


@torch.no_grad()
def splat_errors(
    splats: Splats,
    camera: Camera,
    image: Tensor,
    settings: RasterSettings,
    mask: Tensor | None = None,
    occlusion: bool = False,
) -> Tensor:
    """Return the sum of |c_i - image| over each splat's footprint [N]; see :func:`gs2d.render.api.splat_errors`."""
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
