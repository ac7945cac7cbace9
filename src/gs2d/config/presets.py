"""The recipes for users; ``contrib/lab/paper_recipes.py`` has those of the other rows of the 2DGS-R paper.

Stage 1 is the official 2DGS training (hbb1/2d-gaussian-splatting); stages 2 and 3 are those of the paper. Settings that
depend on the data set belong to the protocol. Pure Python; never imports torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from gs2d.config.actions import CLONE_IN_PLACE, RANK_BY_ERROR
from gs2d.config.quantities import EXPOSURE, INTRINSICS, POSES
from gs2d.config.recipe import (
    ALL,
    ALPHA,
    SH,
    DenseStart,
    DepthPrior,
    GradDensify,
    LearningRates,
    LossTerm,
    NormalPrior,
    Recipe,
    Removal,
    Stage,
)
from gs2d.config.recipe_files import is_recipe_file, read_recipe_file, recipe_from
from gs2d.config.registry import Register, Registry, did_you_mean
from gs2d.config.schedule import LONGER
from gs2d.errors import RecipeError

PHOTOMETRIC = (LossTerm("l1", 0.8), LossTerm("ssim", 0.2))  # official: lambda_dssim = 0.2
SH_PATIENCE = 3  # factor of the iterations for each SH degree if exposures are learned
NC_START, DISTORTION_START = 7_000, 3_000  # official
DEPTH_WEIGHT, NORMAL_WEIGHT = 0.2, 0.05  # docs/notebook/priors.md
DEFAULT_RECIPE = "best"  # of `gs2d train`, `reconstruct` and `demo`
OFFICIAL_ITERATIONS = 30_000  # of 2DGS, which its rates are chosen for
BEST_ITERATIONS, FAST_ITERATIONS = 20_000, 6_600
SILHOUETTE = 0.1  # weight of the silhouette loss: docs/notebook/losses.md
# Weight of normal consistency in best, and in best without L2: docs/notebook/losses.md
BEST_NC, NC_WITHOUT_SQUARES = 0.035, 0.02
FLAT_FACTOR = 3.0  # of that weight where photographs have no texture: docs/notebook/best.md
SMOOTHNESS = 0.4  # weight of normal smoothness, which has no effect on texture: docs/notebook/best.md
SQUARES, SQUARES_START = 10.0, 0.5  # weight of L2 in best, and the fraction of iterations before it: the same page
SH_FASTER = 2.5  # factor of the official rate of SH beyond degree 0: docs/notebook/training.md
SETTLING, SETTLED = 0.3, 0.1  # last fraction of iterations in which rates fall, and final factor: training.md
DENSE_START = DenseStart(side=256, neighbours=3, fit=True)  # docs/notebook/training.md
# px; standard deviation of a pixel, a square of side 1 (0.29), rounded: docs/notebook/best.md
MIP_FILTER = 0.3
STREET_START = DenseStart(sphere=True, adjust=True)  # docs/notebook/floaters.md


def surface(nc: float = 0.05, distortion: float | None = 0.0, iterations: int = 30_000) -> Stage:
    """Return stage 1: the official 2DGS training. ``distortion`` None: weight of the protocol; 0 drops a term."""
    return Stage(
        "surface",
        iterations,
        losses=(*PHOTOMETRIC, *_normal_consistency(nc, NC_START), *_distortion(distortion, DISTORTION_START)),
        densify=GradDensify(),
        sh_interval=1_000,
    )


def appearance(k: float = 1.0) -> Stage:
    """Return stage 2: rank by E_i, then train only the SH of the worst ``k`` percent."""
    return Stage(
        "appearance",
        10_000,
        train=dict.fromkeys(SH, "high_error"),
        losses=PHOTOMETRIC,
        lr=rates_after_surface(),
        on_enter=(RANK_BY_ERROR.with_options(top_percent=k),),
    )


def refine(nc: float = 0.05, freeze: tuple[str, ...] = ALPHA, *, densify: GradDensify | None = None) -> Stage:
    """Return stage 3: clone the high-error splats in place, then train everything but ``freeze``, with NC.

    With ``densify``, AbsGS densifies instead of the clone.
    """
    return Stage(
        "refine",
        20_000,
        train={name: "all" for name in ALL if name not in freeze},
        losses=(*PHOTOMETRIC, *_normal_consistency(nc, 0)),
        lr=rates_after_surface(),
        densify=densify,
        on_enter=(CLONE_IN_PLACE,) if densify is None else (),
    )


def two_dgs(nc: float = 0.05, distortion: float | None = 0.0, *, name: str = "2dgs") -> Recipe:
    """Return plain 2DGS, 30k iterations."""
    return Recipe(name, (surface(nc, distortion),))


def two_dgs_r(*, name: str = "2dgs-r", stage_2: Stage | None = None, stage_3: Stage | None = None) -> Recipe:
    """Return 2DGS-R: surface 30k, appearance 10k, refine 20k."""
    return Recipe(name, (surface(), stage_2 or appearance(), stage_3 or refine()))


def without_squares(recipe: Recipe) -> Recipe:
    """Return ``best`` or a similar recipe without L2, and with the weight of normal consistency for that.

    Weights that differ from those of ``best`` do not change.
    """

    def lighter(term: LossTerm) -> LossTerm:
        return replace(term, weight=NC_WITHOUT_SQUARES) if _is(term, "normal_consistency", BEST_NC) else term

    def plain(stage: Stage) -> Stage:
        terms = tuple(term for term in stage.losses if not _is(term, "l2", SQUARES))
        return replace(stage, losses=tuple(map(lighter, terms))) if terms != stage.losses else stage

    return replace(recipe, stages=tuple(map(plain, recipe.stages)))


def _is(term: LossTerm, kind: str, weight: float) -> bool:
    return term.kind == kind and term.weight == weight


def with_exposure(recipe: Recipe) -> Recipe:
    """Return the recipe with a colour transform for each training image (``NAME-exposure``); itself if it has one.

    Not in the paper. For cameras with automatic exposure or white balance. View-dependent colour starts three times as
    late, because it can imitate exposures (docs/notebook/exposure.md).
    """
    if recipe.learns("exposure"):
        return recipe
    stages = (replace(stage, sh_interval=SH_PATIENCE * stage.sh_interval) for stage in recipe.stages)
    learning = recipe.with_learned(EXPOSURE)
    return replace(learning, name=f"{recipe.name}-exposure", stages=tuple(stages))


def with_depth_prior(recipe: Recipe, source: str = "auto", weight: float = DEPTH_WEIGHT) -> Recipe:
    """Return the recipe with a loss on known depths in the stages that train the means of all splats (``NAME-depth``).

    Not in the paper. For indoor rooms, walls without texture and few images (docs/guides/priors.md). A recipe that has
    the loss keeps it, with the requested source.
    """
    if recipe.depth_prior is not None:
        prior = recipe.depth_prior if source == "auto" else replace(recipe.depth_prior, source=source)
        return replace(recipe, depth_prior=prior)
    # The gradient of the mean depth reaches every splat of a pixel, that of the median depth only one.
    term = LossTerm("depth_prior", weight, depth="mean")
    return replace(_in_stages(recipe, term), name=f"{recipe.name}-depth", depth_prior=DepthPrior(source))


def with_normal_prior(recipe: Recipe, weight: float = NORMAL_WEIGHT) -> Recipe:
    """Return the recipe with a loss on known normals in the stages that train all means (``NAME-normals``).

    It starts with normal consistency: earlier, rotating splats does harm.
    """
    if recipe.normal_prior is not None:
        return recipe
    term = LossTerm("normal_prior", weight, NC_START)
    return replace(_in_stages(recipe, term), name=f"{recipe.name}-normals", normal_prior=NormalPrior())


def with_robustness(recipe: Recipe) -> Recipe:
    """Return the recipe with a dense start and the removal of floaters, unless it has its own.

    Not in the paper; for captures with sparse points and the images that show them (docs/notebook/floaters.md). An
    optional dense start is replaced by the one that was tuned with the removal. Without opacity resets, splats are not
    pruned by size, because that would remove sky and ground.
    """
    start = recipe.dense_start or STREET_START
    return replace(
        recipe,
        stages=tuple(map(_sparing_large_splats, recipe.stages)),
        dense_start=start if start.required else STREET_START,
        removal=recipe.removal or Removal(),
    )


def _sparing_large_splats(stage: Stage) -> Stage:
    densify = stage.densify
    if not isinstance(densify, GradDensify) or densify.reset_every or densify.scale_cull_start is not None:
        return stage
    return replace(stage, densify=replace(densify, scale_cull_start=stage.iterations))


def best(
    iterations: int = BEST_ITERATIONS, nc: float = BEST_NC, squares: float = SQUARES, *, name: str = "best"
) -> Recipe:
    """Return the recipe with the best images and surface for its time: 2DGS from a fitted dense start, in one stage.

    Not in the paper. A good start needs no opacity resets and fewer iterations, with larger rates. Large splats stay,
    because they represent the surroundings. A silhouette loss uses the alpha of the images, L2 is active after
    densification, and the mesh uses the transmittance depth (docs/notebook/best.md). ``nc`` is the weight of normal
    consistency, which is heavier where photographs have no texture; there normals are smooth, too. ``squares`` is the
    weight of L2 (0 leaves it out). View-dependent colours learn faster than in 2DGS, except with few images
    (:func:`with_few_views`).
    """
    part = iterations / OFFICIAL_ITERATIONS
    smooth = {"where": "object", "flat": FLAT_FACTOR}
    start_normals = round(NC_START * part)
    consistency = LossTerm("normal_consistency", nc, start_normals, options=smooth)
    smoothness = LossTerm("normal_smoothness", SMOOTHNESS, start_normals)
    silhouette = LossTerm("silhouette", SILHOUETTE, options={"required": False})
    l2 = (LossTerm("l2", squares, round(SQUARES_START * iterations)),) if squares > 0 else ()
    stage = Stage(
        "surface",
        iterations,
        losses=(*PHOTOMETRIC, *l2, consistency, smoothness, silhouette),
        lr=_best_rates(iterations),
        densify=GradDensify(
            start=round(500 * part), stop=round(15_000 * part), reset_every=0, scale_cull_start=iterations
        ),
        sh_interval=round(1_000 * part),
    )
    start = replace(DENSE_START, required=False, sphere=True, adjust=True)
    return Recipe(name, (stage,), dense_start=start, fused_depth="transmittance", mip_px=MIP_FILTER)


def _best_rates(iterations: int) -> LearningRates:
    """Return official rates, larger for fewer iterations, decaying at the end, and faster for SH beyond degree 0."""
    times = (iterations / OFFICIAL_ITERATIONS) ** -LONGER
    start = round((1 - SETTLING) * iterations)
    official = LearningRates(means_decay_steps=iterations)
    return replace(
        replace(official, shN=SH_FASTER * official.shN).times(times),
        stretch=LONGER,
        settle_start=start,
        settle_steps=iterations - start,
        settle_factor=SETTLED,
    )


def with_few_views(recipe: Recipe) -> Recipe:
    """Return the recipe for at most ``FEW_VIEWS`` training images: SH beyond degree 0 learn as in 2DGS, and no L2.

    With few images, faster SH and L2 overfit (docs/notebook/training.md, docs/notebook/losses.md). Rates and weights
    that differ from those of ``best`` do not change.
    """

    def slower(stage: Stage) -> Stage:
        official, lr = LearningRates(), stage.lr
        share = official.shN / official.sh0
        if not math.isclose(lr.shN, SH_FASTER * share * lr.sh0):
            return stage
        return replace(stage, lr=replace(lr, shN=share * lr.sh0))

    return without_squares(replace(recipe, stages=tuple(map(slower, recipe.stages))))


def _in_stages(recipe: Recipe, term: LossTerm) -> Recipe:
    """Add a loss to the stages that train the means of all splats; ``start`` applies to the first stage."""

    def extended(index: int, stage: Stage) -> Stage:
        added = term if index == 0 else replace(term, start=0)
        return replace(stage, losses=(*stage.losses, added)) if stage.moves_all else stage

    return replace(recipe, stages=tuple(extended(index, stage) for index, stage in enumerate(recipe.stages)))


def _normal_consistency(weight: float, start: int) -> tuple[LossTerm, ...]:
    return (LossTerm("normal_consistency", weight, start),) if weight > 0 else ()


def _distortion(weight: float | None, start: int) -> tuple[LossTerm, ...]:
    return (LossTerm("distortion", weight, start),) if weight is None or weight > 0 else ()


def rates_after_surface() -> LearningRates:
    """Return the constant rates at the end of stage 1."""
    return LearningRates().at_end(30_000)


def with_poses(recipe: Recipe) -> Recipe:
    """Return the recipe with a refined pose for each training image (``NAME-poses``); itself if it has them.

    Not in the paper. For cameras with errors of a pixel or more (docs/guides/poses.md).
    """
    if recipe.learns("poses"):
        return recipe
    return replace(recipe.with_learned(POSES), name=f"{recipe.name}-poses")


def with_intrinsics(recipe: Recipe) -> Recipe:
    """Return the recipe with refined poses and focal lengths (``NAME-cameras``); itself if it has them.

    Not in the paper. For focal lengths with errors of a few per mille to percent (docs/guides/poses.md).
    """
    if recipe.learns("intrinsics"):
        return recipe
    refined = with_poses(recipe).with_learned(INTRINSICS)
    return replace(refined, name=f"{recipe.name.removesuffix('-poses')}-cameras")


RECIPES: Registry[Any] = Registry(
    "recipe",
    "gs2d.recipes",
    builtin=dict.fromkeys(("best", "best-fast", "2dgs", "2dgs-r"), __name__),
    error=RecipeError,
)
"""Names of recipes -> a Recipe, or a function without arguments that returns one."""


def add_recipe(name: str, about: str, build: Callable[..., Recipe], *, module: str = __name__) -> None:
    """Register ``build(name=name)``; ``about`` is the line of ``gs2d recipes``."""
    recipe = partial(build, name=name)
    recipe.__doc__ = about
    RECIPES.register(name, module=module)(recipe)


add_recipe("best", "The default: 2DGS, dense start, most quality per time", best)
add_recipe("best-fast", "best in a third of its iterations", partial(best, FAST_ITERATIONS))
add_recipe("2dgs", "2DGS, the paper's baseline, and stage 1 of 2dgs-r", two_dgs)
add_recipe("2dgs-r", "2DGS-R: surface, worst 1 %, clone in place and refine", two_dgs_r)


def register_recipe(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a recipe, so that its name can be given to ``gs2d.train`` and ``--recipe``.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a function without arguments that returns a Recipe; the first line of its docstring is what
        ``gs2d recipes`` prints. A Recipe itself can be registered, too.

    Raises
    ------
    RecipeError
        From the decorator: the name is taken.

    Examples
    --------
    >>> import gs2d
    >>> @gs2d.register_recipe("2dgs-l2")
    ... def squared():
    ...     '''2DGS with a squared error.'''
    ...     return gs2d.get_recipe("2dgs").with_loss(gs2d.LossTerm("l2", 1.0))
    >>> gs2d.get_recipe("2dgs-l2").stages[0].losses[-1].kind
    'l2'
    """
    return RECIPES.register(name)


