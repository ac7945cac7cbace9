"""Densification by screen gradients: clone, split, prune, opacity reset (official 2DGS), and its AbsGS form.

The official screen-size prune is dead code there (its statistic is zeroed just before the test), and stays dead here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gs2d.config.densify import register_densifier
from gs2d.config.recipe import GradDensify
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DivergedError
from gs2d.render.backends import PLAIN, Backend
from gs2d.training import events
from gs2d.training.densify.densifier import Densifier, Surroundings
from gs2d.training.rows import append_rows, keep_rows
from gs2d.training.state import Moments, TrainState

if TYPE_CHECKING:
    from gs2d.training.objective import StepResult


@register_densifier("gradient")
class GradientDensifier(Densifier):
    """Splats with a large mean screen gradient are cloned or split, faint and large ones pruned, opacities reset.

    Parameters
    ----------
    surroundings : Surroundings
    densify : GradDensify, optional
    **options
        Fields of GradDensify, instead.
    """

    absolute: bool | None = False  # None: as the options say
    shares_views = True

    def __init__(self, surroundings: Surroundings, densify: GradDensify | None = None, **options: Any) -> None:
        super().__init__(surroundings)
        given = GradDensify() if densify is None else densify
        fixed = {} if self.absolute is None else {"absolute": self.absolute}
        self._options = replace(given, **{**fixed, **options})

    def begin(self, state: TrainState) -> None:
        """Nothing is gathered yet."""
        state.statistics = no_statistics(state.splats) if self._options.stop > 0 else {}

    def changes(self, iteration: int) -> bool:
        """Whether splats come and go, or opacities are limited, at the end of an iteration."""
        options = self._options
        if iteration >= options.stop:
            return options.only_prunes(iteration)
        resets = options.resets(iteration, white=self.surroundings.white)
        return options.densifies(iteration) or resets or self._caps(iteration)

    def _caps(self, iteration: int) -> bool:
        return self._options.cap_every > 0 and iteration % self._options.cap_every == 0

    def gathers(self, state: TrainState, iteration: int) -> Mapping[str, Tensor] | None:
        """Return the statistics, until densification stops; a class with steps of its own is asked for them."""
        steps = (type(self).before_backward, type(self).after_backward)
        if steps != (GradientDensifier.before_backward, GradientDensifier.after_backward):
            return None
        if iteration >= self._options.stop:
            return {}
        assert state.statistics is not None
        names = ("signed", "absolute", "count") if self._options.absolute else ("signed", "count")
        return {name: state.statistics[name] for name in names}

    def before_backward(self, state: TrainState, iteration: int) -> Tensor | None:
        """Return the screen probe, until densification stops."""
        if iteration >= self._options.stop:
            return None
        columns = 4 if self._options.absolute else 2
        return state.splats.means.new_zeros(len(state.splats), columns, requires_grad=True)

    def after_backward(self, state: TrainState, output: StepResult, iteration: int) -> Sequence[events.TrainingEvent]:
        """Statistics, densification and opacity resets of one iteration."""
        options, around = self._options, self.surroundings
        happened: list[events.TrainingEvent] = []
        if iteration >= options.stop:
            return self._prune_large(state, iteration)
        assert state.statistics is not None
        around.processes.gather(state.statistics, output, self._add)
        white = around.white
        if options.densifies(iteration):
            extent = around.scene.extent
            try:
                factor = self.urgency(state, iteration)
                counts = densify_and_prune(
                    state, options, iteration=iteration, extent=extent, white=white, factor=factor
                )
            except DivergedError as error:
                raise DivergedError(f"stage {around.stage!r}: {error}") from error
            happened.append(events.Densified(around.stage, iteration, **vars(counts), splats=len(state.splats)))
        reset = options.resets(iteration, white=white)
        if reset or self._caps(iteration):
            ceiling = options.reset_opacity if reset else options.opacity_cap
            limit_opacity(state, ceiling)
            happened.append(events.OpacityLimited(around.stage, iteration, ceiling, reset))
        return happened

    def _add(self, statistics: Mapping[str, Tensor], output: StepResult) -> None:
        """Add what the view of this process says."""
        assert output.signal is not None
        assert output.radii is not None
        accumulate(statistics, output.signal, output.radii, self.surroundings.backend)

    def urgency(self, state: TrainState, iteration: int) -> Tensor | None:
        """Return by how much the gradients of splats count more [N], at a densification; None: all as they are."""
        return None

    def _prune_large(self, state: TrainState, iteration: int) -> Sequence[events.TrainingEvent]:
        """Prune splats that have grown too large after densification, where that is due."""
        options, around = self._options, self.surroundings
        if not options.only_prunes(iteration):
            return ()
        large = _largest(state.splats.scales) > options.scale_cull * around.scene.extent
        count = int(large.sum())
        if count == 0:
            return ()
        if count == len(large):
            raise DivergedError(
                f"stage {around.stage!r}: all {count} splats were pruned at iteration {iteration}: none is of size <= "
                f"{options.scale_cull * around.scene.extent:g}; check the cameras, or scale_cull"
            )
        keep_rows(state, ~large)
        return (events.Densified(around.stage, iteration, 0, 0, 0, count, len(state.splats)),)


def no_statistics(splats: Splats) -> dict[str, Tensor]:
    """Nothing gathered yet: over views the sums of the norms of signed and absolute screen gradients, and the views."""
    zeros = torch.zeros_like(splats.opacity_logits, requires_grad=False)
    return {"signed": zeros, "absolute": zeros.clone(), "count": zeros.clone()}


@dataclass(frozen=True)
class DensifyCounts:
    """What a densification did: splats cloned, split, pruned for opacity and pruned for size."""

    cloned: int
    split: int
    pruned_by_opacity: int
    pruned_large: int


@torch.no_grad()
def accumulate(statistics: Mapping[str, Tensor], signal: Tensor, radii: Tensor, backend: Backend = PLAIN) -> None:
    """Add one view.

    Parameters
    ----------
    statistics : mapping of "signed", "absolute" and "count" to Tensor [N]
        Changed in place.
    signal : Tensor [N, 2] or [N, 4]
        Gradient of the screen probe: signed in columns 0:2, absolute in 2:4.
    radii : Tensor [N] px
        Splats with radius 0 are not counted.
    backend : Backend
        Does it; by default plain torch.
    """
    backend.accumulate(statistics["signed"], statistics["absolute"], statistics["count"], signal, radii)


@torch.no_grad()
def densify_and_prune(
    state: TrainState,
    densify: GradDensify,
    *,
    iteration: int,
    extent: float,
    white: bool,
    factor: Tensor | None = None,
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
    factor : Tensor [N], optional
        Times which mean gradients count.

    Raises
    ------
    DivergedError
        If no splat would be left.
    """
    splats, sizes = state.splats, _largest(state.splats.scales)
    faint, large = _prunable(splats.opacities, sizes, densify, iteration=iteration, extent=extent, white=white)
    clone, split = _select(state, densify, sizes, extent, (faint, large), factor)
    parents = split.nonzero().squeeze(1)  # [P]
    children = parents.repeat(densify.split_count)  # [C] all first children, then all second ones
    shrunk = splats.log_scales[children] - math.log(densify.split_shrink)  # [C, 2]
    ends = _prunable(
        splats.opacities[children], _largest(shrunk.exp()), densify, iteration=iteration, extent=extent, white=white
    )
    # draws for all children, whether they live or not
    means = points_in_plane(state, children)
    keep, living = ~(split | faint | large), ~(ends[0] | ends[1])
    cloned = (clone & keep).nonzero().squeeze(1)
    counts = _counts(clone, split, (faint, large), ends)
    if int(keep.sum()) + len(cloned) + int(living.sum()) == 0:
        raise DivergedError(
            f"all {counts.pruned_by_opacity + counts.pruned_large} splats were pruned at iteration {iteration}: none "
            f"has opacity >= {densify.opacity_cull} and size <= {densify.scale_cull * extent:g}; check the cameras, or "
            "opacity_cull"
        )
    rows = torch.cat([cloned, children[living]])
    new = splats.rows(rows)
    new.means[len(cloned) :] = means[living]
    new.log_scales[len(cloned) :] = shrunk[living]
    state.statistics = None  # of rows that are no more
    append_rows(state, new, {name: group[rows] for name, group in state.groups.items()}, keep=keep)
    state.statistics = no_statistics(state.splats)
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


