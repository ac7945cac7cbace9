"""Densification by screen gradients: clone, split, prune, opacity reset (official 2DGS), and its AbsGS form.

The official screen-size prune is dead code there (its statistic is zeroed just before the test), and stays dead here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.config.recipe import GradDensify
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DivergedError
from gs2d.kernels import densify_stats as screen_signal
from gs2d.training.rows import append_rows
from gs2d.training.state import Moments, Statistics, TrainState


@dataclass(frozen=True)
class DensifyCounts:
    """What a densification did: splats cloned, split, pruned for opacity and pruned for size."""

    cloned: int
    split: int
    pruned_by_opacity: int
    pruned_large: int


@torch.no_grad()
def accumulate(statistics: Statistics, signal: Tensor, radii: Tensor, *, native: bool = False) -> None:
    """Add one view.

    Parameters
    ----------
    statistics : Statistics
        Of N splats; changed in place.
    signal : Tensor [N, 2] or [N, 4]
        Gradient of the screen probe: signed in columns 0:2, absolute in 2:4.
    radii : Tensor [N] px
        Splats with radius 0 are not counted.
    native : bool
        By the CPU library: one pass, the same to rounding.
    """
    if native:
        return screen_signal.accumulate(statistics.signed, statistics.absolute, statistics.count, signal, radii)
    seen = radii > 0
    zero = torch.zeros_like(statistics.signed)
    statistics.signed += torch.where(seen, torch.linalg.vector_norm(signal[:, :2], dim=1), zero)
    if signal.shape[1] == 4:
        statistics.absolute += torch.where(seen, torch.linalg.vector_norm(signal[:, 2:], dim=1), zero)
    statistics.count += seen


@torch.no_grad()
def densify_and_prune(
    state: TrainState, densify: GradDensify, *, iteration: int, extent: float, white: bool
) -> DensifyCounts:
    """Clone small splats and split large ones where the mean screen gradient is high, then prune; N changes.

    Parameters
    ----------
    state : TrainState
        With statistics, which are zeroed.
    densify : GradDensify
    iteration : int
        1-based, of the stage.
    extent : float, world units
        Scale of the scene: sizes are compared with it.
    white : bool
        Whether the background is white (there is one more reset then, with its grace).

    Raises
    ------
    DivergedError
        If no splat would be left.
    """
    splats, sizes = state.splats, _largest(state.splats.scales)
    clone, split = _select(state, densify, sizes, extent)
    faint, large = _prunable(splats.opacities, sizes, densify, iteration=iteration, extent=extent, white=white)
    parents = split.nonzero().squeeze(1)  # [P]
    children = parents.repeat(densify.split_count)  # [C] all first children, then all second ones
    shrunk = splats.log_scales[children] - math.log(densify.split_shrink)  # [C, 2]
    ends = _prunable(
        splats.opacities[children], _largest(shrunk.exp()), densify, iteration=iteration, extent=extent, white=white
    )
    means = _scattered(state, children)  # draws for all children, whether they live or not
    keep, living = ~(split | faint | large), ~(ends[0] | ends[1])
    cloned = (clone & keep).nonzero().squeeze(1)
    counts = _counts(clone, split, (faint, large), ends)
    if not bool(keep.any()) and not len(cloned) and not bool(living.any()):
        raise DivergedError(
            f"all {counts.pruned_by_opacity + counts.pruned_large} splats were pruned at iteration {iteration}: "
            "none has "
            f"opacity >= {densify.opacity_cull} and size <= {densify.scale_cull * extent:g}; check the cameras, or "
            "opacity_cull"
        )
    rows = torch.cat([cloned, children[living]])
    new = splats.rows(rows)
    new.means[len(cloned) :] = means[living]
    new.log_scales[len(cloned) :] = shrunk[living]
    state.statistics = None  # of rows that are no more
    append_rows(state, new, {name: group[rows] for name, group in state.groups.items()}, keep=keep)
    state.statistics = Statistics.zeros(state.splats)
    return counts


@torch.no_grad()
def limit_opacity(state: TrainState, ceiling: float) -> None:
    """Opacity = min(opacity, ceiling) for all splats, and no memory of its gradients (Adam's step count stays)."""
    state.splats.opacity_logits.clamp_(max=math.log(ceiling / (1.0 - ceiling)))
    moments = state.moments.get("opacity_logits")
    if moments is not None:
        state.moments["opacity_logits"] = Moments(
            torch.zeros_like(moments.mean), torch.zeros_like(moments.square), moments.steps
        )


def _select(state: TrainState, densify: GradDensify, sizes: Tensor, extent: float) -> tuple[Tensor, Tensor]:
    """Rows to clone and rows to split, bool [N] each."""
    statistics = state.statistics
    assert statistics is not None
    count = statistics.count.clamp(min=1.0)  # never seen: sum 0, mean 0
    signed, absolute = statistics.signed / count, statistics.absolute / count
    small = sizes <= densify.percent_dense * extent
    for_split, split_threshold = (
        (absolute, densify.abs_threshold) if densify.absolute else (signed, densify.grad_threshold)
    )
    to_clone = small & (signed >= densify.grad_threshold)
    to_split = ~small & (for_split >= split_threshold)
    if densify.max_splats is not None:
        urgency = torch.where(small, signed / densify.grad_threshold, for_split / split_threshold)
        growth = torch.where(to_split, densify.split_count - 1, to_clone.long())  # [N] rows gained
        order = torch.sort(urgency.where(growth > 0, -torch.ones_like(urgency)), descending=True, stable=True).indices
        room = densify.max_splats - len(state.splats)
        allowed = torch.zeros_like(to_clone)
        allowed[order] = growth[order].cumsum(0) <= room
        to_clone, to_split = to_clone & allowed, to_split & allowed
    return to_clone, to_split


def _scattered(state: TrainState, rows: Tensor) -> Tensor:
    """A point [M, 3] world units drawn from the Gaussian of each of these splats, in its plane."""
    splats = state.splats
    if len(rows) == 0:
        return splats.means[rows]
    draws = torch.randn(len(rows), 2, generator=state.generator, dtype=splats.dtype).to(splats.device)
    in_plane = draws * splats.log_scales[rows].exp()  # [M, 2] world units
    frames = quats_to_matrices(splats.quats[rows])[:, :, :2]  # [M, 3, 2] columns t_u, t_v
    return splats.means[rows] + (frames * in_plane[:, None, :]).sum(dim=2)


def _largest(scales: Tensor) -> Tensor:
    """The larger of s_u and s_v, [M] world units."""
    return torch.maximum(scales[:, 0], scales[:, 1])


def _prunable(
    opacities: Tensor, sizes: Tensor, densify: GradDensify, *, iteration: int, extent: float, white: bool
) -> tuple[Tensor, Tensor]:
    """Splats that are too faint, and splats that are too large, bool [M] each."""
    faint = opacities < densify.opacity_cull
    if densify.in_prune_grace(iteration, white=white):
        faint = torch.zeros_like(faint)
    large = sizes > densify.scale_cull * extent
    if iteration <= densify.reset_every:
        large = torch.zeros_like(large)
    return faint, large


def _counts(
    clone: Tensor, split: Tensor, ends: tuple[Tensor, Tensor], ends_of_children: tuple[Tensor, Tensor]
) -> DensifyCounts:
    """What happened, of old splats, clones and children together; a faint one that is large too counts as faint."""
    faint, large = ends
    copies = (~split).long() + clone.long()  # [N] a splat that is not split and its clone have one fate
    child_faint, child_large = ends_of_children
    figures = (
        clone.sum(),
        split.sum(),
        (copies * faint).sum() + child_faint.sum(),
        (copies * (large & ~faint)).sum() + (child_large & ~child_faint).sum(),
    )
    return DensifyCounts(*torch.stack(figures).tolist())
