"""The first contributors of points of an image, in plain torch with gradients by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.reference_pairs import blend_weights, evaluate_pairs, pair_alpha
from gs2d.render.reference_projection import MAX_PAIRS, cutoff_squared, project, screen_boxes, visible_rows
from gs2d.render.types import Contributors, RasterSettings

WIDENED = 1e-2  # px, on each side of a splat's box, so that rounding drops no pair that passes the exact tests


def first_contributors(
    splats: Splats, camera: Camera, points: Tensor, count: int, settings: RasterSettings
) -> Contributors:
    """Return the first contributors; see :func:`gs2d.render.api.first_contributors`, which checks the arguments."""
    rows = visible_rows(splats, camera, settings, for_errors=False)
    screen = project(splats, rows, camera, settings)
    boxes = screen_boxes(screen, cutoff_squared(screen.opacity, settings), camera, settings).to(points)
    low, high = boxes[:, None, :2] - WIDENED, boxes[:, None, 2:] + WIDENED  # [M, 1, 2]
    parts = []
    for some in points.split(max(1, MAX_PAIRS // max(len(rows), 1))):
        near = ((some >= low) & (some <= high)).all(dim=2).any(dim=1).nonzero()[:, 0]
        chosen = screen.rows(near)
        pairs = evaluate_pairs(chosen, some, settings)
        w, _ = blend_weights(pair_alpha(chosen.opacity, pairs, settings), settings)  # [n, P]
        order = torch.arange(len(w), device=w.device)[:, None].expand_as(w)
        order = torch.where(w > 0, order, len(w))
        order = torch.cat([order, order.new_full((count, len(some)), len(w))])  # there are at least ``count`` rows
        place = order.topk(count, dim=0, largest=False).values.T  # [P, count], in blending order
        is_there = place < len(w)

        def of(values: Tensor, place: Tensor = place, is_there: Tensor = is_there) -> Tensor:
            """Return values [n, P, ...] of the contributors [P, count, ...]; 0 where there is none."""
            if not len(values):
                return values.new_zeros((*place.shape, *values.shape[2:]))
            picked = values[place.clamp(max=len(values) - 1), torch.arange(len(place), device=place.device)[:, None]]
            return torch.where(is_there.reshape(*place.shape, *[1] * (picked.dim() - 2)), picked, 0)

        ids = torch.where(is_there, of(rows[near][:, None].expand(-1, len(some))), -1)
        normal = chosen.normal[:, None].expand(-1, len(some), -1)
        parts.append(Contributors(ids, of(w), of(pairs.depth), of(normal), of(pairs.uv)))
    return Contributors(*map(torch.cat, zip(*parts, strict=True)))