def _select(
    state: TrainState,
    densify: GradDensify,
    sizes: Tensor,
    extent: float,
    ends: tuple[Tensor, Tensor],
    factor: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Rows to clone and rows to split, bool [N] each; ``ends`` are those that are too faint, and too large."""
    statistics = state.statistics
    assert statistics is not None
    count = statistics["count"].clamp(min=1.0)  # never seen: sum 0, mean 0
    signed, absolute = statistics["signed"] / count, statistics["absolute"] / count
    if factor is not None:
        signed, absolute = signed * factor, absolute * factor
    small = sizes <= densify.percent_dense * extent
    for_split, split_threshold = (
        (absolute, densify.abs_threshold) if densify.absolute else (signed, densify.grad_threshold)
    )
    to_clone = small & (signed >= densify.grad_threshold)
    to_split = ~small & (for_split >= split_threshold)
    if densify.max_splats is not None:
        urgency = torch.where(small, signed / densify.grad_threshold, for_split / split_threshold)
        to_clone, to_split = _within_budget(densify, to_clone, to_split, urgency, ends)
    return to_clone, to_split


def _within_budget(
    densify: GradDensify,
    to_clone: Tensor,
    to_split: Tensor,
    urgency: Tensor,
    ends: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Of the rows [N] bool to clone and to split the most urgent, so that no more than ``max_splats`` are left."""
    assert densify.max_splats is not None
    faint, large = ends
    stays = ~(faint | large)
    to_clone, to_split = to_clone & stays, to_split & ~faint  # what would be pruned at once takes no room
    growth = torch.where(to_split, densify.split_count - stays.long(), to_clone.long())  # [N] rows gained
    wanted = urgency.where(growth > 0, -torch.ones_like(urgency))
    order = torch.sort(wanted, descending=True, stable=True).indices
    chosen = torch.zeros_like(wanted, dtype=torch.bool)
    chosen[order] = growth[order].cumsum(0) <= densify.max_splats - stays.sum()
    return to_clone & chosen, to_split & chosen


def points_in_plane(state: TrainState, rows: Tensor, reach: Tensor | None = None) -> Tensor:
    """Return a point [M, 3] world units drawn from the Gaussian of each of these splats, in its plane.

    ``reach`` [M]: standard deviations, of a Gaussian that much as wide.
    """
    splats = state.splats
    if len(rows) == 0:
        return splats.means[rows]
    draws = torch.randn(len(rows), 2, generator=state.generator, dtype=splats.dtype).to(splats.device)
    draws = draws if reach is None else draws * reach[:, None]
    in_plane = draws * splats.log_scales[rows].exp()  # [M, 2] world units
    frames = quats_to_matrices(splats.quats[rows])[:, :, :2]  # [M, 3, 2] columns t_u, t_v
    return splats.means[rows] + (frames * in_plane[:, None, :]).sum(dim=2)


def _largest(scales: Tensor) -> Tensor:
    """Return the larger of s_u and s_v, [M] world units."""
    return torch.maximum(scales[:, 0], scales[:, 1])


def _prunable(
    opacities: Tensor, sizes: Tensor, densify: GradDensify, *, iteration: int, extent: float, white: bool
) -> tuple[Tensor, Tensor]:
    """Splats that are too faint, and splats that are too large, bool [M] each."""
    faint = opacities < densify.opacity_cull
    if densify.in_prune_grace(iteration, white=white):
        faint = torch.zeros_like(faint)
    large = sizes > densify.scale_cull * extent
    if not densify.culls_scale(iteration):
        large = torch.zeros_like(large)
    return faint, large


def _counts(
    clone: Tensor,
    split: Tensor,
    ends: tuple[Tensor, Tensor],
    ends_of_children: tuple[Tensor, Tensor],
) -> DensifyCounts:
    """Count what happened to old splats, clones and children together; a faint large one counts as faint."""
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
