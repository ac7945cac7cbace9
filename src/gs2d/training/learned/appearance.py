"""Colours of the scene as an image shows them, according to the learned numbers of its view."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES
from gs2d.core.camera import Camera
from gs2d.core.sh import rgb_to_sh0, sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.data.scene import View
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity

Numbers = Mapping[str, Tensor]
"""Numbers of a view by the name of the quantity."""


def shown(color: Tensor, numbers: Numbers, at: ImagePoints, clipped: Tensor | None = None) -> Tensor:
    """Return colours [H, W, 3] of the scene as an image shows them, differentiable in colours and numbers.

    Parameters
    ----------
    color : Tensor [H, W, 3]
    numbers : mapping of name to Tensor
    at : ImagePoints
    clipped : Tensor [H, W, 3] bool, optional
        Clipped pixels of the image, which may be brighter in the scene: there the result is at most 1.
    """
    quantities = _ordered(numbers)
    for quantity, found in quantities:
        color = quantity.apply(color, found, at)
    if clipped is None or not any(quantity.changes_color for quantity, _ in quantities):
        return color
    return torch.where(clipped & (color.detach() > 1), 1.0, color)


@torch.no_grad()
def shown_splats(splats: Splats, camera: Camera, numbers: Numbers, sh_degree: int) -> Splats:
    """Return splats in the colours of an image, to be rendered at SH degree 0."""
    center = torch.as_tensor(camera.center).to(splats.means)
    directions = torch.nn.functional.normalize(splats.means - center, dim=1)
    rgb = sh_to_rgb(splats.sh0, splats.shN, directions, min(sh_degree, splats.sh_degree))  # [N, 3]
    seen = shown(rgb[None], numbers, ImagePoints(camera, points=splats.means))[0]
    return Splats(**(dict(splats.items()) | {"sh0": rgb_to_sh0(seen)}))


def unshown(color: Tensor, numbers: Numbers, at: ImagePoints) -> Tensor:
    """Return colours [H, W, 3] of an image as the scene has them: the inverse of :func:`shown`."""
    for quantity, found in reversed(_ordered(numbers)):
        color = quantity.undo(color, found, at)
    return color


def numbers_of(view: View, like: Tensor) -> dict[str, Tensor]:
    """Return the numbers of the appearance of a view, with the dtype and device of ``like``."""
    return {name: torch.as_tensor(found).to(like) for name, found in view.appearance.items()}


def _ordered(numbers: Numbers) -> list[tuple[type[LearnedQuantity], Tensor]]:
    """Return quantities and numbers in the order of the registry, in which they are applied."""
    return [(QUANTITIES.get(name), numbers[name]) for name in QUANTITIES if name in numbers]
