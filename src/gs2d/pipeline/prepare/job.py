"""Before training: names become values, values are checked, the capture is read. Nothing is written here."""

from __future__ import annotations

import hashlib
import json
import shlex
import typing
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

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
from gs2d.config.serialize import apply_overrides, decode, from_json, to_json
from gs2d.core.splats import Splats
from gs2d.core.text import name_bytes
from gs2d.data import FORMATS, Scene, View
from gs2d.data.benchmarks import missing_lines
from gs2d.data.masks import EMPTY, Masks
from gs2d.data.subject import check_subject_box
from gs2d.errors import DataError, ProtocolError, RecipeError, RunError, ShapeError
from gs2d.io.formats.registry import read_surfels
from gs2d.io.run_dir import RUN_JSON, RunFolder, versions
from gs2d.losses.api import losses_of
from gs2d.pipeline.events import Notice, OnEvent, Phase, Step
from gs2d.pipeline.prepare.capture_masks import without_masked_points
from gs2d.pipeline.prepare.opened import SHOWN_SKIPS, Opened, open_capture, read_scene
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.prepare.part import LoadedPart, load_part, part_scene
from gs2d.pipeline.prepare.photographs import HOW, already_prepared, with_prepared
from gs2d.pipeline.prepare.run_photometry import with_found_photometries
from gs2d.pipeline.prepare.run_poses import with_found_poses
from gs2d.pipeline.prepare.view_priors import with_priors
from gs2d.render.api import check_settings
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings
from gs2d.training.backdrop import find_backdrop
from gs2d.training.cached_objective import is_cacheable
from gs2d.training.initialize import usable_points
from gs2d.training.point_gains import point_gains
from gs2d.training.robust import check_free_space
from gs2d.training.trainer import raster_settings

DECODE_THREADS = 2
MAX_VIEWS = 1_000_000
NEAR_SAMPLES = 2000  # sparse points by which the near plane is checked
ROBUST = ("auto", "on", "off")
DIFFERS = 0.03  # standard deviation of the logarithm of gains from which photographs are said to differ in exposure


