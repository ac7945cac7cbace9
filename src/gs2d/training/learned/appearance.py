"""Colours as a photograph shows them, by the numbers that were learned of it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES
from gs2d.core.camera import Camera
from gs2d.core.sh import rgb_to_sh0, sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.training.learned.quantity import ImagePoints

Numbers = Mapping[str, Tensor]
"""Numbers of a view by the name of the quantity, in the order of application."""


def shown(color: Tensor, numbers: Numbers, at: ImagePoints, clipped: Tensor | None = None) -> Tensor:
    """Return colours [H, W, 3] of the scene as a photograph shows them, with gradients for colours and numbers.

    Parameters
    ----------
    color : Tensor [H, W, 3]
    numbers : mapping of name to Tensor
    at : ImagePoints
    clipped : Tensor [H, W, 3] bool, optional
        Where the photograph is at its ceiling, so that it says "this bright or brighter": there at most 1.
    """
    quantities = [(QUANTITIES.get(name), found) for name, found in numbers.items()]
    for quantity, found in quantities:
        color = quantity.apply(color, found, at)
    if clipped is None or not any(quantity.changes_color for quantity, _ in quantities):
        return color
    return torch.where(clipped & (color.detach() > 1), 1.0, color)


@torch.no_grad()
def shown_splats(splats: Splats, camera: Camera, numbers: Numbers, sh_degree: int) -> Splats:
    """Return splats in the colours that a photograph shows, to be rendered at SH degree 0."""
    center = torch.as_tensor(camera.center).to(splats.means)
    directions = torch.nn.functional.normalize(splats.means - center, dim=1)
    rgb = sh_to_rgb(splats.sh0, splats.shN, directions, min(sh_degree, splats.sh_degree))  # [N, 3]
    seen = shown(rgb[None], numbers, ImagePoints(camera, points=splats.means))[0]
    return Splats(**(dict(splats.items()) | {"sh0": rgb_to_sh0(seen)}))
