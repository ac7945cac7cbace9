"""Relocation: splats that explain nothing move onto ones that do, up to a budget (the idea of 3DGS-MCMC, for discs).

Nothing is chosen by gradients. Splats are drawn by their opacity; where several then lie in one place, their opacity
and their size are such that together they are drawn as the one was. Between that they wander in their planes, the more
the fainter they are, so that they find places where they are needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gs2d.config.densify import register_densifier
from gs2d.config.validate import integer, number, require
from gs2d.errors import DivergedError
from gs2d.training import events
from gs2d.training.densify.densifier import Densifier, Surroundings
from gs2d.training.densify.gradient import points_in_plane
from gs2d.training.rows import append_rows
from gs2d.training.state import TrainState

if TYPE_CHECKING:
    from gs2d.training.objective import StepResult

MAX_COPIES = 50  # of one splat in a round: H_50 = 4.5, a disc of less than half of the size
SHARPNESS, FAINT = 100.0, 0.005  # of the step from splats that wander to those that stay


@dataclass(frozen=True)
class Relocation:
    """Options of the densifier "relocation".

    Attributes
    ----------
    max_splats : int
        The budget. N grows to it evenly until the fraction ``growing`` of the rounds, unless it is there already.
    start, stop : int
        Splats come, go and wander after ``start`` and up to ``stop``.
    rounds : int
        Between the two, evenly spread.
    growing : float
    dead_opacity : float
        Below this opacity a splat is dead.
    scale_cull : float
        So is one with max scale > scale_cull * extent.
    opacity_weight, scale_weight : float
        Of two losses that let go what is not needed, to the end of the stage: the mean opacity, and the mean scale in
        extents of the scene.
    scatter : float
        Standard deviations by which copies are spread in the plane of what they are copies of. Adam's steps of two
        splats in one place are the same, whatever the size of their gradients, so that they would stay together.
    noise : float
        Standard deviations of a splat that the faintest one wanders in its plane, in each ``noise_every`` iterations at
        first; it falls linearly to none at ``stop``.
    noise_every : int
    """

    max_splats: int
    start: int
    stop: int
    rounds: int = 100
    growing: float = 0.5
    dead_opacity: float = 0.005
    scale_cull: float = 0.1
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    scatter: float = 0.0
    noise: float = 0.5
    noise_every: int = 10

    def check(self, where: str) -> None:
        """Raise RecipeError for a value that cannot be trained with."""
        for name, low in {"max_splats": 1, "start": 0, "stop": 0, "rounds": 1, "noise_every": 1}.items():
            integer(f"{where}.{name}", getattr(self, name), low=low)
        for name in ("growing", "dead_opacity", "scale_cull", "opacity_weight", "scale_weight", "scatter", "noise"):
            number(f"{where}.{name}", getattr(self, name), low=0.0)
        require(self.growing <= 1, f"{where}.growing must be at most 1, got {self.growing}")
        require(self.dead_opacity < 1, f"{where}.dead_opacity must be below 1, got {self.dead_opacity}")

    def round_at(self, iteration: int) -> int:
        """Return which round (from 1) is at the end of an iteration; 0: none."""
        if not self.start < iteration <= self.stop:
            return 0
        length = self.stop - self.start
        done, before = ((i - self.start) * self.rounds // length for i in (iteration, iteration - 1))
        return done if done > before else 0

    def wanders(self, iteration: int) -> bool:
        """Whether splats wander at the end of an iteration."""
        return self.noise > 0 and self.start < iteration < self.stop and iteration % self.noise_every == 0

    def added(self, splats: int, number_of_round: int) -> int:
        """Return how many splats a round adds: of what is left to the budget as many as in every round to come."""
        last = max(1, math.ceil(self.growing * self.rounds))
        return max(0, self.max_splats - splats) // max(1, last - number_of_round + 1)


@register_densifier("relocation")
class RelocationDensifier(Densifier):
    """Dead splats are relocated onto live ones, and splats are added to a budget; both drawn by opacity.

    Parameters
    ----------
    surroundings : Surroundings
    **options
        Fields of :class:`Relocation`.
    """

    shares_views = True  # it asks nothing of a view

    def __init__(self, surroundings: Surroundings, **options: Any) -> None:
        super().__init__(surroundings)
        self._options = Relocation(**options)
        self._options.check(f"stage {surroundings.stage!r}: densify.options")

    def changes(self, iteration: int) -> bool:
        """Whether splats are relocated or wander at the end of an iteration."""
        return self._options.round_at(iteration) > 0 or self._options.wanders(iteration)

    def after_backward(self, state: TrainState, output: StepResult, iteration: int) -> Sequence[events.TrainingEvent]:
        """Add the gradients of what lets go; relocate and add splats, or let them wander, where that is due."""
        self._let_go(state, output)
        number_of_round = self._options.round_at(iteration)
        if number_of_round:
            return self._relocate(state, number_of_round, iteration)
        if self._options.wanders(iteration):
            self._wander(state, iteration)
        return ()

    @torch.no_grad()
    def _let_go(self, state: TrainState, output: StepResult) -> None:
        """d/dlogit mean(o) = o (1 - o) / N; d/dlog s of the mean scale: s / (2 N), in extents."""
        options, splats, gradients = self._options, state.splats, output.gradients
        if options.opacity_weight > 0 and "opacity_logits" in gradients:
            o = splats.opacities
            gradients["opacity_logits"].add_(o * (1 - o), alpha=options.opacity_weight / len(state.splats))
        if options.scale_weight > 0 and "log_scales" in gradients:
            weight = options.scale_weight / (2 * len(state.splats) * self.surroundings.scene.extent)
            gradients["log_scales"].add_(splats.scales, alpha=weight)

    @torch.no_grad()
    def _wander(self, state: TrainState, iteration: int) -> None:
        options, splats = self._options, state.splats
        gate = torch.sigmoid(SHARPNESS * (FAINT - splats.opacities)) * (1 + math.exp(-SHARPNESS * FAINT))
        reach = options.noise * (1 - iteration / options.stop) * gate
        rows = torch.arange(len(splats), device=splats.device)
        moved = points_in_plane(state, rows, reach)
        self.surroundings.backend.assign(splats.means, moved)

    @torch.no_grad()
    def _relocate(self, state: TrainState, number_of_round: int, iteration: int) -> Sequence[events.TrainingEvent]:
        options, splats, around = self._options, state.splats, self.surroundings
        opacities = splats.opacities
        faint = opacities < options.dead_opacity
        large = splats.scales.amax(dim=1) > options.scale_cull * around.scene.extent
        live = ~(faint | large)
        living = int(live.sum())
        if living == 0:
            raise DivergedError(
                f"stage {around.stage!r}: all {len(splats)} splats are dead at iteration {iteration}: none has opacity "
                f">= {options.dead_opacity} and size <= {options.scale_cull * around.scene.extent:g}; check the cameras"
            )
        grown = options.added(len(state.splats), number_of_round)
        dead = min(len(state.splats) - living, max(0, options.max_splats - living))
        sources = live.nonzero().squeeze(1)
        counts = drawn(opacities[sources], dead + grown, state.generator)  # copies of each
        spread = counts > 0
        changed, copies = sources[spread], counts[spread]
        logits, log_scales = shared(splats.opacity_logits[changed], splats.log_scales[changed], copies + 1)
        splats.opacity_logits[changed], splats.log_scales[changed] = logits, log_scales
        for moments in state.moments.values():  # of another splat
            moments.mean[changed], moments.square[changed] = 0, 0
        rows = changed.repeat_interleave(copies)
        new = splats.rows(rows)
        if options.scatter > 0:
            new.means = points_in_plane(state, rows, torch.full_like(opacities[rows], options.scatter))
        append_rows(state, new, {name: group[rows] for name, group in state.groups.items()}, keep=live)
        figures = torch.stack([faint.sum(), (large & ~faint).sum(), counts.sum()])
        faded, grew, copied = figures.tolist()
        return (events.Densified(around.stage, iteration, copied, 0, faded, grew, len(state.splats)),)


def drawn(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """How often each of M rows is drawn [M] int64, in ``count`` draws by weight, but ``MAX_COPIES`` times at most."""
    ends = weights.double().cumsum(0)
    places = torch.rand(count, generator=generator, dtype=torch.float64).to(weights.device) * ends[-1]
    rows = torch.searchsorted(ends, places, right=True).clamp(max=len(weights) - 1)
    return torch.bincount(rows, minlength=len(weights)).clamp(max=MAX_COPIES)


def shared(opacity_logits: Tensor, log_scales: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity logits [M] and log scales [M, 2] of ``counts`` [M] equal discs that together are drawn as one was.

    At the centre n of them transmit what the one did: o' = 1 - (1 - o)^(1/n). Beside it they would be denser, so they
    are smaller: over its plane, a disc of opacity o covers 2 pi s_u s_v o in all, and n of them
    2 pi s'_u s'_v sum_{m=1..n} (1 - (1 - o)^(m/n)) / m, which is made equal (docs/math.md).
    """
    log_through = torch.nn.functional.logsigmoid(-opacity_logits.double())  # log(1 - o)
    n = counts.double()
    opacity = -torch.expm1(log_through / n)
    m = torch.arange(1, int(counts.max()) + 1 if len(counts) else 1, device=counts.device).double()
    terms = -torch.expm1(log_through[:, None] * (m / n[:, None])) / m
    covered = torch.where(m <= n[:, None], terms, torch.zeros_like(terms)).sum(dim=1)
    shrink = 0.5 * (torch.log(-torch.expm1(log_through)) - torch.log(covered))  # of either scale
    logits = torch.logit(opacity)
    return logits.to(opacity_logits.dtype), (log_scales + shrink[:, None]).to(log_scales.dtype)
