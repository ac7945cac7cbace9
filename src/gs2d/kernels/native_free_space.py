"""Native test for splats in free space; ``training/robust/free_space_maps.py`` has the same in torch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gs2d.kernels.library import library_for


class SeenSpace(NamedTuple):
    """Free space and surface depth of one image; lengths in world units."""

    project: Tensor  # [3, 4] float32, a point p to pixel (x, y) and depth z: (x z, y z, z) = project (p, 1)
    center: Tensor  # [3] float32, camera centre
    limit: Tensor  # [H, W] float32; nearer points are in free space
    known: Tensor  # [H, W] float32, depth of the surface, or infinite
    radius: float  # of the free ball around the camera
    fraction: float  # a centre is on the surface if its depth differs by at most this fraction


def look_at_free_space(ends: Tensor, reach: Tensor, seen: SeenSpace, against: Tensor, support: Tensor) -> bool:
    """Count for each splat whether an image sees through it, and whether the image shows a surface at its centre.

    ``ends`` [P, N, 3] float32 are sample points of each splat, its centre first; ``reach`` [N] float32 is their largest
    distance from the centre, world units. ``against`` and ``support`` [N] int32 are incremented where any sample point
    is in free space, and where the centre is on the surface. Returns False and does nothing without the native library.
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
