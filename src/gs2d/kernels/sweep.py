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
    """Result of a plane sweep, [H, W] each."""

    score: Tensor  # of the best plane: mean NCC with the two images that agree best
    plane: Tensor  # int64, index of the best plane
    before: Tensor  # with ``after`` scores of the adjacent planes; undefined at the first and the last plane
    after: Tensor


def sweep_planes(
    image: Tensor,
    mask: Tensor,
    others: Sequence[Tensor],
    turned: Tensor,
    moved: Tensor,
    depths: Tensor,
    *,
    radius: int,
    noise: float,
) -> BestPlanes | None:
    """Find the best plane of each pixel of a grey image [H, W] float32; None without the native library.

    Pixels outside of ``mask`` [H, W] bool may have the score -1. Each of the n other images [h, w] float32 has its
    own size; it shows pixel (x, y, 1) at depth z at ``z turned (x, y, 1) + moved``, homogeneous, with ``turned`` [n, 3,
    3] and ``moved`` [n, 3] float32. ``depths`` [D] float32 are in world units. Patches have 2 ``radius`` + 1 pixels per
    side; images are mirrored at their edges. ``noise`` is the variance of image noise, added to both variances of the
    NCC.
    """
    library = library_for(image)
    if library is None or library.dtype != torch.float32:
        return None
    height, width = image.shape
    images = [F.pad(tensor[None], (0, 1, 0, 1), mode="replicate")[0].contiguous() for tensor in others]
    inputs = {"image": image, "wanted": mask.to(torch.uint8), "turned": turned, "moved": moved, "depths": depths}
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