@dataclass(frozen=True)
class Job:
    """Everything that defines a run, ready to train.

    Attributes
    ----------
    recipe, protocol, scene, backend, settings
        Values, not names.
    downscale : int
    images_digest : str
        Of every decoded photograph, mask and camera, and of the points: the scene as training sees it.
    stage2_cache_bytes : int
        For cached views; see ``Trainer``.
    init, init_digest : Splats and str, or None
        What training starts from instead of points, and the hash of its file.
    processes : int
        That train together.
    part : LoadedPart or None
        What a part of a larger training begins with and is surrounded by.
    """

    recipe: Recipe
    protocol: Protocol
    scene: Scene
    backend: Backend
    settings: RasterSettings
    downscale: int
    images_digest: str
    stage2_cache_bytes: int
    init: Splats | None = None
    init_digest: str | None = None
    processes: int = 1
    part: LoadedPart | None = None

    def definition(self) -> dict[str, Any]:
        """Return what ``run.json`` says and a resume compares."""
        return {
            "recipe": to_json(self.recipe),
            "protocol": asdict(self.protocol),
            "downscale": self.downscale,  # before the scene: it decides the photographs
            "scene": {
                "name": self.scene.name,
                "path": str(Path(self.scene.root or ".").resolve()),
                "format": self.scene.format,
                "train": len(self.scene.train),
                "test": len(self.scene.test),
                "extent": self.scene.extent,
                "skipped": list(self.scene.skipped),
                "digest": self.images_digest,
                **_masks_of(self.scene),
            },
            "raster": self.settings.facts(),
            "seed": self.recipe.seed,
            "backend": self.backend.facts(),
            "stage2_cache_bytes": self.stage2_cache_bytes,
            **({} if self.init_digest is None else {"init": self.init_digest}),
            **({} if self.part is None else {"part": self.part.digest}),
        }

    def stage_key(self, index: int, processes: Sequence[tuple[int, ...]] | None = None) -> str:
        """Hash of all that decides the state at the end of stage ``index``: equal keys, equal bytes.

        ``processes``: since which stage and iteration how many trained (``TrainState.processes``); by default those of
        the job, all the time.
        """
        recipe = to_json(self.recipe)
        if processes is None:
            processes = [(0, 0, self.processes)] if self.processes > 1 else []
        facts = {
            "scene": self.images_digest,
            "protocol": training_facts(asdict(self.protocol)),
            "raster": self.settings.facts(),
            "seed": self.recipe.seed,
            "backend": self.backend.facts(),
            "versions": {name: versions()[name] for name in ("2dgs-r", "torch")},
            "start": [recipe["init_points"], recipe["sh_degree"]],
            "stages": recipe["stages"][: index + 1],
            "stage2_cache_bytes": self.stage2_cache_bytes if self._uses_cached_views(index) else 0,
            **({} if self.init_digest is None else {"init": self.init_digest}),
            **({} if self.part is None else {"part": self.part.digest}),
            **({} if self.recipe.exposure is None else {"exposure": recipe["exposure"]}),
            **({} if self.recipe.poses is None else {"poses": recipe["poses"]}),
            **({} if not processes else {"processes": list(map(list, processes))}),
            **({} if self.recipe.intrinsics is None else {"intrinsics": recipe["intrinsics"]}),
            **({} if self.recipe.photometry is None else {"photometry": recipe["photometry"]}),
            **{
                name: recipe[name]
                for name in ("multiview", "depth_prior", "normal_prior", "dense_start", "removal")
                if recipe[name] is not None
            },
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def _uses_cached_views(self, index: int) -> bool:
        """Whether stage ``index`` or one before it can train from cached views."""
        views, stages = len(self.scene.train), self.recipe.stages[: index + 1]
        return any(is_cacheable(self.recipe, stage, backend=self.backend, views=views) for stage in stages)


def training_facts(protocol: dict[str, Any]) -> dict[str, Any]:
    """Return a protocol without what decides no byte of training: what is fused, and what the recipe says."""
    fusion = {name: value for name, value in protocol.get("fusion", {}).items() if name not in ("depth", "subject")}
    return {**{name: value for name, value in protocol.items() if name != "robust"}, "fusion": fusion}


class RenderedScene(typing.Protocol):
    """What of a Job, and of ``in_memory.Trained``, is asked for where splats are drawn from the scene's cameras."""

    @property
    def scene(self) -> Scene: ...
    @property
    def protocol(self) -> Protocol: ...
    @property
    def settings(self) -> RasterSettings: ...
    @property
    def backend(self) -> Backend: ...


def recipe_of(recipe: str | Recipe) -> Recipe:
    """Return the recipe of a name, or the recipe itself."""
    value = get_recipe(recipe) if isinstance(recipe, str) else recipe
    if not isinstance(value, Recipe):
        raise RecipeError(f"recipe must be a name that `gs2d recipes` lists or a Recipe, got {type(value).__name__}")
    return value


def build_recipe(
    recipe: str | Recipe,
    *,
    schedule_scale: float = 1.0,
    iterations: int | None = None,
    seed: int,
    overrides: tuple[str, ...],
    exposure: bool = False,
    poses: bool = False,
    intrinsics: bool = False,
    vignetting: bool = False,
    response: bool = False,
    depth_prior: str | None = None,
    normal_prior: bool = False,
    robust: bool = False,
    by_points: bool = False,
) -> Recipe:
    """Return the recipe as it will be trained: found, scaled, seeded, overridden, validated."""
    value = recipe_of(recipe)
    value = with_exposure(value) if exposure else value
    if vignetting or response:
        value = with_photometry(value, vignetting=vignetting, response=response)
    value = with_poses(value) if poses else value
    value = with_intrinsics(value) if intrinsics else value
    value = with_depth_prior(value, depth_prior) if depth_prior is not None else value
    value = with_normal_prior(value) if normal_prior else value
    value = with_robustness(value) if robust else value
    if by_points and value.exposure is not None:
        value = replace(value, exposure=replace(value.exposure, initial="points"))
    if iterations is not None and schedule_scale != 1:
        both = f"{iterations} and {schedule_scale}"
        raise RecipeError(f"iterations and schedule_scale both set the length of training, got {both}; give one")
    full = value.iterations
    value = scale_schedule(value, schedule_scale) if iterations is None else fit_schedule(value, iterations)
    value = longer_steps(value, schedule_scale if iterations is None else iterations / full) if robust else value
    value = apply_overrides(replace(value, seed=seed), overrides)
    for option, wanted, field in (
        ("--exposure", exposure, "exposure"),
        ("--refine-poses", poses, "poses"),
        ("--refine-cameras", intrinsics, "intrinsics"),
        ("--vignetting", vignetting, "photometry"),
        ("--response", response, "photometry"),
        ("--depth-prior", depth_prior is not None, "depth_prior"),
        ("--normal-prior", normal_prior, "normal_prior"),
    ):
        if wanted and getattr(value, field) is None:
            raise RecipeError(f"{option} and --set {field}=null contradict each other, got both; leave one out")
    losses_of(validate(value))  # which know their options
    return value


def check_train_options(options: TrainOptions) -> Recipe:
    """Return the recipe, if the options mean something; nothing is read."""
    if options.robust not in ROBUST:
        raise RecipeError(f"--robust must be one of {', '.join(ROBUST)}, got {options.robust}")
    recipe = _recipe_of(options, robust=options.robust != "off", exposure=bool(options.learns_exposure))
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
    if options.test_every is not None and options.test_every not in (0, *range(2, MAX_VIEWS)):
        raise ProtocolError(
            f"--test-every must be 0 (all views train) or a whole number >= 2 (every n-th is a test view), got "
            f"{options.test_every}"
        )
    if isinstance(options.protocol, str) and options.protocol != "auto":
        get_protocol(options.protocol)
    check_subject_box(options.subject_box, {"--scene": options.whole_scene})
    return recipe


def _recipe_of(options: TrainOptions, *, robust: bool, exposure: bool) -> Recipe:
    """Return the recipe of the options, made robust or not, with exposures or not."""
    return build_recipe(
        options.recipe,
        schedule_scale=options.schedule_scale,
        iterations=options.iterations,
        seed=options.seed,
        overrides=options.overrides,
        exposure=exposure,
        poses=options.refine_poses,
        intrinsics=options.refine_cameras,
        vignetting=options.vignetting,
        response=options.response,
        depth_prior=options.depth_prior,
        normal_prior=options.normal_prior,
        robust=robust,
        by_points=robust,
    )


def fit_recipe(options: TrainOptions, scene: Scene, protocol: Protocol, on_event: OnEvent) -> Recipe:
    """Return the recipe as this capture needs it, and say what was decided.

    Where ``options.robust`` is "auto" it is made robust under a protocol that says so, if the capture has sparse
    points that its photographs show; where ``options.learns_exposure`` is None, exposures are learned if those
    points say that the photographs differ.
    """
    robust = options.robust == "on" or (options.robust == "auto" and protocol.robust)
    lacks = scene.unobserved() if robust else ""
    if lacks and scene.observed() is not None:
        on_event(Notice(f"sparse points are projected into the images: {lacks}"))
    elif lacks and options.robust == "auto":
        robust = False
        own = recipe_of(options.recipe).dense_start is not None
        what = "no known free space" if own else "no dense start and no known free space"
        on_event(Notice(f"{what}: {lacks}"))
    exposure = bool(options.learns_exposure)
    if robust and options.learns_exposure is None and (found := point_gains(scene)) is not None:
        exposure = found.spread >= DIFFERS
        least, most = found.gains.mean(axis=1).min(), found.gains.mean(axis=1).max()
        what = "learned for each" if exposure else "taken to be one (--exposure learns them)"
        on_event(
            Notice(f"exposures of the photographs: {least:.2f} to {most:.2f} times their mean; {what}", detail=True)
        )
    if options.response and len({view.file_intrinsics() for view in scene.train}) == 1:
        on_event(Notice("--response learns by what cameras differ: of one camera, as here, it learns nothing"))
    faces = sum(view.is_face for view in scene.train)
    if faces and (options.refine_cameras or options.vignetting):
        what = " and ".join(
            name for name, wanted in (("lenses", options.refine_cameras), ("vignetting", options.vignetting)) if wanted
        )
        on_event(Notice(f"{faces} faces of panoramas or fisheyes: of their {what} nothing is learned"))
    return _recipe_of(options, robust=robust, exposure=exposure)


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


def prepare_job(options: TrainOptions, on_event: OnEvent) -> Job:
    """Check the options, cheapest first, then read the capture."""
    check_train_options(options)
    init = (None, None) if options.init is None else read_init(options.init, on_event)
    opened = open_capture(options, on_event)
    scene = opened.scene
    disk, home = None if options.disk is None else int(options.disk * 2**30), options.out
    if options.part is not None:
        scene, home = part_scene(scene, options.part), options.part.prepared or options.out
    scene = with_prepared(
        scene, home, options.prepare, on_event, disk=disk, threads=options.threads, shared=home != options.out
    )
    _say_some(missing_lines(options.scene), "pieces are missing", on_event)
    digest = scene_digest(scene, on_event, uses_masks=opened.protocol.use_mask_in_training)
    recipe, opened = resolve(options, replace(opened, scene=scene), on_event)
    scene, protocol, backend, downscale = opened.scene, opened.protocol, opened.backend, opened.downscale
    digest = with_priors(digest, scene, recipe, on_event)
    settings = raster_settings(protocol, scene.extent, recipe.sh_degree)
    if protocol.near is None:
        near = f"near plane at {settings.near:.4g}: 1 % of the scene's extent of {scene.extent:.4g}"
        on_event(Notice(near, detail=True))
    if (cut := near_cuts(scene, settings.near)) > 0.5:
        on_event(
            Notice(
                f"near plane at {settings.near:.4g} cuts away {cut:.0%} of the sparse points, and with them the scene: "
                f"check the camera positions with `gs2d info {shlex.quote(str(options.scene))}`, or use a --protocol "
                "with another near plane"
            )
        )
    cache_bytes = options.stage2_cache_mb << 20
    if options.part is not None and options.part.splats is not None:
        part = load_part(options.part, scene, recipe)
        return Job(recipe, protocol, scene, backend, settings, downscale, digest, cache_bytes, part=part)
    return Job(recipe, protocol, scene, backend, settings, downscale, digest, cache_bytes, *init)


def resolve(options: TrainOptions, opened: Opened, on_event: OnEvent) -> tuple[Recipe, Opened]:
    """Return what is trained, and on what, as the options and this capture decide: the same for every command."""
    scene = without_masked_points(opened.scene, opened.protocol, on_event)
    if options.part is not None:  # the whole training has decided
        recipe, protocol = validate(replace(recipe_of(options.recipe), seed=options.seed)), opened.protocol
    else:
        recipe, protocol = settled(options, scene, opened.protocol, on_event)
    return recipe, replace(opened, scene=scene, protocol=protocol)


def near_cuts(scene: Scene, near: float) -> float:
    """Return the fraction of the sparse points in front of the training cameras that ``near`` makes unusable."""
    if scene.points is None:
        return 0.0
    points = scene.points.points[:: max(1, len(scene.points) // NEAR_SAMPLES)]
    ahead = usable_points(points, scene, 0.0)
    return 1 - float(usable_points(points[ahead], scene, near).mean()) if ahead.any() else 0.0


def settled(options: TrainOptions, scene: Scene, protocol: Protocol, on_event: OnEvent) -> tuple[Recipe, Protocol]:
    """Return recipe and protocol as this capture is trained with."""
    recipe = fit_recipe(options, scene, protocol, on_event)
    check_free_space(scene, recipe)
    recipe, protocol = with_backdrop(recipe, protocol, scene, on_event)
    if len(scene.train) <= FEW_VIEWS and (slower := with_few_views(recipe)) != recipe:
        recipe = slower
        few = f"{len(scene.train)} training photographs"
        on_event(Notice(f"{few}: SH beyond degree 0 learn as in 2DGS, not faster, and L2 is left out", detail=True))
    return recipe, with_fused_depth(protocol, recipe)


def read_init(path: Path, on_event: OnEvent) -> tuple[Splats, str]:
    """Read the splats that training starts from, and the hash of their file.

    Raises
    ------
    DataError
        No file of splats.
    """
    if path.is_dir():
        inside = path / "splats.ply"
        hint = f"give {inside}" if inside.exists() else "give a file of splats"
        raise DataError(f"--init must be a file of splats, got the folder {path}; {hint}")
    splats, kind = read_surfels(path, lambda text: on_event(Notice(text)))
    on_event(Notice(f"starting from {path.name}: {len(splats):,} {kind}", detail=True))
    return splats, hashlib.sha256(path.read_bytes()).hexdigest()


def _masks_of(scene: Scene) -> dict[str, Any]:
    """Return what the user said about masks, for ``run.json``: nothing, mostly."""
    folder, masked = scene.masks.folder, scene.masks.masked
    if folder is None and masked is None:
        return {}
    return {"masks": {"folder": None if folder is None else str(folder.resolve()), "masked": masked}}


def _say_some(lines: Sequence[str], what: str, on_event: OnEvent) -> None:
    for line in lines[:SHOWN_SKIPS]:
        on_event(Notice(line))
    if len(lines) > SHOWN_SKIPS:
        on_event(Notice(f"... and {len(lines) - SHOWN_SKIPS} more {what}; `gs2d info` lists them"))


def scene_digest(scene: Scene, on_event: OnEvent, *, uses_masks: bool = False) -> str:
    """Decode every photograph once (a broken one stops the run here) and hash what training will see.

    Raises
    ------
    DataError
        A photograph does not decode; or masks are used, and leave nothing of any training view.
    """
    digest = hashlib.sha256()
    empty: list[View] = []
    train = set(map(id, scene.train))
    on_event(Phase("reading photographs", len(scene.views)))
    for done, view in enumerate(scene.preload(DECODE_THREADS), start=1):
        digest.update(name_bytes(f"{view.name} {'train' if id(view) in train else 'test'}"))
        mask = view.alpha() if scene.masks.masked == EMPTY else view.mask() if uses_masks else None
        empty += [view] if mask is not None and not mask.any() else []
        for array in _arrays(view):
            digest.update(f"{array.shape} {array.dtype}".encode())
            digest.update(np.ascontiguousarray(array).data)
        on_event(Step(done))
    if empty:
        what = f"the masks of {len(empty)} of {len(scene.views)} views leave no pixel, first {empty[0].name}"
        if set(map(id, empty)) >= train:
            raise DataError(f"{scene.root}: {what}; white = keep: are they inverted?")
        on_event(Notice(f"{what}: nothing is learned from them (white = keep)"))
    if scene.points is not None:
        digest.update(np.ascontiguousarray(scene.points.points).tobytes())
        if scene.points.colors is not None:
            digest.update(np.ascontiguousarray(scene.points.colors).tobytes())
    digest.update(np.float64(scene.extent).tobytes() + np.ascontiguousarray(scene.bounds, np.float64).tobytes())
    return digest.hexdigest()


def _arrays(view: View) -> Iterator[np.ndarray]:
    camera = view.camera
    yield np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    yield camera.T_cam_world
    yield view.image()
    for mask in (view.mask(), view.object_mask()):
        if mask is not None:
            yield mask


def reload_job(run: RunFolder, on_event: OnEvent, *, backend: str = "auto") -> Job:
    """Return the job of a run on disk, to mesh, render or score it again, with the cameras that it found.

    Raises
    ------
    RunError, DataError
        The capture has moved or changed.
    """
    data = run.definition()
    where = Path(data["scene"]["path"])
    if not where.exists():
        raise RunError(f"the capture of {run.path} was at {where}, which is not there; put it back or link it there")
    try:
        recipe, protocol = from_json(data["recipe"], to_train=False), protocol_from_json(data["protocol"])
        settings: RasterSettings = decode(data["raster"], RasterSettings, "raster")
        check_settings(settings)
        settings = settings.for_depths(protocol.depth, protocol.fused_depth)
        named, downscale, digest = data["backend"]["name"], data["downscale"], data["scene"]["digest"]
        cache_bytes = int(data["stage2_cache_bytes"])
        said = data["scene"].get("masks", {})
        masks = Masks(None if said.get("folder") is None else Path(said["folder"]), said.get("masked"))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecipeError, ShapeError) as error:
        raise RunError(
            f"{run.file(RUN_JSON)} must hold recipe, protocol, raster, backend, downscale and scene as gs2d writes "
            f"them, got another entry ({error}); restore it, or train again with --overwrite"
        ) from error
    scene = read_scene(where, data["scene"]["format"], downscale, protocol, on_event, masks)
    names = (len(scene.train), len(scene.test))
    if names != (data["scene"]["train"], data["scene"]["test"]):
        raise RunError(
            f"the capture at {where} has {names[0]} + {names[1]} views, the run was made with "
            f"{data['scene']['train']} + {data['scene']['test']}; restore it or train again"
        )
    scene = with_found_poses(run, recipe, already_prepared(scene, run.path))
    scene = with_found_photometries(run, recipe, scene)
    chosen = get_backend(named if backend == "auto" else backend)
    return Job(recipe, protocol, scene, chosen, settings, downscale, digest, cache_bytes)


def protocol_from_json(data: dict[str, Any]) -> Protocol:
    """Return the protocol that ``asdict`` and JSON made of one."""
    if not isinstance(data, dict) or not isinstance(data.get("fusion"), dict):
        raise RecipeError("protocol must be an object with its fusion, got something else")
    protocol: Protocol = decode(data, Protocol, "protocol")
    return protocol


__all__ = ["FORMATS", "Job", "build_recipe", "prepare_job", "reload_job"]
