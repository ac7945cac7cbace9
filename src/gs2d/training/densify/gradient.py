"""Densification by screen gradients: clone, split, prune, opacity reset (official 2DGS), and its AbsGS form.

The screen-size prune of the official code never acts (its statistic is zeroed just before the test); it is omitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gs2d.config.densify import register_densifier
from gs2d.config.recipe import GradDensify
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DivergedError
from gs2d.training import events
from gs2d.training.densify.densifier import Densifier, Surroundings
from gs2d.training.rows import append_rows
from gs2d.training.state import Moments, TrainState
from gs2d.training.step_result import StepResult

CHILDREN, SHRINK = 2, 1.6  # of a split, and the divisor of their scales (official)
LARGE = 0.1  # of the scene's extent: larger splats are pruned (official)
RESET_OPACITY = 0.01  # official
OPACITY_CAP = 0.8  # AbsGS


@register_densifier("gradient")
class GradientDensifier(Densifier):
    """Clones or splits splats with a large mean screen gradient, prunes faint and large ones, resets opacities.

    The options are the fields of GradDensify.
    """

    shares_views = True

    def __init__(self, surroundings: Surroundings, **options: Any) -> None:
        super().__init__(surroundings)
        self._options = GradDensify(**options)

    def begin(self, state: TrainState) -> None:
        """Create empty statistics."""
        state.statistics = no_statistics(state.splats) if self._options.stop > 0 else {}

    def changes(self, iteration: int) -> bool:
        """Return whether splats are densified or opacities limited at the end of an iteration."""
        options = self._options
        if iteration >= options.stop:
            return False
        resets = options.resets(iteration, white=self.surroundings.white)
        return options.densifies(iteration) or resets or self._caps(iteration)

    def _caps(self, iteration: int) -> bool:
        return self._options.cap_every > 0 and iteration % self._options.cap_every == 0

    def gathers(self, state: TrainState, iteration: int) -> Mapping[str, Tensor] | None:
        """Return the statistics until densification stops; None for a subclass with steps of its own."""
        steps = (type(self).before_backward, type(self).after_backward)
        if steps != (GradientDensifier.before_backward, GradientDensifier.after_backward):
            return None
        if iteration >= self._options.stop:
            return {}
        assert state.statistics is not None
        names = ("signed", "absolute", "count") if self._options.absolute else ("signed", "count")
        return {name: state.statistics[name] for name in names}

    def before_backward(self, state: TrainState, iteration: int) -> Tensor | None:
        """Return the screen probe until densification stops."""
        if iteration >= self._options.stop:
            return None
        columns = 4 if self._options.absolute else 2
        return state.splats.means.new_zeros(len(state.splats), columns, requires_grad=True)

    def after_backward(self, state: TrainState, output: StepResult, iteration: int) -> Sequence[events.TrainingEvent]:
        """Gather statistics, densify and reset opacities, if due."""
        options, around = self._options, self.surroundings
        happened: list[events.TrainingEvent] = []
        if iteration >= options.stop:
            return ()
        assert state.statistics is not None
        around.processes.gather(state.statistics, output, self._add)
        white = around.white
        if options.densifies(iteration):
            extent = around.scene.extent
            try:
                counts = densify_and_prune(state, options, iteration=iteration, extent=extent, white=white)
            except DivergedError as error:
                raise DivergedError(f"stage {around.stage!r}: {error}") from error
            happened.append(events.Densified(around.stage, iteration, **vars(counts), splats=len(state.splats)))
        reset = options.resets(iteration, white=white)
        if reset or self._caps(iteration):
            ceiling = RESET_OPACITY if reset else OPACITY_CAP
            limit_opacity(state, ceiling)
            happened.append(events.OpacityLimited(around.stage, iteration, ceiling, reset))
        return happened

    def _add(self, statistics: Mapping[str, Tensor], output: StepResult) -> None:
        """Add the statistics of the view of this process; splats with radius 0 are not counted."""
        signal, radii = output.signal, output.radii
        assert signal is not None
        assert radii is not None
        sums = (statistics["signed"], statistics["absolute"], statistics["count"])
        self.surroundings.backend.accumulate(*sums, signal, radii)


def no_statistics(splats: Splats) -> dict[str, Tensor]:
    """Return zero statistics: sums of the norms of signed and absolute screen gradients, and the number of views."""
    zeros = torch.zeros_like(splats.opacity_logits, requires_grad=False)
    return {"signed": zeros, "absolute": zeros.clone(), "count": zeros.clone()}


@dataclass(frozen=True)
class DensifyCounts:
    """Numbers of splats that were cloned, split, pruned by opacity and pruned by size."""

    cloned: int
    split: int
    pruned_by_opacity: int
    pruned_large: int


@torch.no_grad()
def densify_and_prune(
    state: TrainState,
    densify: GradDensify,
    *,
    iteration: int,
    extent: float,
    white: bool,
) -> DensifyCounts:
    """Clone small splats and split large ones where the mean screen gradient is high, then prune; N changes.

    Raise DivergedError if no splat would remain. ``state``: its statistics are used and then zeroed. ``iteration``:
    1-based, of the stage. ``extent`` (world units): scale that sizes are compared with. ``white``: whether the
    background is white, which adds an opacity reset.
    """
    splats, sizes = state.splats, _largest(state.splats.scales)
    prunable = partial(_prunable, densify=densify, iteration=iteration, extent=extent, white=white)
    faint, large = prunable(splats.opacities, sizes)
    clone, split = _select(state, densify, sizes, extent, (faint, large))
    parents = split.nonzero().squeeze(1)  # [P]
    children = parents.repeat(CHILDREN)  # [C] all first children, then all second ones
    shrunk = splats.log_scales[children] - math.log(SHRINK)  # [C, 2]
    faint_child, large_child = prunable(splats.opacities[children], _largest(shrunk.exp()))
    # random numbers for all children, also for those that are pruned
    means = points_in_plane(state, children)
    keep, living = ~(split | faint | large), ~(faint_child | large_child)
    cloned = (clone & keep).nonzero().squeeze(1)
    copies = (~split).long() + clone.long()  # [N] a clone is pruned with its original
    figures = (  # a faint large splat counts as faint
        clone.sum(),
        split.sum(),
        (copies * faint).sum() + faint_child.sum(),
        (copies * (large & ~faint)).sum() + (large_child & ~faint_child).sum(),
    )
    counts = DensifyCounts(*torch.stack(figures).tolist())
    if int(keep.sum()) + len(cloned) + int(living.sum()) == 0:
        raise DivergedError(
            f"all {counts.pruned_by_opacity + counts.pruned_large} splats were pruned at iteration {iteration}: none "
            f"has opacity >= {densify.opacity_cull} and size <= {LARGE * extent:g}; check the cameras, or "
            "opacity_cull"
        )
    rows = torch.cat([cloned, children[living]])
    new = splats.rows(rows)
    new.means[len(cloned) :] = means[living]
    new.log_scales[len(cloned) :] = shrunk[living]
    state.statistics = None  # refers to the old rows
    append_rows(state, new, {name: group[rows] for name, group in state.groups.items()}, keep=keep)
    state.statistics = no_statistics(state.splats)
    return counts


@torch.no_grad()
def limit_opacity(state: TrainState, ceiling: float) -> None:
    """Set opacity = min(opacity, ceiling) for all splats, and zero its moments (Adam's step count stays)."""
    state.splats.opacity_logits.clamp_(max=math.log(ceiling / (1.0 - ceiling)))
    moments = state.moments.get("opacity_logits")
    if moments is not None:
        state.moments["opacity_logits"] = Moments(
            torch.zeros_like(moments.mean), torch.zeros_like(moments.square), moments.steps
        )


def _select(
    state: TrainState, densify: GradDensify, sizes: Tensor, extent: float, ends: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the rows to clone and to split, bool [N] each; ``ends`` are the too faint and too large rows."""
    statistics = state.statistics
    assert statistics is not None
    count = statistics["count"].clamp(min=1.0)
    signed, absolute = statistics["signed"] / count, statistics["absolute"] / count
    small = sizes <= densify.percent_dense * extent
    for_split, split_threshold = (
        (absolute, densify.abs_threshold) if densify.absolute else (signed, densify.grad_threshold)
    )
    to_clone = small & (signed >= densify.grad_threshold)
    to_split = ~small & (for_split >= split_threshold)
    if densify.max_splats is None:
        return to_clone, to_split
    # The most urgent ones, so that at most ``max_splats`` remain.
    urgency = torch.where(small, signed / densify.grad_threshold, for_split / split_threshold)
    faint, large = ends
    stays = ~(faint | large)
    to_clone, to_split = to_clone & stays, to_split & ~faint  # splats that are pruned at once take no room
    growth = torch.where(to_split, CHILDREN - stays.long(), to_clone.long())  # [N] rows gained
    priority = urgency.where(growth > 0, -torch.ones_like(urgency))
    order = torch.sort(priority, descending=True, stable=True).indices
    chosen = torch.zeros_like(priority, dtype=torch.bool)
    chosen[order] = growth[order].cumsum(0) <= densify.max_splats - stays.sum()
    return to_clone & chosen, to_split & chosen


def points_in_plane(state: TrainState, rows: Tensor) -> Tensor:
    """Draw a point [M, 3] world units from the Gaussian of each of these splats, in its plane."""
    splats = state.splats
    if len(rows) == 0:
        return splats.means[rows]
    draws = torch.randn(len(rows), 2, generator=state.generator, dtype=splats.dtype).to(splats.device)
    in_plane = draws * splats.log_scales[rows].exp()  # [M, 2] world units
    frames = quats_to_matrices(splats.quats[rows])[:, :, :2]  # [M, 3, 2] columns t_u, t_v
    return splats.means[rows] + (frames * in_plane[:, None, :]).sum(dim=2)


def _largest(scales: Tensor) -> Tensor:
    """Return the larger of s_u and s_v, [M] world units."""
    return torch.maximum(scales[:, 0], scales[:, 1])


def _prunable(
    opacities: Tensor, sizes: Tensor, densify: GradDensify, *, iteration: int, extent: float, white: bool
) -> tuple[Tensor, Tensor]:
    """Return the splats that are too faint, and those that are too large, bool [M] each."""
    faint = opacities < densify.opacity_cull
    if densify.in_prune_grace(iteration, white=white):
        faint = torch.zeros_like(faint)
    large = sizes > LARGE * extent
    if not densify.culls_scale(iteration):
        large = torch.zeros_like(large)
    return faint, large