def about_recipe(name: str) -> str:
    """Return one line about a recipe: the first line of its docstring, or the stages."""
    entry = get_recipe(name) if is_recipe_file(name) else RECIPES.get(name)
    if isinstance(entry, Recipe):
        return ", ".join(f"{stage.name} ({stage.iterations:,})" for stage in entry.stages)
    return (getattr(entry, "__doc__", None) or "").strip().partition("\n")[0] or f"a recipe of {RECIPES.source(name)}"


def get_recipe(name: str) -> Recipe:
    """Return the recipe of a name, or of a file.

    Parameters
    ----------
    name : str
        A registered name, ``file.json`` (from ``gs2d recipes NAME --json``) or ``file.py:name`` (a Recipe, or a
        function without arguments that returns one).

    Returns
    -------
    Recipe

    Raises
    ------
    RecipeError
        If the name is unknown, or the file cannot be read or holds no recipe.
    """
    if is_recipe_file(name):
        return read_recipe_file(name)
    if name not in RECIPES:
        near = did_you_mean(name, list(RECIPES))
        raise RecipeError(f"no recipe {name!r}; `gs2d recipes --all` lists them{near}")
    return recipe_from(RECIPES.get(name), f"recipe {name!r}")


def list_recipes() -> tuple[str, ...]:
    """List the registered recipes.

    Returns
    -------
    tuple of str
        Names for :func:`get_recipe`, in the order of ``gs2d recipes``.
    """
    return tuple(RECIPES)
