"""Space that photographs show to be empty, and the splats in it.

A photograph sees through everything before the surface that it shows. Splats there are fog: sheets and streaks before a
camera that explain its picture and hide what others see. Nothing here is part of the state: it follows from the capture
and the recipe, so a resume knows the same.
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
from gs2d.kernels.native_free_space import SeenSpace, look_at_free_space
from gs2d.training.plane_sweep import SWEEP_BYTES, Sweep

NEARER = 0.9  # free is what is nearer than this fraction of the depth: depths are good to a few percent
WINDOW = 5  # px of the small images, the nearest depth of which counts: splats have a size, and edges are not sharp
SPREAD = 1.0  # standard deviations from its centre, along both axes, at which a splat is looked at too
SAMPLES = (0.15, 0.4, 1.0)  # standard deviations from its centre at which a large splat may lie on a known surface
FLOOR = 0.8  # where a depth is unknown, the fraction of the nearest sparse point's in the image that is free
BALL = 0.5  # of that distance: the radius of a free ball around a camera, where the photographer stood
AGREE = 0.03  # depths of the plane sweep count where a neighbour's differs by at most this fraction
_UNKNOWN = float("inf")


@dataclass(frozen=True, eq=False)
class FreeView:
    """What one image says of free space.

    Attributes
    ----------
    limit : Tensor [H, W] world units
        What is nearer is free, because the image shows something behind it; 0 where it is not known what.
    known : Tensor [H, W] world units
        Depth of what the image shows; infinite where that is not known.
    nearest : Tensor [H, W] world units
        Where the image shows something of unknown depth, what is nearer than anything known; 0 elsewhere.
    radius : float, world units
        Of a ball around the camera where nothing is expected.
    K, T : Tensor [3, 3], [4, 4]
        Intrinsics; T_cam_world.
    """

    limit: Tensor
    known: Tensor
    nearest: Tensor
    radius: float
    K: Tensor
    T: Tensor

    def to(self, device: torch.device | str) -> FreeView:
        """Return the same on a device."""
        moved = {name: getattr(self, name).to(device) for name in ("limit", "known", "nearest", "K", "T")}
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
        """Give the tensors to a device; of many photographs, one by one."""
        self._device = torch.device(device)
        if isinstance(self._views, Spilled) and self._views.in_memory == len(self._views):
            self._views = [view.to(device) for view in self._views]

    @torch.no_grad()
    def against(self, splats: Splats) -> Tensor:
        """Return how many images speak against each splat, [N] int32; 0 where as many show a surface there.

        An image speaks against a splat if it shows something behind it. One or two percent of the depths of each image
        are wrong, mostly at edges; over all images that is much, so more of them must see through a splat than see a
        surface there. Where no depth is known an image is silent. A splat nearer than anything known, or beside a
        camera, is proposed all the same, but by one vote: what images miss there stays.
        """
        ends = self._ends(splats)
        reach = (ends - ends[0]).norm(dim=2).amax(dim=0)
        against, silent, support, unused = torch.zeros((4, len(splats)), dtype=torch.int32, device=splats.device)
        for kept in self._views:
            view = kept.to(self._device)
            _look(view, ends, reach, view.limit, 0.0, against, support)
            _look(view, ends, reach, view.nearest, view.radius, silent, unused)
        return torch.where(against > support, against, (silent > support).to(against.dtype))

    @torch.no_grad()
    def showing(self, splats: Splats) -> Tensor:
        """Return how many images show a surface of known depth on each splat, [N] int32.

        A splat is sampled at its centre and at ``SAMPLES`` standard deviations along both axes. The centre of a large
        splat may lie outside of all images.
        """
        axes = quats_to_matrices(splats.quats)[:, :, :2] * splats.scales[:, None, :]
        offsets = [axes[:, :, axis] * (sign * step) for step in SAMPLES for axis in (0, 1) for sign in (-1, 1)]
        samples = torch.cat([splats.means, *(splats.means + offset for offset in offsets)])  # [P N, 3]
        count = torch.zeros(len(splats), dtype=torch.int32, device=splats.device)
        for kept in self._views:
            view = kept.to(self._device)
            unused, support = torch.zeros((2, len(samples)), dtype=torch.int32, device=splats.device)
            _look(view, samples[None], samples.new_zeros(len(samples)), view.limit, 0.0, unused, support)
            count += (support.view(1 + len(offsets), len(splats)) > 0).any(dim=0)
        return count

    def _ends(self, splats: Splats) -> Tensor:
        """Places [P, N, 3] at which a splat is looked at: its centre, and its ends along both axes."""
        reach = SPREAD * splats.scales
        axes = quats_to_matrices(splats.quats)
        ends = [splats.means]
        for axis in (0, 1):
            offset = axes[:, :, axis] * reach[:, axis : axis + 1]
            ends += [splats.means + offset, splats.means - offset]
        return torch.stack(ends)


def _free_view(sweep: Sweep, index: int) -> FreeView:
    view = sweep.views[index]
    known = np.where(sweep.agreeing(index, AGREE) >= 1, sweep.depths[index], _UNKNOWN)
    column, row = np.floor(view.pixels).astype(np.int64).T
    np.minimum.at(known, (row, column), view.depth)
    half = WINDOW // 2
    grown = -F.max_pool2d(-torch.from_numpy(known)[None, None], WINDOW, 1, half)[0, 0]
    unknown = ~torch.isfinite(grown)
    limit = torch.where(unknown, 0.0, NEARER * grown)
    nearest = torch.where(unknown, NEARER * FLOOR * view.nearest, 0.0)
    tensors = (torch.from_numpy(np.ascontiguousarray(array)).float() for array in (view.K, view.T))
    radius = BALL * FLOOR * view.nearest
    return FreeView(limit.float(), torch.from_numpy(known).float(), nearest.float(), radius, *tensors)


def _look(
    view: FreeView,
    ends: Tensor,
    reach: Tensor,
    limit: Tensor,
    radius: float,
    against: Tensor,
    support: Tensor,
) -> None:
    """Count one image for each splat [N], natively if possible, else in torch."""
    seen = SeenSpace(_projection(view), _center(view), limit, view.known, radius, 1 - NEARER)
    if not look_at_free_space(ends, reach, seen, against, support):
        look_at_free_space_reference(view, ends, limit, radius, against, support)


def look_at_free_space_reference(
    view: FreeView, ends: Tensor, limit: Tensor, radius: float, against: Tensor, support: Tensor
) -> None:
    """Count one image for each splat [N], in torch.

    One is added to ``against`` [N] where an end of the splat is nearer than ``limit`` [H, W] or its centre is within
    ``radius`` of the camera, and to ``support`` [N] where its centre lies on the surface that the image shows.
    """
    free = (ends[0] - _center(view)).norm(dim=1) < radius
    for places in ends:
        z, inside, row, column = _seen(view, places)
        free |= inside & (z < limit[row, column])
    against += free
    z, inside, row, column = _seen(view, ends[0])
    known = view.known[row, column]
    support += inside & torch.isfinite(known) & ((z - known).abs() <= (1 - NEARER) * known)


def _center(view: FreeView) -> Tensor:
    return -view.T[:3, :3].T @ view.T[:3, 3]


def _projection(view: FreeView) -> Tensor:
    return view.K @ view.T[:3]


def _seen(view: FreeView, places: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth of places [N, 3] in a photograph, whether they are inside, and their rows and columns (clipped)."""
    project = _projection(view)
    seen = places @ project[:, :3].T + project[:, 3]  # (x z, y z, z)
    z = seen[:, 2]
    front = z.clamp_min(1e-12)
    x, y = seen[:, 0] / front, seen[:, 1] / front
    height, width = view.limit.shape
    inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    column = torch.nan_to_num(x, nan=0.0).clamp(0, width - 1).long()
    row = torch.nan_to_num(y, nan=0.0).clamp(0, height - 1).long()
    return z, inside, row, column
