"""Recipes: training methods as values, with stages, losses, learning rates and densification.

Every ablation of the paper is a :class:`Recipe` (``config/presets.py``). Iterations are counted from 1 within a stage;
``start`` fields mean "active when iteration > start", as in the official 2DGS code. ``config.serialize`` writes and
reads recipes and applies ``--set``; ``config.schedule`` scales them. This module never imports torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

from gs2d.config.actions import Action
from gs2d.config.densify import Densify
from gs2d.config.loss_registry import LOSSES
from gs2d.config.quantities import QUANTITIES, Quantity
from gs2d.config.validate import group, integer, number, one_of, require

MU, SIGMA, ALPHA, SH = ("means",), ("quats", "log_scales"), ("opacity_logits",), ("sh0", "shN")
ALL = MU + SIGMA + ALPHA + SH
LARGEST_SEED = 2**63 - 1  # the largest of torch
DEPTH_KINDS = ("mean", "median", "transmittance")
SOURCES = ("auto", "sparse", "sensor", "relative")  # of known depths
SPACES = ("auto", "disparity", "depth")
ALIGNMENTS = ("points", "rendered")
AXES = ("auto", "opencv", "opengl")
FEW_VIEWS = 24  # training images, or fewer, that training would overfit without dropout
MAX_ANGLE = 35.0  # degrees between the viewing directions of images that a dense start compares


@dataclass(frozen=True)
class LossTerm:
    """A loss of a stage: ``weight * LOSSES[kind]``, in each iteration > start.

    Attributes
    ----------
    kind : str
        "l1", "ssim" (1 - SSIM), "l2" (mean squared difference), "normal_consistency", "normal_consistency_per_splat"
        (the paper's Eq. 7), "normal_smoothness" (where images have no texture), "distortion" or "silhouette" (alpha
        compared with that of the images). In recipes with
        ``depth_prior``: "depth_prior" (relative error of depth); with ``normal_prior``: "normal_prior" (1 - cosine).
        Or a registered loss (docs/extending.md).
    weight : float or None
        None: the weight of the protocol (Table 1 of the paper: 100/10 for "distortion").
    start : int
        Iterations of the stage without this term.
    depth : "mean", "median", "transmittance" or None
        Depth that the loss uses; None: that of the protocol.
    options : mapping of str to values of JSON
        Keyword arguments of the loss, checked before training: ``edges`` and ``where`` of both normal consistencies,
        ``required`` of "silhouette" (``gs2d.losses.view_terms``).

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

    def __post_init__(self) -> None:
        LOSSES.check(self.kind)

    def is_active(self, iteration: int) -> bool:
        """Return whether the loss is active in an iteration (from 1) of the stage."""
        return iteration > self.start


