"""Free space of the training images, and the splats in it.

Space in front of the surface that an image shows is free. Splats there are floaters: they explain the image of one
camera and hide what other images show. Nothing here is part of the state; it follows from the capture and the recipe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.memory_limit import cache_bytes
from gs2d.core.spill import Spilled
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.kernels.library import library_for
from gs2d.training.start.plane_sweep import SWEEP_BYTES, Sweep

NEARER = 0.9  # space nearer than this fraction of the depth is free, as depths are accurate to a few percent
WINDOW = 5  # px of the small images: the nearest depth in this window counts, as splats are extended
SPREAD = 1.0  # standard deviations from the centre along both axes at which a splat is tested, too
SAMPLES = (0.15, 0.4, 1.0)  # standard deviations from the centre at which a large splat may lie on a known surface
FLOOR = 0.8  # where the depth is unknown, free fraction of the depth of the nearest sparse point in the image
BALL = 0.5  # radius of a free ball around a camera, in units of that distance
AGREE = 0.03  # depths of the plane sweep count if that of a neighbour differs by at most this fraction
_UNKNOWN = float("inf")


@dataclass(frozen=True, eq=False)
class FreeView:
    """Free space of one image."""

    # [H, W] world units: nearer space is free, as the image shows a surface behind it; 0 where the depth is unknown.
    limit: Tensor
    depth: Tensor  # [H, W] world units: depth of the surface that the image shows; infinite where unknown
    nearest: Tensor  # [H, W] world units: where the depth is unknown, a depth nearer than all others; 0 elsewhere
    radius: float  # world units: radius of a ball around the camera that is expected to be empty
    project: Tensor  # [3, 4]: projects a point p to pixel (x, y) and depth z: (x z, y z, z) = project (p, 1)
    center: Tensor  # [3] world units: of the camera

    def to(self, device: torch.device | str) -> FreeView:
        """Return the view on a device."""
        moved = {name: getattr(self, name).to(device) for name in ("limit", "depth", "nearest", "project", "center")}
        return replace(self, **moved)


class FreeSpaceMaps:
    """The free space of all training views of a scene."""

    def __init__(self, sweep: Sweep, *, spilled: bool = False) -> None:
        self._device = torch.device("cpu")
        limit = 0 if spilled else cache_bytes(SWEEP_BYTES)
        self._views: Sequence[FreeView] = Spilled(
            (_free_view(sweep, index) for index in range(len(sweep.views))), limit
        )

    def move_to(self, device: torch.device | str) -> None:
        """Use a device; tensors that are in memory are moved, others on access."""
        self._device = torch.device(device)
        if isinstance(self._views, Spilled) and self._views.in_memory == len(self._views):
            self._views = [view.to(device) for view in self._views]

    @torch.no_grad()
    def against(self, splats: Splats) -> Tensor:
        """Return the number of images that speak against each splat, [N] int32.

        An image speaks against a splat if it shows a surface behind it. One or two percent of the depths of each image
        are wrong, mostly at edges. So the count is 0 unless more images see through a splat than show a surface there.
        An image without a depth there does not count. But a splat nearer than all depths of the image, or beside a
        camera, has a count of 1, so that a trial decides.
        """
        ends = self._ends(splats)
        reach = (ends - ends[0]).norm(dim=2).amax(dim=0)
        against, silent, support, unused = torch.zeros((4, len(splats)), dtype=torch.int32, device=splats.device)
        for stored in self._views:
            view = stored.to(self._device)
            _look(view, ends, reach, view.limit, 0.0, against, support)
            _look(view, ends, reach, view.nearest, view.radius, silent, unused)
        return torch.where(against > support, against, (silent > support).to(against.dtype))

    @torch.no_grad()
    def showing(self, splats: Splats) -> Tensor:
        """Return the number of images that show a surface of known depth on each splat, [N] int32.

        A splat is sampled at its centre and at ``SAMPLES`` standard deviations along both axes, because the centre of a
        large splat may lie outside all images.
        """
        axes = quats_to_matrices(splats.quats)[:, :, :2] * splats.scales[:, None, :]
        offsets = [axes[:, :, axis] * (sign * step) for step in SAMPLES for axis in (0, 1) for sign in (-1, 1)]
        samples = torch.cat([splats.means, *(splats.means + offset for offset in offsets)])  # [P N, 3]
        count = torch.zeros(len(splats), dtype=torch.int32, device=splats.device)
        for stored in self._views:
            view = stored.to(self._device)
            unused, support = torch.zeros((2, len(samples)), dtype=torch.int32, device=splats.device)
            _look(view, samples[None], samples.new_zeros(len(samples)), view.limit, 0.0, unused, support)
            count += (support.view(1 + len(offsets), len(splats)) > 0).any(dim=0)
        return count

    def _ends(self, splats: Splats) -> Tensor:
        """Return the points [P, N, 3] at which splats are tested: the centre, and the ends along both axes."""
        reach = SPREAD * splats.scales
        axes = quats_to_matrices(splats.quats)
        ends = [splats.means]
        for axis in (0, 1):
            offset = axes[:, :, axis] * reach[:, axis : axis + 1]
            ends += [splats.means + offset, splats.means - offset]
        return torch.stack(ends)


def _free_view(sweep: Sweep, index: int) -> FreeView:
    view = sweep.views[index]
    depth = np.where(sweep.agreeing(index, AGREE) >= 1, sweep.depths[index], _UNKNOWN)
    column, row = np.floor(view.pixels).astype(np.int64).T
    np.minimum.at(depth, (row, column), view.depth)
    half = WINDOW // 2
    grown = -F.max_pool2d(-torch.from_numpy(depth)[None, None], WINDOW, 1, half)[0, 0]
    unknown = ~torch.isfinite(grown)
    limit = torch.where(unknown, 0.0, NEARER * grown)
    nearest = torch.where(unknown, NEARER * FLOOR * view.nearest, 0.0)
    K, T = (torch.from_numpy(np.ascontiguousarray(array)).float() for array in (view.K, view.T))
    places = K @ T[:3], -T[:3, :3].T @ T[:3, 3]
    radius = BALL * FLOOR * view.nearest
    return FreeView(limit.float(), torch.from_numpy(depth).float(), nearest.float(), radius, *places)


def _look(
    view: FreeView, ends: Tensor, reach: Tensor, limit: Tensor, radius: float, against: Tensor, support: Tensor
) -> None:
    """Count one image for each splat [N], natively if possible, else in torch.

    ``reach`` [N] is the largest distance of an end of each splat from its centre, world units.
    """
    if not look_at_free_space(view, ends, reach, limit, radius, against, support):
        look_at_free_space_reference(view, ends, limit, radius, against, support)


def look_at_free_space(
    view: FreeView, ends: Tensor, reach: Tensor, limit: Tensor, radius: float, against: Tensor, support: Tensor
) -> bool:
    """Count natively; return False and do nothing without the native library."""
    library = library_for(ends)
    if library is None or library.dtype != torch.float32:
        return False
    tensors = {"ends": ends, "reach": reach, "project": view.project, "center": view.center}
    tensors |= {"limit": limit, "known": view.depth}
    arrays = {name: tensor.contiguous() for name, tensor in tensors.items()}
    height, width = limit.shape
    sizes = {"count": ends.shape[1], "places": len(ends), "height": height, "width": width}
    limits = {"radius": radius, "fraction": 1 - NEARER}
    library.call("gs2d_free_space", **sizes, **limits, **arrays, against=against, support=support)
    return True


def look_at_free_space_reference(
    view: FreeView, ends: Tensor, limit: Tensor, radius: float, against: Tensor, support: Tensor
) -> None:
    """Count one image for each splat [N], in torch.

    One is added to ``against`` [N] where an end of the splat is nearer than ``limit`` [H, W] or its centre is within
    ``radius`` of the camera, and to ``support`` [N] where its centre lies on the surface that the image shows.
    """
    free = (ends[0] - view.center).norm(dim=1) < radius
    for places in ends:
        z, inside, row, column = _projected(view, places)
        free |= inside & (z < limit[row, column])
    against += free
    z, inside, row, column = _projected(view, ends[0])
    depth = view.depth[row, column]
    support += inside & torch.isfinite(depth) & ((z - depth).abs() <= (1 - NEARER) * depth)


def _projected(view: FreeView, places: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the depth of points [N, 3] in an image, whether they are inside, and their clipped rows and columns."""
    projected = places @ view.project[:, :3].T + view.project[:, 3]  # (x z, y z, z)
    z = projected[:, 2]
    front = z.clamp_min(1e-12)
    x, y = projected[:, 0] / front, projected[:, 1] / front
    height, width = view.limit.shape
    inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    column = torch.nan_to_num(x, nan=0.0).clamp(0, width - 1).long()
    row = torch.nan_to_num(y, nan=0.0).clamp(0, height - 1).long()
    return z, inside, row, column
