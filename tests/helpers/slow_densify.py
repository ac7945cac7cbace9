"""Densification and changes of N as plainly as they can be written: the judge of the fast ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gs2d.config.recipe import GradDensify
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DivergedError
from gs2d.training.densify.gradient import DensifyCounts, no_statistics
from gs2d.training.state import TrainState


def keep_rows(state: TrainState, mask: Tensor) -> None:
    """Every tensor by its boolean mask."""
    state.splats = state.splats.rows(mask)
    for moments in state.moments.values():
        moments.mean, moments.square = moments.mean[mask], moments.square[mask]
    state.groups = {name: group[mask] for name, group in state.groups.items()}


def append_rows(state: TrainState, splats: Splats, groups: dict[str, Tensor]) -> None:
    """Every tensor with new rows, or zeros, at its end."""
    added = dict(splats.items())
    state.splats = Splats(**{name: torch.cat([t, added[name]]) for name, t in state.splats.items()})
    for moments in state.moments.values():
        zeros = moments.mean.new_zeros(len(splats), *moments.mean.shape[1:])
        moments.mean, moments.square = torch.cat([moments.mean, zeros]), torch.cat([moments.square, zeros])
    state.groups = {name: torch.cat([group, groups[name]]) for name, group in state.groups.items()}


@torch.no_grad()
def densify_step_by_step(
    state: TrainState, densify: GradDensify, *, iteration: int, extent: float, white: bool
) -> DensifyCounts:
    """One step after another, each a new copy of everything; parents stay until the end."""
    ends = _prunable(state.splats, densify, iteration=iteration, extent=extent, white=white)
    to_clone, to_split = _select(state, densify, extent, *ends)
    _append_clones(state, to_clone)
    _append_children(state, to_split, densify)
    parents = torch.zeros(len(state.splats), dtype=torch.bool, device=state.splats.device)
    parents[: len(to_split)] = to_split
    faint, large = _prunable(state.splats, densify, iteration=iteration, extent=extent, white=white)
    faint &= ~parents
    large &= ~parents & ~faint
    keep = ~(parents | faint | large)
    if not bool(keep.any()):
        raise DivergedError(
            f"all {int((faint | large).sum())} splats were pruned at iteration {iteration}: none has opacity >= "
            f"{densify.opacity_cull} and size <= {densify.scale_cull * extent:g}; check the cameras, or opacity_cull"
        )
    keep_rows(state, keep)
    state.statistics = no_statistics(state.splats)
    return DensifyCounts(int(to_clone.sum()), int(to_split.sum()), int(faint.sum()), int(large.sum()))


def _select(
    state: TrainState, densify: GradDensify, extent: float, faint: Tensor, large: Tensor
) -> tuple[Tensor, Tensor]:
    """Rows to clone and rows to split, bool [N] each."""
    statistics = state.statistics
    assert statistics is not None
    count = statistics["count"].clamp(min=1.0)  # never seen: sum 0, mean 0
    signed, absolute = statistics["signed"] / count, statistics["absolute"] / count
    small = state.splats.scales.amax(dim=1) <= densify.percent_dense * extent
    for_split, split_threshold = (
        (absolute, densify.abs_threshold) if densify.absolute else (signed, densify.grad_threshold)
    )
    to_clone = small & (signed >= densify.grad_threshold)
    to_split = ~small & (for_split >= split_threshold)
    if densify.max_splats is not None:
        urgency = torch.where(small, signed / densify.grad_threshold, for_split / split_threshold)
        to_clone, to_split = to_clone & ~faint & ~large, to_split & ~faint
        room = densify.max_splats - int((~(faint | large)).sum())
        for row in torch.sort(urgency, descending=True, stable=True).indices.tolist():
            if to_clone[row] or to_split[row]:
                room -= 1 if to_clone[row] else densify.split_count - (not large[row])
            if room < 0:
                to_clone[row] = to_split[row] = False
    return to_clone, to_split


def _append_clones(state: TrainState, mask: Tensor) -> None:
    """Exact copies with the memberships of the originals."""
    append_rows(state, state.splats.rows(mask), {name: group[mask] for name, group in state.groups.items()})


def _append_children(state: TrainState, mask: Tensor, densify: GradDensify) -> None:
    """Children of each marked splat (bool [<= N]), drawn from its Gaussian in its plane; the parents stay for now."""
    parents = mask.nonzero().squeeze(1)
    if len(parents) == 0:
        return
    rows = parents.repeat(densify.split_count)
    children = state.splats.rows(rows)
    draws = torch.randn(len(rows), 2, generator=state.generator, dtype=children.dtype).to(children.device)
    in_plane = draws * children.scales  # [M, 2] world units
    frames = quats_to_matrices(children.quats)[:, :, :2]  # [M, 3, 2] columns t_u, t_v
    children.means += (frames * in_plane[:, None, :]).sum(dim=2)
    children.log_scales -= math.log(densify.split_shrink)
    append_rows(state, children, {name: group[rows] for name, group in state.groups.items()})


def _prunable(
    splats: Splats, densify: GradDensify, *, iteration: int, extent: float, white: bool
) -> tuple[Tensor, Tensor]:
    """Splats that are too faint, and splats that are too large, bool [N] each."""
    faint = splats.opacities < densify.opacity_cull
    if densify.in_prune_grace(iteration, white=white):
        faint = torch.zeros_like(faint)
    large = splats.scales.amax(dim=1) > densify.scale_cull * extent
    if not densify.culls_scale(iteration):
        large = torch.zeros_like(large)
    return faint, large