@dataclass(frozen=True)
class LearningRates:
    """Learning rates and constants of Adam; the defaults are those of the official 2DGS code.

    The rate of the means decays log-linearly from ``means`` to ``means_final`` over ``means_decay_steps`` iterations of
    the stage. Both are multiplied by the extent of the scene. With ``stretch``, a schedule ``f`` < 1 times as long has
    all rates times ``f ** -stretch``, because the size of Adam's steps does not depend on the gradients: with fewer
    steps, each must be longer. 0 keeps the rates.

    ``view_power`` is for steps that several processes share: a step on the mean gradient of B views has all rates
    times ``B ** view_power``. Grendel (Zhao et al., ICLR 2025) uses 1/2; 0 keeps the rates.

    The other rates are constant up to ``settle_start``, then fall linearly to ``settle_factor`` of their value over
    ``settle_steps`` iterations. A splat learns from one view at a time, and with constant rates it would keep moving
    between the optima of its views. 0 steps: constant, as in the official code.
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
        """Return the factor of all rates but that of the means at an iteration (1-based)."""
        if self.settle_steps == 0:
            return 1.0
        t = min(max((iteration - self.settle_start) / self.settle_steps, 0.0), 1.0)
        return 1.0 - t * (1.0 - self.settle_factor)

    def means_at(self, iteration: int) -> float:
        """Return the rate of the means at an iteration (1-based), without the extent."""
        t = min(max(iteration / self.means_decay_steps, 0.0), 1.0)
        return math.exp((1.0 - t) * math.log(self.means) + t * math.log(self.means_final))

    def times(self, factor: float) -> LearningRates:
        """Return the rates, all multiplied by a factor."""
        names = ("means", "means_final", "quats", "log_scales", "opacity_logits", "sh0", "shN")
        return replace(self, **{name: getattr(self, name) * factor for name in names})

    def for_views(self, views: int) -> LearningRates:
        """Return the rates for steps on the mean gradient of several views, by the rule of Grendel (ICLR 2025).

        The gradients of views are nearly independent, so one step should replace the steps of all views. The second
        moment of the mean of B gradients is smaller by 1/B, and Adam divides by its root. So rates are multiplied by
        ``B ** view_power``, eps / sqrt(B). Both betas are raised to the power of B, so that the memory covers as many
        views.
        """
        if views == 1:
            return self
        beta1, beta2, eps = self.beta1**views, self.beta2**views, self.eps / math.sqrt(views)
        return replace(self.times(views**self.view_power), beta1=beta1, beta2=beta2, eps=eps)

    def at_end(self, iterations: int) -> LearningRates:
        """Return constant rates, equal to these rates after ``iterations``."""
        means = self.means_final if iterations >= self.means_decay_steps else self.means_at(iterations)
        settled = self.times(self.settled_at(iterations))
        return replace(settled, means=means, means_final=means, settle_start=0, settle_steps=0, settle_factor=0.0)


@dataclass(frozen=True)
class GradDensify:
    """Densification by screen gradients: clone, split, prune and reset opacity (official 2DGS, and AbsGS by values)."""

    grad_threshold: float = 2e-4  # mean signed screen gradient above which small splats are cloned and large ones split
    # every, start, stop: splats are densified if start < iteration < stop and iteration % every == 0. Statistics are
    # gathered until ``stop``.
    every: int = 100
    start: int = 500
    stop: int = 15_000
    absolute: bool = False  # whether splits use absolute gradients (AbsGS)
    # With ``absolute``: threshold of the absolute gradient for splits. Clones still use the signed gradient.
    abs_threshold: float = 4e-4
    percent_dense: float = 0.01  # splats with max scale <= percent_dense * extent are cloned, larger ones split
    opacity_cull: float = 0.05  # splats of lower opacity are pruned
    reset_every: int = 3_000  # iterations between opacity resets, before ``stop``; 0 = no resets
    # With ``reset_every``, also reset at iteration ``start`` if the background is white, as in the official code.
    reset_at_start_on_white: bool = True
    last_reset: int | None = None  # no reset after this iteration; None = any before ``stop``
    prune_grace: int = 0  # iterations after a reset in which no splat is pruned by opacity (0 in the official code)
    cap_every: int = 0  # iterations between caps of the opacity, as in AbsGS; 0 = no caps
    # No densification exceeds this count. If more splats qualify, those with the largest ratio of signal to threshold
    # win. None = no limit.
    max_splats: int | None = None
    # Large splats are pruned after this iteration; None = ``reset_every``, as in the official code.
    scale_cull_start: int | None = None

    def resets(self, iteration: int, *, white: bool) -> bool:
        """Return whether opacity is reset at the end of an iteration."""
        if iteration >= self.stop or (self.last_reset is not None and iteration > self.last_reset):
            return False
        if self.reset_every == 0:
            return False
        at_start = white and self.reset_at_start_on_white and iteration == self.start
        return iteration % self.reset_every == 0 or at_start

    def densifies(self, iteration: int) -> bool:
        """Return whether splats are cloned, split and pruned at the end of an iteration."""
        return self.start < iteration < self.stop and iteration % self.every == 0

    def culls_scale(self, iteration: int) -> bool:
        """Return whether a prune at the end of an iteration includes large splats."""
        return iteration > (self.reset_every if self.scale_cull_start is None else self.scale_cull_start)

    def in_prune_grace(self, iteration: int, *, white: bool) -> bool:
        """Return whether faint splats are kept because of a reset within the last ``prune_grace`` iterations."""
        first = max(1, iteration - self.prune_grace)
        return any(self.resets(earlier, white=white) for earlier in range(first, iteration))


@dataclass(frozen=True)
class Stage:
    """A part of training with one set of trained attributes and losses.

    Attributes
    ----------
    name : str
    iterations : int
    train : mapping of attribute name to "all" or a row group
        Missing attributes are frozen: they do not change in the stage.
    losses : tuple of LossTerm
    lr : LearningRates
    densify : GradDensify, Densify or None
    on_enter : tuple of Action
        Run once, in order, before the first iteration.
    sh_interval : int
        Iterations after which the SH degree, 0 at first, rises by one; 0 = full degree from the start.
    moments : "fresh" or "kept"
        Adam moments when the stage begins.
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "train", MappingProxyType(dict(self.train)))

    @property
    def moves_all(self) -> bool:
        """Whether the means of all splats are trained."""
        return self.train.get("means") == "all"

    def active_sh_degree(self, iteration: int, max_degree: int) -> int:
        """Return the SH degree that is trained at an iteration (1-based)."""
        return max_degree if self.sh_interval == 0 else min(max_degree, iteration // self.sh_interval)


@dataclass(frozen=True)
class DepthPrior:
    """Source of known depths, and how much they count (``losses/priors.py``, ``losses/prior_formulas.py``)."""

    # "sparse": sparse points of the capture; "sensor": depth maps in units of the capture times a factor; "relative":
    # depth maps with an unknown scale and shift for each view; "auto": sensor maps, relative maps or sparse points,
    # whichever the capture has first
    source: str = "auto"
    # final_factor, decay_steps: the weight of the loss decays log-linearly to this fraction over ``decay_steps``
    # iterations of the run, because the images are more accurate in the end
    final_factor: float = 0.01
    decay_steps: int = 30_000
    min_track: int = 3  # smallest number of images of a sparse point
    max_error: float = 2.0  # px; largest mean reprojection error of a sparse point
    # World units of a value of 1 in a sensor map. None: the unit that fits the sparse points (the scale of COLMAP is
    # arbitrary); without points that of the capture, 0.001 for integers, or 1.
    unit: float | None = None
    # Quantity that relative maps are linear in: "disparity" (1 / depth) or "depth"; "auto": the one that fits the
    # sparse points better.
    space: str = "auto"
    # Scale and shift of a relative map are fitted to its sparse "points", or to the rendered depth if there are too
    # few; "rendered": always to the rendered depth, in each iteration.
    align: str = "points"
    start: bool = True  # whether training also starts from points on the maps, as many as the recipe's ``init_points``

    def weight_at(self, iteration: int) -> float:
        """Return the factor of the weight at an iteration of the run (1-based)."""
        return _decayed(self.final_factor, iteration / self.decay_steps)


@dataclass(frozen=True)
class NormalPrior:
    """Settings of the loss on known normals."""

    # Axes of the maps in the camera frame: "opencv" (x right, y down, z forward), "opengl" (x right, y up, z back) or
    # "auto", those in which normals face the camera.
    axes: str = "auto"
    # final_factor, decay_steps: see :class:`DepthPrior`
    final_factor: float = 0.01
    decay_steps: int = 30_000

    def weight_at(self, iteration: int) -> float:
        """Return the factor of the weight at an iteration of the run (1-based)."""
        return _decayed(self.final_factor, iteration / self.decay_steps)


def _decayed(final_factor: float, fraction: float) -> float:
    """Return a factor that falls log-linearly from 1 to ``final_factor`` for fractions in [0, 1]."""
    return math.exp(min(max(fraction, 0.0), 1.0) * math.log(final_factor))


@dataclass(frozen=True)
class DenseStart:
    """Start from points of a plane sweep over neighbouring images (``training/start/plane_sweep.py``).

    Sparse points of the capture give the depth range. Without any, the scene bounds do, inside the silhouettes of
    images with an alpha channel (``training/start/sweep_range.py``).
    """

    side: int = 200  # px; images are downscaled by a whole factor until their longer side is about this
    # Images that each image is compared with. The best two count, so that a point may be hidden from the others.
    neighbours: int = 4
    min_angle: float = 2.0  # degrees; smallest angle between the viewing directions of neighbours
    cell: float = 3.0  # px; one splat starts in each cell of this many pixels of the downscaled images
    # Whether colour, opacity and size of the splats are fitted to the images (``training/start/start_fit.py``).
    # Otherwise they start as splats of sparse points do.
    fit: bool = False
    required: bool = True  # whether training stops if no depths agree. Otherwise it reports that and starts without.
    # Whether splats on a sphere around the scene are added (``training/start/background_sphere.py``).
    sphere: bool = False
    # Whether the training cameras are adjusted to the photographs first, if those show that the cameras are off
    # (``training/start/camera_adjustment.py``).
    adjust: bool = False


@dataclass(frozen=True)
class Removal:
    """Remove floaters: splats that something speaks against and that the training images do not miss.

    Depth maps, sizes and colours only propose splats; the training images decide (``training/robust/trial.py``). In the
    same iterations, large splats on surfaces of known depth shrink (docs/notebook/floaters.md).
    """

    every: int = 50  # iterations between proposals, and from the start to the first
    # Fraction of its opacity that a splat loses every ten iterations, in stages that train the opacity of all splats.
    # Splats that several images need recover at once; floaters that only one image supports do not.
    decay: float = 0.01
    # Fraction of the splats that each iteration leaves out at random, with at most ``FEW_VIEWS`` training images. With
    # more, dropout gains on some captures and loses on others.
    dropout: float = 0.1
    # Also propose splats in the colour of the background. Set for captures in front of an even, unlit backdrop, where
    # such splats change no training image and hide what new views should show.
    backdrop: bool = False


@dataclass(frozen=True)
class Recipe:
    """A training method: stages in order, and settings for all of them.

    Attributes
    ----------
    name : str
    stages : tuple of Stage
    seed : int
        Seed of all random choices.
    sh_degree : int
        Highest SH degree of the splats, 0 to 3.
    init_points : int
        Number of random points that training starts from if the scene has no sparse points.
    learned : tuple of Quantity
        Quantities of images and cameras that are learned with the splats, each at most once.
    depth_prior, normal_prior : DepthPrior, NormalPrior or None
        Settings of the losses on known depths and normals.
    dense_start : DenseStart or None
        Starts from a plane sweep of the images.
    removal : Removal or None
        Removes floaters.
    fused_depth : "mean", "median", "transmittance" or None
        Depth that is fused into the mesh; None: that of the protocol.
    mip_px : float
        px. Standard deviation of the object-space Mip filter; 0: the low-pass filter of 2DGS.

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
    learned: tuple[Quantity, ...] = ()
    depth_prior: DepthPrior | None = None
    normal_prior: NormalPrior | None = None
    dense_start: DenseStart | None = None
    removal: Removal | None = None
    fused_depth: str | None = None
    mip_px: float = 0.0

    @property
    def quantities(self) -> dict[str, Quantity]:
        """The learned quantities by name, in the order in which they are applied: that of the registry."""
        order = (*QUANTITIES.builtin, *(quantity.name for quantity in self.learned))
        return {quantity.name: quantity for quantity in sorted(self.learned, key=lambda q: order.index(q.name))}

    def learns(self, *names: str) -> bool:
        """Whether any of these quantities is learned."""
        return not self.quantities.keys().isdisjoint(names)

    @property
    def moves_cameras(self) -> bool:
        """Whether training cameras may end at other poses than the capture has."""
        return self.learns("poses") or (self.dense_start is not None and self.dense_start.adjust)

    def with_learned(self, *quantities: Quantity) -> Recipe:
        """Return a recipe that learns these quantities, in place of those of the same names."""
        named = {quantity.name: quantity for quantity in (*self.learned, *quantities)}
        return replace(self, learned=tuple(named.values()))

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
    """Check that a recipe can be trained, and return it.

    The RecipeError names the stage, the value and what was expected.
    """
    where = f"recipe {recipe.name!r}"
    require(bool(recipe.stages), f"{where}: expected at least one stage, got none")
    require(recipe.name != "", "a recipe must have a name, got an empty one")
    integer(f"{where}: seed", recipe.seed, low=0)
    require(recipe.seed <= LARGEST_SEED, f"{where}: seed must be at most 2^63 - 1, got {recipe.seed}")
    require(recipe.sh_degree in (0, 1, 2, 3), f"{where}: sh_degree must be 0, 1, 2 or 3, got {recipe.sh_degree!r}")
    integer(f"{where}: init_points", recipe.init_points, low=1)
    require(recipe.init_points < 2**31, f"{where}: init_points must be at most 2^31 - 1, got {recipe.init_points}")
    learned = [quantity.name for quantity in recipe.learned]
    for quantity in recipe.learned:
        quantity.check(f"{where}: learned.{quantity.name}")
        require(learned.count(quantity.name) == 1, f"{where}: learned {quantity.name!r} is there twice; remove one")
    if "poses" in learned:
        moves = any(stage.moves_all for stage in recipe.stages)
        require(moves, f"{where}: poses need a stage that trains the means of all splats, got none")
    if "intrinsics" in learned:
        require("poses" in learned, f"{where}: intrinsics need poses in learned, got none; add them")
    _check_priors(where, recipe.depth_prior, recipe.normal_prior)
    if recipe.fused_depth is not None:
        one_of(f"{where}: fused_depth", recipe.fused_depth, DEPTH_KINDS)
    number(f"{where}: mip_px", recipe.mip_px, low=0.0)
    _check_robust(where, recipe.dense_start, recipe.removal)
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


def _check_priors(where: str, depth: DepthPrior | None, normal: NormalPrior | None) -> None:
    """Raise RecipeError for an invalid value."""
    for name, value in (("depth_prior", depth), ("normal_prior", normal)):
        at = f"{where}: {name}"
        if value is None:
            continue
        fraction = number(f"{at}.final_factor", value.final_factor, low=0.0)
        require(0 < fraction <= 1, f"{at}.final_factor must be in (0, 1], got {fraction}")
        integer(f"{at}.decay_steps", value.decay_steps, low=1)
    if normal is not None:
        one_of(f"{where}: normal_prior.axes", normal.axes, AXES)
    if depth is None:
        return
    at = f"{where}: depth_prior"
    one_of(f"{at}.source", depth.source, SOURCES)
    one_of(f"{at}.space", depth.space, SPACES)
    one_of(f"{at}.align", depth.align, ALIGNMENTS)
    integer(f"{at}.min_track", depth.min_track, low=2)
    require(number(f"{at}.max_error", depth.max_error, low=0.0) > 0, f"{at}.max_error must be positive, got 0")
    if depth.unit is not None:
        require(number(f"{at}.unit", depth.unit, low=0.0) > 0, f"{at}.unit must be positive, got 0")


def _check_robust(where: str, start: DenseStart | None, removal: Removal | None) -> None:
    """Raise RecipeError for a value that cannot be trained with."""
    if removal is not None:
        integer(f"{where}: removal.every", removal.every, low=1)
        for name in ("decay", "dropout"):
            value = number(f"{where}: removal.{name}", getattr(removal, name), low=0.0)
            require(value < 1, f"{where}: removal.{name} must be below 1, got {value}: nothing would be drawn")
    if start is not None:
        at = f"{where}: dense_start"
        integer(f"{at}.side", start.side, low=16)
        integer(f"{at}.neighbours", start.neighbours, low=1)
        number(f"{at}.cell", start.cell, low=1.0)
        angle = number(f"{at}.min_angle", start.min_angle, low=0.0)
        require(angle < MAX_ANGLE, f"{at}.min_angle must be below {MAX_ANGLE:g} degrees, got {angle}")


def _check_stage(where: str, stage: Stage, groups: list[str]) -> None:
    """Check one stage; ``groups`` are the row groups that earlier actions write, and is extended."""
    integer(f"{where}: iterations", stage.iterations, low=0)
    integer(f"{where}: sh_interval", stage.sh_interval, low=0)
    one_of(f"{where}: moments", stage.moments, ("fresh", "kept"))
    for action in stage.on_enter:
        if "rows" in action.options:
            group(f"{where}: {action.name}.rows", action.options["rows"], groups)
        if (writes := action.writes) is not None:
            named = isinstance(writes, str) and writes not in ("", "all")
            require(named, f"{where}: a row group cannot be called {writes!r}")
            groups.append(writes)
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
    if stage.iterations > 0:
        active = [term for term in stage.losses if term.weight != 0 and term.start == 0]
        require(bool(active), f"{where}: no loss is active from the first iteration on: got {kinds or 'none'}")
        require(bool(stage.train), f"{where}: train names no attribute for {stage.iterations} iterations")


def _check_densify(where: str, densify: GradDensify, stage: Stage) -> None:
    for name in ("start", "stop", "reset_every", "prune_grace", "cap_every"):
        integer(f"{where}.{name}", getattr(densify, name), low=0)
    integer(f"{where}.every", densify.every, low=1)
    for name in ("grad_threshold", "abs_threshold", "percent_dense", "opacity_cull"):
        number(f"{where}.{name}", getattr(densify, name), low=0.0)
    for name, low in (("last_reset", 0), ("scale_cull_start", 0), ("max_splats", 1)):
        if getattr(densify, name) is not None:
            integer(f"{where}.{name}", getattr(densify, name), low=low)
    touches_opacity = densify.reset_every > 0 or densify.cap_every > 0
    require(
        not touches_opacity or stage.train.get("opacity_logits") == "all",
        f"{where} resets or caps opacity, which the stage must then train for all rows; "
        "set reset_every and cap_every to 0 or train opacity_logits",
    )
