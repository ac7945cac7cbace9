"""What is trained, as data: losses, rates, densification, entry actions, stages, recipes.

A variant is a value, never an ``if``: every ablation of the paper is another :class:`Recipe` (``config/presets.py``).
Iterations are counted from 1 within a stage; ``start`` fields mean "active when iteration > start", as in the
official 2DGS code. ``config.serialize`` writes and reads recipes and applies ``--set``; ``schedule`` scales them.
This module never imports torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

from gs2d.config.densify import Densify
from gs2d.config.losses import LOSSES
from gs2d.config.multiview import MultiView, check_multiview
from gs2d.config.priors import DepthPrior, NormalPrior, check_priors
from gs2d.config.quantities import QUANTITIES, Learning, Quantity
from gs2d.config.quantities import Exposure as Exposure  # a field's type: whoever reads a recipe finds it here
from gs2d.config.quantities import IntrinsicsRefinement as IntrinsicsRefinement
from gs2d.config.quantities import Photometry as Photometry
from gs2d.config.quantities import PoseRefinement as PoseRefinement
from gs2d.config.robust import DenseStart, Removal, check_robust
from gs2d.config.validate import group, integer, number, one_of, require

MU, SIGMA, ALPHA, SH = ("means",), ("quats", "log_scales"), ("opacity_logits",), ("sh0", "shN")
ALL = MU + SIGMA + ALPHA + SH
LARGEST_SEED = 2**63 - 1  # torch takes no larger one
DEPTH_KINDS = ("mean", "median", "transmittance")


@dataclass(frozen=True)
class LossTerm:
    """One term of the loss: ``weight * LOSSES[kind]``, in every ``every``-th iteration > start.

    Attributes
    ----------
    kind : str
        "l1", "ssim" (1 - SSIM), "l2" (the mean squared difference), "normal_consistency",
        "normal_consistency_per_splat" (the paper's Eq. 7 form), "distortion", "silhouette" (alpha against that of the
        photographs), or, in a recipe with ``multiview``, "multiview_photometric" (1 - NCC of warped patches),
        "multiview_geometric" (round trip, px); with ``depth_prior`` "depth_prior" (relative error of depth),
        with ``normal_prior`` "normal_prior" (1 - cosine); or one that a package or a program has registered
        (docs/extending.md).
    weight : float or None
        None: the protocol's weight of this kind (Table 1 of the paper writes that of "distortion" 100/10).
    start : int
        Iterations of the stage without this term.
    depth : "mean", "median", "transmittance" or None
        Depth that surface normals come from; None takes the protocol's.
    options : mapping of str to values of JSON
        Keyword arguments of the loss, which are checked before training: ``edges``, ``where`` and ``edge_power`` of
        both normal consistencies, ``required`` of "silhouette" (``gs2d.losses.terms``); those of other losses are
        what their function or constructor takes.
    every : int
        Iterations of which one has this term (those that it divides); the others cost nothing for it. The weight is as
        written, not multiplied by ``every``.

    Raises
    ------
    RecipeError
        If no loss of this kind is registered.
    """

    kind: str
    weight: float | None
    start: int = 0
    depth: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    every: int = 1

    def __post_init__(self) -> None:
        LOSSES.check(self.kind)

    def is_active(self, iteration: int) -> bool:
        """Whether an iteration (from 1) of the stage has this term."""
        return iteration > self.start and iteration % self.every == 0


@dataclass(frozen=True)
class LearningRates:
    """Adam learning rates (``reference/2dgs`` facts: the official 2DGS values).

    ``means`` decays log-linearly from ``means`` to ``means_final`` over ``means_decay_steps`` iterations of the
    stage, and both are multiplied by the scene's extent. ``stretch`` is of scaled schedules: one ``f`` times as long,
    f < 1, has all rates times ``f ** -stretch`` (2.1 times at a twentieth with 0.25). Adam's steps do not grow with
    gradients: in fewer of them a splat gets as far only if each is longer. 0 = rates as they are.

    ``view_power`` is of steps that several views share (several processes): a step on the mean of B views has all rates
    times ``B ** view_power``. 1/2 is what Grendel found (Zhao et al., "On Scaling Up 3D Gaussian Splatting Training",
    ICLR 2025); 0 = rates as they are.

    The other rates are constant, but for ``settle_steps`` iterations after ``settle_start``, over which they fall
    linearly to ``settle_factor`` times what they were, and stay there: a splat learns from one view at a time, and with
    constant steps it wanders to the end between what its views ask for. 0 steps = constant, as in the official code.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    means_decay_steps: int = 30_000
    quats: float = 1e-3
    log_scales: float = 5e-3
    opacity_logits: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    stretch: float = 0.0
    view_power: float = 0.5
    settle_start: int = 0
    settle_steps: int = 0
    settle_factor: float = 0.0

    def settled_at(self, iteration: int) -> float:
        """Factor of all rates but the means' at an iteration (1-based): 1, then linear, then constant."""
        if self.settle_steps == 0:
            return 1.0
        t = min(max((iteration - self.settle_start) / self.settle_steps, 0.0), 1.0)
        return 1.0 - t * (1.0 - self.settle_factor)

    def means_at(self, iteration: int) -> float:
        """Rate of ``means`` at an iteration (1-based), without the extent: log-linear, then constant."""
        t = min(max(iteration / self.means_decay_steps, 0.0), 1.0)
        return math.exp((1.0 - t) * math.log(self.means) + t * math.log(self.means_final))

    def times(self, factor: float) -> LearningRates:
        """Return all rates times a factor."""
        names = ("means", "means_final", "quats", "log_scales", "opacity_logits", "sh0", "shN")
        return replace(self, **{name: getattr(self, name) * factor for name in names})

    def for_views(self, views: int) -> LearningRates:
        """Return what a step on the mean gradient of so many views takes, by Grendel's rule.

        The gradients of views are nearly independent, so that one step should do what the steps of each would have
        done. The mean of B of them has a second moment 1/B as large, by whose root Adam divides: rates times
        ``B ** view_power``, eps / sqrt(B). Memory is of as many views as before: both betas to the power of B.
        """
        if views == 1:
            return self
        beta1, beta2, eps = self.beta1**views, self.beta2**views, self.eps / math.sqrt(views)
        return replace(self.times(views**self.view_power), beta1=beta1, beta2=beta2, eps=eps)

    def at_end(self, iterations: int) -> LearningRates:
        """Constant rates, at the values that these reach after so many iterations."""
        means = self.means_final if iterations >= self.means_decay_steps else self.means_at(iterations)
        settled = self.times(self.settled_at(iterations))
        return replace(settled, means=means, means_final=means, settle_start=0, settle_steps=0, settle_factor=0.0)

    def over_again(self, start: int, stop: int, iterations: int) -> LearningRates:
        """Return rates that in so many iterations go through what these are between two iterations."""
        before, after = self.settled_at(start), self.settled_at(stop)
        return replace(
            self.times(before),
            means=self.means_at(start),
            means_final=self.means_at(stop),
            means_decay_steps=iterations,
            settle_start=0,
            settle_steps=iterations if after != before else 0,
            settle_factor=after / before if after != before else 0.0,
        )


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
        Prune when max scale > scale_cull * extent: with every densification after ``scale_cull_start``.
    scale_cull_start : int or None
        None = reset_every, as in the official code.
    prune_until : int
        The prune by ``scale_cull`` goes on after ``stop``, every so many iterations as densification, up to this one.
        A stage that only does that has ``start`` and ``stop`` 0.
    reset_every, reset_opacity : int, float
        Every so many iterations (before ``stop``) opacity = min(opacity, reset_opacity); 0 = never.
    reset_at : tuple of int
        Further iterations with a reset.
    reset_at_start_on_white : bool
        A reset at iteration ``start`` too when the background is white, as in the official code (and, as there, none
        where ``reset_every`` is 0).
    reset_at_on_white : tuple of int
        Further iterations with a reset when the background is white, whatever ``reset_every`` is.
    last_reset : int or None
        No reset after this iteration; None = any before ``stop``.
    prune_grace : int
        Nothing is pruned for opacity within so many iterations of a reset (0 in the official code).
    opacity_cap, cap_every : float, int
        AbsGS: every cap_every iterations opacity = min(opacity, opacity_cap); cap_every 0 = never.
    max_splats : int or None
        A budget: no densification goes beyond this count. Where more splats ask to be cloned or split, those whose
        signal is the largest multiple of its threshold win. None = no limit.
    error_views : int
        Training views that are rendered at each densification, to multiply the gradients of a splat by how wrong they
        are where it is drawn (``training/densify/by_error.py``); 0 = none, gradients alone.
    error_power : float
        Of the error in units of its median.
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
    last_reset: int | None = None
    prune_grace: int = 0
    opacity_cap: float = 0.8
    cap_every: int = 0
    max_splats: int | None = None
    scale_cull_start: int | None = None
    prune_until: int = 0
    reset_at_on_white: tuple[int, ...] = ()
    error_views: int = 0
    error_power: float = 0.5

    def resets(self, iteration: int, *, white: bool) -> bool:
        """Whether opacity is reset at the end of this iteration."""
        if iteration >= self.stop or (self.last_reset is not None and iteration > self.last_reset):
            return False
        regular = self.reset_every > 0 and iteration % self.reset_every == 0
        at_start = white and self.reset_at_start_on_white and self.reset_every > 0 and iteration == self.start
        return regular or at_start or iteration in self.reset_at or (white and iteration in self.reset_at_on_white)

    def densifies(self, iteration: int) -> bool:
        """Whether splats are cloned, split and pruned at the end of this iteration."""
        return self.start < iteration < self.stop and iteration % self.every == 0

    def culls_scale(self, iteration: int) -> bool:
        """Whether a prune at the end of this iteration takes large splats too."""
        return iteration > (self.reset_every if self.scale_cull_start is None else self.scale_cull_start)

    def only_prunes(self, iteration: int) -> bool:
        """Whether large splats are pruned at the end of this iteration, after densification."""
        return (
            self.stop <= iteration <= self.prune_until and iteration % self.every == 0 and self.culls_scale(iteration)
        )

    def in_prune_grace(self, iteration: int, *, white: bool) -> bool:
        """Whether faint splats are spared because a reset is at most ``prune_grace`` iterations back."""
        first = max(1, iteration - self.prune_grace)
        return any(self.resets(earlier, white=white) for earlier in range(first, iteration))


