"""What is trained, and on what: options and the capture become a recipe, a protocol, a scene and a backend."""

from __future__ import annotations

from dataclasses import replace

from gs2d.config.presets import (
    get_recipe,
    with_depth_prior,
    with_exposure,
    with_few_views,
    with_intrinsics,
    with_normal_prior,
    with_photometry,
    with_poses,
    with_robustness,
)
from gs2d.config.protocols import BLACK, Protocol, get_protocol
from gs2d.config.recipe import Recipe, validate
from gs2d.config.robust import FEW_VIEWS
from gs2d.config.schedule import fit_schedule, longer_steps, scale_schedule
from gs2d.config.serialize import apply_overrides
from gs2d.data import Scene, load_scene
from gs2d.data.subject_box import check_subject_box
from gs2d.errors import ProtocolError, RecipeError
from gs2d.losses.api import losses_of
from gs2d.pipeline.prepare.open_capture import OpenCapture, without_masked_points
from gs2d.pipeline.prepare.options import Training, TrainOptions
from gs2d.pipeline.prepare.photographs import HOW
from gs2d.pipeline.prepare.quality import quality_of
from gs2d.training.backdrop import find_backdrop
from gs2d.training.events import Notice, OnEvent
from gs2d.training.point_gains import point_gains
from gs2d.training.robust import check_free_space

MAX_VIEWS = 1_000_000
ROBUST = ("auto", "on", "off")
DIFFERS = 0.03  # standard deviation of the logarithm of gains from which photographs are said to differ in exposure


def recipe_of(recipe: str | Recipe) -> Recipe:
    """Return the recipe of a name, or the recipe itself."""
    value = get_recipe(recipe) if isinstance(recipe, str) else recipe
    if not isinstance(value, Recipe):
        raise RecipeError(f"recipe must be a name that `gs2d recipes` lists or a Recipe, got {type(value).__name__}")
    return value


def build_recipe(
    training: Training,
    *,
    seed: int = 0,
    schedule_scale: float = 1.0,
    iterations: int | None = None,
    robust: bool = False,
    exposure: bool = False,
) -> Recipe:
    """Return the recipe as it is trained: with what the options add, scaled, seeded, overridden and validated.

    Parameters
    ----------
    training : Training
    seed : int
    schedule_scale : float
        Fraction of the recipe's iterations.
    iterations : int, optional
        Total iterations, instead of ``schedule_scale``.
    robust, exposure : bool
        Whether training is robust, and learns exposures; the options may leave both to the capture.
    """
    value = recipe_of(training.recipe)
    value = with_exposure(value) if exposure else value
    if training.vignetting or training.response:
        value = with_photometry(value, vignetting=training.vignetting, response=training.response)
    value = with_poses(value) if training.refine_poses else value
    value = with_intrinsics(value) if training.refine_cameras else value
    value = with_depth_prior(value, training.depth_prior) if training.depth_prior is not None else value
    value = with_normal_prior(value) if training.normal_prior else value
    value = with_robustness(value) if robust else value
    if robust and value.exposure is not None:
        value = replace(value, exposure=replace(value.exposure, initial="points"))
    if iterations is not None and schedule_scale != 1:
        both = f"{iterations} and {schedule_scale}"
        raise RecipeError(f"iterations and schedule_scale both set the length of training, got {both}; give one")
    full = value.iterations
    value = scale_schedule(value, schedule_scale) if iterations is None else fit_schedule(value, iterations)
    value = longer_steps(value, schedule_scale if iterations is None else iterations / full) if robust else value
    value = apply_overrides(replace(value, seed=seed), training.overrides)
    for option, wanted, field in (
        ("--exposure", exposure, "exposure"),
        ("--refine-poses", training.refine_poses, "poses"),
        ("--refine-cameras", training.refine_cameras, "intrinsics"),
        ("--vignetting", training.vignetting, "photometry"),
        ("--response", training.response, "photometry"),
        ("--depth-prior", training.depth_prior is not None, "depth_prior"),
        ("--normal-prior", training.normal_prior, "normal_prior"),
    ):
        if wanted and getattr(value, field) is None:
            raise RecipeError(f"{option} and --set {field}=null contradict each other, got both; leave one out")
    losses_of(validate(value))  # which know their options
    return value


