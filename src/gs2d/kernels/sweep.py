"""Native plane sweep of one image (``cpu/sweep.cpp``); ``training/start/plane_sweep.py`` has the same in torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.kernels.library import library_for


@dataclass(frozen=True, eq=False)
class BestPlanes:
    """Result of a plane sweep.

    Attributes
    ----------
    score : Tensor [H, W]
        Score of the best plane: mean NCC with the two images that agree best.
    plane : Tensor [H, W] int64
        Index of the best plane.
    before, after : Tensor [H, W]
        Scores of the adjacent planes; undefined at the first and the last plane.
    """

    score: Tensor
    plane: Tensor
    before: Tensor
    after: Tensor


def sweep_planes(
    image: Tensor,
    wanted: Tensor,
    others: Sequence[Tensor],
    turned: Tensor,
    moved: Tensor,
    depths: Tensor,
    *,
    radius: int,
    noise: float,
) -> BestPlanes | None:
    """Find the best plane of each pixel of a grey image; None without the native library.

    Parameters
    ----------
    image : Tensor [H, W] float32
    wanted : Tensor [H, W] bool
        Pixels to sweep; the score of other pixels may be -1.
    others : sequence of n Tensor [h, w] float32
        Other images, each of its own size.
    turned, moved : Tensor [n, 3, 3], [n, 3] float32
        Another image shows pixel (x, y, 1) at depth z at ``z turned (x, y, 1) + moved``, homogeneous.
    depths : Tensor [D] float32, world units
    radius : int
        Patches have 2 radius + 1 pixels per side; images are mirrored at their edges.
    noise : float
        Variance of image noise, added to both variances of the NCC.
    """
    library = library_for(image)
    if library is None or library.dtype != torch.float32:
        return None
    height, width = image.shape
    images = [F.pad(tensor[None], (0, 1, 0, 1), mode="replicate")[0].contiguous() for tensor in others]
    inputs = {"image": image, "wanted": wanted.to(torch.uint8), "turned": turned, "moved": moved, "depths": depths}
    inputs = {name: tensor.contiguous() for name, tensor in inputs.items()}
    sizes = torch.tensor([list(tensor.shape) for tensor in others], dtype=torch.int64)
    addresses = torch.tensor([tensor.data_ptr() for tensor in images], dtype=torch.int64)
    best, before, after = (torch.full((height, width), -1.0) for _ in range(3))
    plane = torch.zeros(height, width, dtype=torch.int32)
    outputs = {"best": best, "plane": plane, "before": before, "after": after}
    counts = {"height": height, "width": width, "planes": len(depths), "neighbours": len(images), "radius": radius}
    others_of = {"others": addresses, "sizes": sizes}
    if not library.call("gs2d_sweep", **counts, **inputs, **outputs, **others_of, noise=noise):
        raise MemoryError("no memory for a plane sweep")
    return BestPlanes(best, plane.long(), before, after)