@dataclass(frozen=True)
class RankByError:
    """Entry action: E_i over all training views (paper Eq. 8); the worst ``top_percent`` become a row group.

    With ``occlusion`` a pixel counts only for the splats that are blended there.
    """

    top_percent: float = 1.0
    writes: str = "high_error"
    occlusion: bool = False


@dataclass(frozen=True)
class CloneInPlace:
    """Entry action: append an exact copy of the rows of a group.

    ``opacity="copy"`` keeps the opacity of both (the paper); ``"preserve"`` gives both 1 - sqrt(1 - o), so that the
    pair transmits at its centre what one splat did (between centre and rim it is a little denser).
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
    lr : LearningRates
    densify : GradDensify, Densify or None
    on_enter : tuple of actions
        Run once, in order, before the first iteration.
    sh_interval : int
        Raise the SH degree every so many iterations from 0; 0 = full degree from the start.
    moments : "fresh" or "kept"
        Adam moments at entry.
    downscale : int
        The stage trains on photographs of 1 / ``downscale`` of their size (what ``gs2d train --downscale`` leaves of
        them), with their masks, silhouettes and maps. Scores and meshes are of the full size.
    halve_at : tuple of int
        Iterations after which ``downscale`` is half of what it was: 4 with (3000, 9000) is 4 up to iteration 3000, 2 up
        to 9000, and 1 from then on.
    """

    name: str
    iterations: int
    train: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({name: "all" for name in ALL}))
    losses: tuple[LossTerm, ...] = ()
    lr: LearningRates = LearningRates()
    densify: GradDensify | Densify | None = None
    on_enter: tuple[Action, ...] = ()
    sh_interval: int = 0
    moments: str = "fresh"
    downscale: int = 1
    halve_at: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "train", MappingProxyType(dict(self.train)))

    @property
    def moves_all(self) -> bool:
        """Whether the means of all splats are trained."""
        return self.train.get("means") == "all"

    def downscale_at(self, iteration: int) -> int:
        """Return by how much photographs are downscaled at an iteration (1-based)."""
        return self.downscale >> sum(iteration > at for at in self.halve_at)

    def active_sh_degree(self, iteration: int, max_degree: int) -> int:
        """SH degree that is trained at an iteration (1-based): 0, then one more every ``sh_interval`` iterations."""
        return max_degree if self.sh_interval == 0 else min(max_degree, iteration // self.sh_interval)


@dataclass(frozen=True)
class Recipe:
    """A training method: stages in order, and settings that hold for all of them.

    Attributes
    ----------
    name : str
    stages : tuple of Stage
    seed : int
        Of every random choice.
    sh_degree : int
        Highest SH degree of the splats, 0 to 3.
    init_points : int
        Random points that training starts from if the scene has no sparse points.
    exposure : Exposure or None
        Learns an exposure for each image; None: all images have the same.
    poses : PoseRefinement or None
        Learns camera poses; None: those of the capture.
    multiview : MultiView or None
        Settings of the multi-view losses.
    depth_prior, normal_prior : DepthPrior, NormalPrior or None
        Settings of the losses on known depths and normals.
    dense_start : DenseStart or None
        Starts from a plane sweep of the images.
    removal : Removal or None
        Removes floaters.
    fused_depth : "mean", "median", "transmittance" or None
        Depth that is fused into the mesh; None: that of the protocol.
    intrinsics : IntrinsicsRefinement or None
        Learns focal lengths and lenses with the poses; None: those of the capture.
    photometry : Photometry or None
        Learns vignetting and response of the cameras; None: neither.
    learned : tuple of Quantity
        Further quantities of images and cameras that are learned: registered ones, by name.

    Examples
    --------
    >>> import gs2d
    >>> recipe = gs2d.get_recipe("2dgs-r")
    >>> [stage.name for stage in recipe.stages], recipe.iterations
    (['surface', 'appearance', 'refine'], 60000)
    """

    name: str
    stages: tuple[Stage, ...]
    seed: int = 0
    sh_degree: int = 3
    init_points: int = 100_000
    exposure: Exposure | None = None
    poses: PoseRefinement | None = None
    multiview: MultiView | None = None
    depth_prior: DepthPrior | None = None
    normal_prior: NormalPrior | None = None
    dense_start: DenseStart | None = None
    removal: Removal | None = None
    fused_depth: str | None = None
    intrinsics: IntrinsicsRefinement | None = None
    photometry: Photometry | None = None
    learned: tuple[Quantity, ...] = ()

    @property
    def quantities(self) -> dict[str, Learning]:
        """What is learned of images and cameras: settings by the name of the quantity, in the order of application."""
        light = self.photometry
        settings = {
            "intrinsics": self.intrinsics,
            "poses": self.poses,
            "vignetting": light if light is not None and light.vignetting else None,
            "exposure": self.exposure,
            "response": light if light is not None and light.response else None,
        }
        known: dict[str, Learning] = {name: value for name, value in settings.items() if value is not None}
        return known | {quantity.name: quantity for quantity in self.learned}

    @property
    def iterations(self) -> int:
        """Iterations of all stages."""
        return sum(stage.iterations for stage in self.stages)

    def with_loss(self, term: LossTerm, *, stages: str | Sequence[str] | None = None) -> Recipe:
        """Return a recipe with one more loss; this one stays as it is.

        Parameters
        ----------
        term : LossTerm
        stages : str or sequence of str, optional
            Names of the stages that get the loss; None: all stages.

        Returns
        -------
        Recipe
            Validated.

        Raises
        ------
        RecipeError
            If a stage does not exist or has this kind of loss already.

        Examples
        --------
        >>> import gs2d
        >>> recipe = gs2d.get_recipe("2dgs-r").with_loss(gs2d.LossTerm("l2", 0.5), stages="refine")
        >>> [len(stage.losses) for stage in recipe.stages]
        [3, 3, 4]
        """
        existing = [stage.name for stage in self.stages]
        chosen = existing if stages is None else [stages] if isinstance(stages, str) else list(stages)
        for name in chosen:
            one_of(f"stage of recipe {self.name!r}", name, tuple(existing))
        added = (replace(s, losses=(*s.losses, term)) if s.name in chosen else s for s in self.stages)
        return validate(replace(self, stages=tuple(added)))


def validate(recipe: Recipe) -> Recipe:
    """Check that a recipe can be trained as written; returns it.

    Raises
    ------
    RecipeError
        Names the stage, what was found and what exists.
    """
    where = f"recipe {recipe.name!r}"
    require(bool(recipe.stages), f"{where}: expected at least one stage, got none")
    require(recipe.name != "", "a recipe must have a name, got an empty one")
    integer(f"{where}: seed", recipe.seed, low=0)
    require(recipe.seed <= LARGEST_SEED, f"{where}: seed must be at most 2^63 - 1, got {recipe.seed}")
    require(recipe.sh_degree in (0, 1, 2, 3), f"{where}: sh_degree must be 0, 1, 2 or 3, got {recipe.sh_degree!r}")
    integer(f"{where}: init_points", recipe.init_points, low=1)
    require(recipe.init_points < 2**31, f"{where}: init_points must be at most 2^31 - 1, got {recipe.init_points}")
    for name in ("exposure", "photometry", "poses", "intrinsics"):
        if (settings := getattr(recipe, name)) is not None:
            settings.check(f"{where}: {name}")
    if recipe.poses is not None:
        learns = any(stage.moves_all for stage in recipe.stages)
        require(learns, f"{where}: poses learn while the means of all splats do, and no stage trains those")
    if recipe.intrinsics is not None:
        require(recipe.poses is not None, f"{where}: intrinsics learn with poses, got poses=null; set both or neither")
        fixed = "views are compared by the intrinsics that the capture says"
        require(recipe.multiview is None, f"{where}: intrinsics cannot learn with multiview: {fixed}; leave one out")
    learned = [quantity.name for quantity in recipe.learned]
    for quantity in recipe.learned:
        name = quantity.name
        quantity.check(f"{where}: learned {name!r}")
        require(learned.count(name) == 1, f"{where}: learned {name!r} is there twice; leave one out")
        setting = "photometry" if name in ("vignetting", "response") else name
        require(name not in QUANTITIES.builtin, f"{where}: {name!r} must not be in learned; set {setting} instead")
    if recipe.multiview is not None:
        check_multiview(f"{where}: multiview", recipe.multiview)
    check_priors(where, recipe.depth_prior, recipe.normal_prior)
    if recipe.fused_depth is not None:
        one_of(f"{where}: fused_depth", recipe.fused_depth, DEPTH_KINDS)
    check_robust(where, recipe.dense_start, recipe.removal)
    names = [stage.name for stage in recipe.stages]
    for name in names:
        require(names.count(name) == 1, f"{where}: two stages are called {name!r}; give each its own name")
        require(
            name.replace("-", "_").isidentifier(), f"{where}: a stage name is letters, digits, '-', '_'; got {name!r}"
        )
    groups: list[str] = []
    for stage in recipe.stages:
        _check_stage(f"stage {stage.name!r}", stage, groups)
    return recipe


def _check_stage(where: str, stage: Stage, groups: list[str]) -> None:
    """Check one stage; ``groups`` are the row groups written so far, and is extended."""
    integer(f"{where}: iterations", stage.iterations, low=0)
    integer(f"{where}: sh_interval", stage.sh_interval, low=0)
    one_of(f"{where}: moments", stage.moments, ("fresh", "kept"))
    integer(f"{where}: downscale", stage.downscale, low=1)
    for at in stage.halve_at:
        integer(f"{where}: halve_at", at, low=0)
        require(at <= stage.iterations, f"{where}: halve_at must lie in its {stage.iterations} iterations, got {at}")
    times = len(stage.halve_at)
    require(
        stage.downscale % (1 << times) == 0,
        f"{where}: downscale must be a multiple of {1 << times} to be halved {times} times, got {stage.downscale}",
    )
    for action in stage.on_enter:
        if isinstance(action, RankByError):
            percent = number(f"{where}: RankByError.top_percent", action.top_percent, low=0.0)
            require(0 < percent <= 100, f"{where}: RankByError.top_percent must be in (0, 100], got {percent}")
        else:
            one_of(f"{where}: CloneInPlace.opacity", action.opacity, ("copy", "preserve"))
            group(f"{where}: CloneInPlace.rows", action.rows, groups)
        require(action.writes not in ("", "all"), f"{where}: a row group cannot be called {action.writes!r}")
        groups.append(action.writes)
    for attribute, rows in stage.train.items():
        one_of(f"{where}: train", attribute, ALL)
        if rows != "all":
            group(f"{where}: train[{attribute!r}]", rows, groups)
    _check_losses(where, stage)
    for entry in fields(LearningRates):
        number(f"{where}: lr.{entry.name}", getattr(stage.lr, entry.name), low=0.0)
    require(
        stage.lr.means > 0 and stage.lr.means_final > 0 and stage.lr.eps > 0,
        f"{where}: lr.means, lr.means_final and lr.eps must be positive (to freeze, leave out of train)",
    )
    integer(f"{where}: lr.means_decay_steps", stage.lr.means_decay_steps, low=1)
    for name in ("beta1", "beta2"):
        value = getattr(stage.lr, name)
        require(value < 1, f"{where}: lr.{name} must be below 1, got {value}")
    for name in ("settle_start", "settle_steps"):
        integer(f"{where}: lr.{name}", getattr(stage.lr, name), low=0)
    require(stage.lr.settle_factor <= 1, f"{where}: lr.settle_factor must be at most 1, got {stage.lr.settle_factor}")
    if isinstance(stage.densify, GradDensify):
        _check_densify(f"{where}: densify", stage.densify, stage)


def _check_losses(where: str, stage: Stage) -> None:
    kinds = [term.kind for term in stage.losses]
    for term in stage.losses:
        require(kinds.count(term.kind) == 1, f"{where}: loss {term.kind!r} is there twice; add up the weights")
        if term.weight is not None:
            number(f"{where}: weight of loss {term.kind!r}", term.weight, low=0.0)
        integer(f"{where}: start of loss {term.kind!r}", term.start, low=0)
        if term.depth is not None:
            one_of(f"{where}: depth of loss {term.kind!r}", term.depth, DEPTH_KINDS)
        integer(f"{where}: every of loss {term.kind!r}", term.every, low=1)
    if stage.iterations > 0:
        active = [term for term in stage.losses if term.weight != 0 and term.start == 0 and term.every == 1]
        message = "no loss is active from the first iteration and in every one"
        require(bool(active), f"{where}: {message}: got {kinds or 'none'}")
        require(bool(stage.train), f"{where}: train names no attribute for {stage.iterations} iterations")


def _check_densify(where: str, densify: GradDensify, stage: Stage) -> None:
    for name in ("start", "stop", "reset_every", "prune_grace", "cap_every", "prune_until", "error_views"):
        integer(f"{where}.{name}", getattr(densify, name), low=0)
    integer(f"{where}.every", densify.every, low=1)
    integer(f"{where}.split_count", densify.split_count, low=2)
    for name in ("grad_threshold", "abs_threshold", "percent_dense", "opacity_cull", "scale_cull", "error_power"):
        number(f"{where}.{name}", getattr(densify, name), low=0.0)
    shrink = number(f"{where}.split_shrink", densify.split_shrink, low=0.0)
    require(shrink > 0, f"{where}.split_shrink must be positive, got {shrink}")
    for name in ("reset_opacity", "opacity_cap"):
        value = number(f"{where}.{name}", getattr(densify, name), low=0.0)
        require(0 < value < 1, f"{where}.{name} must be in (0, 1), got {value}")
    for name in ("reset_at", "reset_at_on_white"):
        for value in getattr(densify, name):
            integer(f"{where}.{name}", value, low=1)
    for name, low in (("last_reset", 0), ("scale_cull_start", 0), ("max_splats", 1)):
        if getattr(densify, name) is not None:
            integer(f"{where}.{name}", getattr(densify, name), low=low)
    require(
        densify.prune_until <= stage.iterations,
        f"{where}.prune_until must be at most the stage's {stage.iterations} iterations, got {densify.prune_until}",
    )
    resets = bool(densify.reset_at or densify.reset_at_on_white) or densify.reset_every > 0
    touches_opacity = resets or densify.cap_every > 0
    require(
        not touches_opacity or stage.train.get("opacity_logits") == "all",
        f"{where} resets or caps opacity, which the stage must then train for all rows; "
        "set reset_every and cap_every to 0 or train opacity_logits",
    )