def check_options(options: TrainOptions) -> None:
    """Refuse options that mean nothing, before anything is read."""
    if options.robust not in ROBUST:
        raise RecipeError(f"--robust must be one of {', '.join(ROBUST)}, got {options.robust}")
    expected_recipe(options)
    check_execution(options)
    if options.test_every is not None and options.test_every not in (0, *range(2, MAX_VIEWS)):
        raise ProtocolError(
            f"--test-every must be 0 (all views train) or a whole number >= 2 (every n-th is a test view), got "
            f"{options.test_every}"
        )
    if isinstance(options.protocol, str) and options.protocol != "auto":
        get_protocol(options.protocol)


def check_execution(options: TrainOptions) -> None:
    """Refuse options that mean nothing, of those that do not choose the recipe and the protocol."""
    if options.init is not None and options.start_from is not None:
        raise RecipeError("--init starts from splats, --from takes finished stages of another run, got both; give one")
    if options.downscale is not None and options.downscale < 1:
        raise RecipeError(f"--downscale must be a whole number >= 1, got {options.downscale}")
    if options.checkpoint_every < 1:
        raise RecipeError(f"--checkpoint-every must be a whole number >= 1, got {options.checkpoint_every}")
    if not options.checkpoint_seconds > 0:
        raise RecipeError(f"--checkpoint-seconds must be a positive number, got {options.checkpoint_seconds}")
    if options.stage2_cache_mb < 0:
        raise RecipeError(f"--stage2-cache-mb must be a whole number >= 0, got {options.stage2_cache_mb}")
    if options.prepare not in HOW:
        raise RecipeError(f"--prepare must be one of {', '.join(HOW)}, got {options.prepare}")
    if options.disk is not None and not options.disk > 0:
        raise RecipeError(f"--disk must be a positive number of GiB, got {options.disk}")
    check_subject_box(options.subject_box, {"--scene": options.whole_scene})


def expected_recipe(options: TrainOptions) -> Recipe:
    """Return the recipe that options ask for, as far as it is known before the capture is read."""
    robust, exposure = options.robust != "off", bool(options.learns_exposure)
    scale = schedule_scale_of(options)
    return build_recipe(options, seed=options.seed, schedule_scale=scale, robust=robust, exposure=exposure)


def schedule_scale_of(options: TrainOptions) -> float:
    """Return the fraction of the schedule that is trained: the given one, or that of the quality."""
    if options.quality is None:
        return 1.0 if options.schedule_scale is None else options.schedule_scale
    quality = quality_of(options.quality, options.backend)
    scale = options.schedule_scale
    return quality.schedule_scale(recipe_of(options.recipe)) if scale is None else scale


def by_quality(options: TrainOptions, on_event: OnEvent) -> TrainOptions:
    """Return options with the schedule and the image size of their quality; a given schedule or size stays."""
    if options.quality is None:
        return options
    cameras = [view.camera for view in load_scene(options.scene, format=options.format, test_every=0).views]
    scale, downscale = schedule_scale_of(options), options.downscale
    downscale = downscale or quality_of(options.quality, options.backend).downscale(cameras)
    iterations = expected_recipe(options).iterations
    shown = max(cameras, key=lambda camera: max(camera.width, camera.height)).downscaled(downscale)
    line = (
        f"quality {options.quality}: {iterations:,} iterations (--schedule-scale {scale:g}) "
        f"on pictures of {shown.width}x{shown.height} (--downscale {downscale})"
    )
    on_event(Notice(line, detail=True))
    return replace(options, schedule_scale=scale, downscale=downscale)


