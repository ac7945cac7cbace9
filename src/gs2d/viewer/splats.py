"""What a preview of splats draws: Gaussians with covariances and one colour each, as numbers for a viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.sh import sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices

MAX_DIRECTIONS = 8  # cameras from which a splat's colour is averaged
_LARGEST = 6e4  # covariances are sent as 16-bit floats


@dataclass(frozen=True, eq=False)
class Preview:
    """Splats without what a preview cannot show: their colours do not change with the view.

    Attributes
    ----------
    scale : float
        One unit of the numbers below, world units: such that a typical splat has a size of 1, for 16-bit covariances.
    centers : ndarray [N, 3] float32
    covariances : ndarray [N, 3, 3] float32
    colors : ndarray [N, 3] float32 in [0, 1]
    opacities : ndarray [N, 1] float32
    """

    scale: float
    centers: np.ndarray
    covariances: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray


@torch.no_grad()
def preview(splats: Splats, cameras: Sequence[Camera] = ()) -> Preview:
    """Numbers for a preview.

    The covariance of a disc with axes u, v and standard deviations s_u, s_v is s_u^2 u u^T + s_v^2 v v^T. The colour is
    the mean of those seen from some of the cameras, which training has fitted; without cameras the constant part alone.
    Splats that are not finite are left out.
    """
    splats = splats.to("cpu", torch.float32)
    finite = torch.stack([tensor.flatten(1).isfinite().all(1) for _, tensor in _by_row(splats)]).all(0)
    if not finite.all():  # else no copy of everything
        splats = splats.rows(finite)
    if not len(splats):
        return Preview(1.0, *(np.zeros((0, *shape), np.float32) for shape in ((3,), (3, 3), (3,), (1,))))
    scale = max(float(splats.scales.median()), 1e-12)
    axes = quats_to_matrices(splats.quats)[:, :, :2] * (splats.scales / scale)[:, None, :]  # [N, 3, 2]
    covariances = (axes @ axes.transpose(1, 2)).clamp(-_LARGEST, _LARGEST)
    return Preview(
        scale=scale,
        centers=(splats.means / scale).numpy(),
        covariances=covariances.numpy(),
        colors=_colors(splats, cameras).numpy(),
        opacities=splats.opacities[:, None].numpy(),
    )


def _by_row(splats: Splats) -> list[tuple[str, torch.Tensor]]:
    return [(name, tensor.reshape(len(tensor), -1)) for name, tensor in splats.items() if tensor.numel()]


def _colors(splats: Splats, cameras: Sequence[Camera]) -> torch.Tensor:
    some = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), MAX_DIRECTIONS)).round().astype(int))
    if not len(some):
        ahead = torch.tensor([0.0, 0.0, 1.0]).expand(len(splats), 3)
        return sh_to_rgb(splats.sh0, splats.shN, ahead, 0).clamp(0, 1)
    total = torch.zeros(len(splats), 3)
    for i in some:
        ray = splats.means - torch.from_numpy(cameras[i].center).float()
        directions = ray / ray.norm(dim=1, keepdim=True).clamp(min=1e-12)
        total += sh_to_rgb(splats.sh0, splats.shN, directions, splats.sh_degree).clamp(0, 1)
    return total / len(some)
