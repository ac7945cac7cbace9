"""What is trained, as data: losses, rates, densification, entry actions, stages, recipes.

A variant is a value, never an ``if``: every ablation of the paper is another :class:`Recipe` (see ``recipes.py``).
Iterations are counted from 1 within a stage; ``start`` fields mean "active when iteration > start", as in the
official 2DGS code. This module never imports torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

MU, SIGMA, ALPHA, SH = ("means",), ("quats", "log_scales"), ("opacity_logits",), ("sh0", "shN")
ALL = MU + SIGMA + ALPHA + SH


@dataclass(frozen=True)
class LossTerm:
    """One term of the loss: ``weight * LOSSES[kind]``, active when iteration > start.

    Attributes
    ----------
    kind : str
        "l1", "ssim" (1 - SSIM), "normal_consistency", "normal_consistency_per_splat" (the paper's Eq. 7 form) or
        "distortion".
    weight : float
    start : int
        Iterations of the stage without this term.
    depth : "mean", "median" or None
        Depth that surface normals come from; None takes the protocol's.
    """

    kind: str
    weight: float
    start: int = 0
    depth: str | None = None


@dataclass(frozen=True)
class Rates:
    """Adam learning rates (``reference/2dgs`` facts: the official 2DGS values).

    ``means`` decays log-linearly from ``means`` to ``means_final`` over ``means_horizon`` iterations of the stage, and
    both are multiplied by the scene's extent.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    means_horizon: int = 30_000
    quats: float = 1e-3
    log_scales: float = 5e-3
    opacity_logits: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


@dataclass(frozen=True)
class GradDensify:
    """Densification by screen-space gradients: clone, split, prune, opacity reset (official 2DGS; AbsGS as values).

    Attributes
    ----------
    grad_threshold : float
        Mean signed screen gradient from which a splat is cloned (small) or split (large).
    every, start, stop : int
        Densify when start < iteration < stop and iteration % every == 0; statistics are gathered before ``stop``.
    absolute : bool
        Gather absolute gradients too (AbsGS).
    abs_threshold : float
        With ``absolute``: splits test the absolute gradient against this; clones still test the signed one.
    percent_dense : float
        Splats with max scale <= percent_dense * extent are cloned, larger ones split.
    split_count, split_shrink : int, float
        Children of a split, and the divisor of their scales.
    opacity_cull : float
        Prune below this opacity.
    scale_cull : float
        Prune when max scale > scale_cull * extent, once iteration > reset_every.
    reset_every, reset_opacity : int, float
        Every so many iterations (before ``stop``) opacity = min(opacity, reset_opacity); 0 = never.
    reset_at : tuple of int
        Further iterations with a reset (the official code adds ``start`` on white backgrounds).
    prune_grace : int
        Nothing is pruned for opacity within so many iterations of a reset (0 in the official code).
    opacity_cap, cap_every : float, int
        AbsGS: every cap_every iterations opacity = min(opacity, opacity_cap); cap_every 0 = never.
    max_splats : int or None
        Stop growing at this count; the splats with the largest gradient go first.
    """

    grad_threshold: float = 2e-4
    every: int = 100
    start: int = 500
    stop: int = 15_000
    absolute: bool = False
    abs_threshold: float = 4e-4
    percent_dense: float = 0.01
    split_count: int = 2
    split_shrink: float = 1.6
    opacity_cull: float = 0.05
    scale_cull: float = 0.1
    reset_every: int = 3_000
    reset_opacity: float = 0.01
    reset_at: tuple[int, ...] = ()
    reset_at_start_on_white: bool = True
    prune_grace: int = 0
    opacity_cap: float = 0.8
    cap_every: int = 0
    max_splats: int | None = None


@dataclass(frozen=True)
class RankByError:
    """Entry action: E_i over all training views (paper Eq. 8); the worst ``top_percent`` become a row group."""

    top_percent: float = 1.0
    writes: str = "high_error"
    occlusion: bool = False


@dataclass(frozen=True)
class CloneInPlace:
    """Entry action: append an exact copy of the rows of a group.

    ``opacity="copy"`` keeps the opacity of both (the paper); ``"preserve"`` gives both 1 - sqrt(1 - o), so that the
    image does not change at the clone.
    """

    rows: str = "high_error"
    opacity: str = "copy"
    writes: str = "clones"


Action = RankByError | CloneInPlace


@dataclass(frozen=True)
class Stage:
    """A stretch of training with one set of trainable attributes and losses.

    Attributes
    ----------
    name : str
    iterations : int
    train : mapping of attribute name to "all" or a row group
        Attributes that are absent are frozen: bit-identical through the stage.
    losses : tuple of LossTerm
    rates : Rates
    densify : GradDensify or None
    on_enter : tuple of actions
        Run once, in order, before the first iteration.
    sh_interval : int
        Raise the SH degree every so many iterations from 0; 0 = full degree from the start.
    moments : "fresh" or "kept"
        Adam moments at entry.
    """

    name: str
    iterations: int
    train: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({name: "all" for name in ALL}))
    losses: tuple[LossTerm, ...] = ()
    rates: Rates = Rates()
    densify: GradDensify | None = None
    on_enter: tuple[Action, ...] = ()
    sh_interval: int = 0
    moments: str = "fresh"


@dataclass(frozen=True)
class Recipe:
    """Stages in order, and the seed of every random choice."""

    name: str
    stages: tuple[Stage, ...]
    seed: int = 0
    sh_degree: int = 3

    @property
    def iterations(self) -> int:
        """Iterations of all stages."""
        return sum(stage.iterations for stage in self.stages)