def resolve(
    training: Training,
    capture: OpenCapture,
    on_event: OnEvent,
    *,
    seed: int = 0,
    schedule_scale: float = 1.0,
    iterations: int | None = None,
) -> tuple[Recipe, OpenCapture]:
    """Return the recipe and the capture that are trained; every command decides them here.

    Parameters
    ----------
    training : Training
    capture : OpenCapture
    on_event : callable
        Hears what was decided.
    seed, schedule_scale, iterations
        As for :func:`build_recipe`.
    """
    scene = without_masked_points(capture.scene, capture.protocol, on_event)
    robust, exposure = robust_and_exposure(training, scene, capture.protocol, on_event)
    recipe = build_recipe(
        training, seed=seed, schedule_scale=schedule_scale, iterations=iterations, robust=robust, exposure=exposure
    )
    check_free_space(scene, recipe)
    recipe, protocol = with_backdrop(recipe, capture.protocol, scene, on_event)
    if len(scene.train) <= FEW_VIEWS and (slower := with_few_views(recipe)) != recipe:
        recipe = slower
        few = f"{len(scene.train)} training photographs"
        on_event(Notice(f"{few}: SH beyond degree 0 learn as in 2DGS, not faster, and L2 is left out", detail=True))
    return recipe, replace(capture, scene=scene, protocol=with_fused_depth(protocol, recipe))


def robust_and_exposure(training: Training, scene: Scene, protocol: Protocol, on_event: OnEvent) -> tuple[bool, bool]:
    """Return whether this capture is trained robustly, and with exposures, and say what was decided.

    Where ``training.robust`` is "auto" it is robust under a protocol that says so, if the capture has sparse points
    that its photographs show; where ``training.learns_exposure`` is None, exposures are learned if those points say
    that the photographs differ.
    """
    robust = training.robust == "on" or (training.robust == "auto" and protocol.robust)
    lacks = scene.unobserved() if robust else ""
    if lacks and scene.observed() is not None:
        on_event(Notice(f"sparse points are projected into the images: {lacks}"))
    elif lacks and training.robust == "auto":
        robust = False
        own = recipe_of(training.recipe).dense_start is not None
        what = "no known free space" if own else "no dense start and no known free space"
        on_event(Notice(f"{what}: {lacks}"))
    exposure = bool(training.learns_exposure)
    if robust and training.learns_exposure is None and (found := point_gains(scene)) is not None:
        exposure = found.spread >= DIFFERS
        least, most = found.gains.mean(axis=1).min(), found.gains.mean(axis=1).max()
        what = "learned for each" if exposure else "taken to be one (--exposure learns them)"
        on_event(
            Notice(f"exposures of the photographs: {least:.2f} to {most:.2f} times their mean; {what}", detail=True)
        )
    if training.response and len({view.file_intrinsics() for view in scene.train}) == 1:
        on_event(Notice("--response learns by what cameras differ: of one camera, as here, it learns nothing"))
    faces = sum(view.is_face for view in scene.train)
    if faces and (training.refine_cameras or training.vignetting):
        both = (("lenses", training.refine_cameras), ("vignetting", training.vignetting))
        what = " and ".join(name for name, wanted in both if wanted)
        on_event(Notice(f"{faces} faces of panoramas or fisheyes: of their {what} nothing is learned"))
    return robust, exposure


def with_backdrop(recipe: Recipe, protocol: Protocol, scene: Scene, on_event: OnEvent) -> tuple[Recipe, Protocol]:
    """Put the colour of sky and bare walls behind everything, where floaters are removed.

    Before an even, unlit backdrop, splats of its colour are proposed for removal.
    """
    found = find_backdrop(scene) if recipe.removal is not None and protocol.background == BLACK else None
    if found is None or recipe.removal is None:
        return recipe, protocol
    shown = ", ".join(f"{value:.2f}" for value in found.color)
    if found.is_unlit:
        recipe = replace(recipe, removal=replace(recipe.removal, backdrop=True))
    also = "; splats of that colour are removed where no image misses them" if found.is_unlit else ""
    on_event(Notice(f"background ({shown}): the colour of what shows no sparse points{also}", detail=True))
    return recipe, replace(protocol, background=found.color)


def with_fused_depth(protocol: Protocol, recipe: Recipe) -> Protocol:
    """Return the protocol that fuses the depth which the recipe says, where it says one."""
    depth = recipe.fused_depth
    return protocol if depth is None else replace(protocol, fusion=replace(protocol.fusion, depth=depth))
