"""Native test for splats in free space; ``training/robust/free_space_maps.py`` has the same in torch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gs2d.kernels.library import library_for


class SeenSpace(NamedTuple):
    """Free space and surface depth of one image.

    Attributes
    ----------
    project : Tensor [3, 4] float32
        Projects a point p to pixel (x, y) and depth z: (x z, y z, z) = project (p, 1).
    center : Tensor [3] float32
        Camera centre, world units.
    limit, known : Tensor [H, W] float32, world units
        Points nearer than ``limit`` are in free space; ``known`` is the depth of the surface, or infinite.
    radius : float
        Radius of the free ball around the camera, world units.
    fraction : float
        A centre is on the surface if its depth differs by at most this fraction.
    """

    project: Tensor
    center: Tensor
    limit: Tensor
    known: Tensor
    radius: float
    fraction: float


def look_at_free_space(ends: Tensor, reach: Tensor, seen: SeenSpace, against: Tensor, support: Tensor) -> bool:
    """Count for each splat whether an image sees through it, and whether the image shows a surface at its centre.

    Parameters
    ----------
    ends : Tensor [P, N, 3] float32, world units
        Sample points of each splat, its centre first.
    reach : Tensor [N] float32, world units
        Largest distance of a sample point from the centre.
    seen : SeenSpace
    against, support : Tensor [N] int32
        Incremented where any sample point is in free space, and where the centre is on the surface.

    Returns
    -------
    bool
        False without the native library; nothing is done then.
    """
    library = library_for(ends)
    if library is None or library.dtype != torch.float32:
        return False
    inputs = {"ends": ends, "reach": reach}
    inputs |= {name: getattr(seen, name) for name in ("project", "center", "limit", "known")}
    given = {name: tensor.contiguous() for name, tensor in inputs.items()}
    height, width = seen.limit.shape
    sizes = {"count": ends.shape[1], "places": len(ends), "height": height, "width": width}
    limits = {"radius": seen.radius, "fraction": seen.fraction}
    library.call("gs2d_free_space", **sizes, **limits, **given, against=against, support=support)
    return True
