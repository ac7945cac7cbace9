"""A run as a value, stored in ``run.json``, and with its capture in memory: from options, or from its folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.config.protocols import Protocol
from gs2d.config.quantities import QUANTITIES
from gs2d.config.recipe import Recipe, validate
from gs2d.config.registry import absent_guests
from gs2d.config.serialize import decode, encode
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.core.text import name_bytes
from gs2d.data import Scene, View
from gs2d.data.masks import EMPTY, Masks
from gs2d.errors import DataError, RecipeError, RunError, ShapeError
from gs2d.io import splat_ply
from gs2d.io.formats.splat_formats import read_surfels
from gs2d.io.run_dir import RUN_JSON, SPLATS, RunFolder, open_run, versions
from gs2d.losses.prior_formulas import NormalTarget
from gs2d.losses.priors import DepthPlan, Priors
from gs2d.pipeline.prepare.learned_views import with_learned_appearance, with_maps, with_refined_poses
from gs2d.pipeline.prepare.limits import use_threads
from gs2d.pipeline.prepare.open_capture import OpenCapture, capture_in_memory, open_capture, read_scene
from gs2d.pipeline.prepare.options import TrainOptions, values
from gs2d.pipeline.prepare.resolve import check_options, resolve, schedule_scale_of
from gs2d.render.api import check_settings, rasterize
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training.events import Notice, OnEvent, counted
from gs2d.training.trainer import TrainerOptions, raster_settings


@dataclass(frozen=True, kw_only=True)
class CaptureRecord:
    """The capture of a run."""

    name: str
    path: Path  # absolute
    format: str
    train: int  # number of training views
    test: int
    extent: float  # world units
    skipped: tuple[str, ...] = ()  # photographs that were skipped, with the reason
    masks: Masks = field(default_factory=Masks)
    digest: str = ""  # hash of all decoded images, masks, cameras, points and priors

    @classmethod
    def of(cls, scene: Scene, digest: str) -> CaptureRecord:
        """Return the record of a loaded capture."""
        folder = scene.masks.folder
        return cls(
            name=scene.name,
            path=Path(scene.root or ".").resolve(),
            format=scene.format,
            train=len(scene.train),
            test=len(scene.test),
            extent=scene.extent,
            skipped=tuple(scene.skipped),
            masks=replace(scene.masks, folder=None if folder is None else folder.resolve()),
            digest=digest,
        )


@dataclass(frozen=True, kw_only=True)
class Execution:
    """How a run is executed: the fields of ``TrainOptions`` that may differ when the run is resumed."""

    threads: int | None = None
    memory: float | None = None
    checkpoint_every: str = "2m"
    cache: Path | None = None
    page: bool = True
    viewer: int | None = None


@dataclass(frozen=True, kw_only=True)
class ResolvedRun:
    """Everything that defines a run; names and defaults are replaced by values."""

    recipe: Recipe  # as trained, with its seed
    protocol: Protocol
    scene: CaptureRecord
    downscale: int  # factor by which the photographs are smaller than their files
    raster: RasterSettings
    backend: Mapping[str, Any]  # settings that determine its results (`Backend.identity`)
    schedule_scale: float = 1.0  # trained fraction of the full schedule
    title: str = ""  # heading of the report; empty: the name of the capture
    init: str | None = None  # hash of the file of initial splats
    part: str | None = None  # hash of the initial state of a part of a scene
    execution: Execution = field(default_factory=Execution)

    def to_json(self) -> dict[str, Any]:
        """Return the run as plain JSON values."""
        return {**encode(self), "raster": self.raster.constants(), "seed": self.recipe.seed}

    def decisive_fields(self) -> dict[str, Any]:
        """Return what determines the bytes of the splats, as JSON values.

        The background is part of ``raster``. Fused depth and subject affect the mesh only.
        """
        data = self.to_json()
        fusion = {name: value for name, value in data["protocol"]["fusion"].items() if name not in ("depth", "subject")}
        protocol = {name: value for name, value in data["protocol"].items() if name not in ("robust", "background")}
        return {
            "backend": data["backend"],  # first: cameras differ by rounding between CPUs
            "recipe": data["recipe"],
            "protocol": {**protocol, "fusion": fusion},
            "downscale": self.downscale,
            "scene": {"masks": data["scene"]["masks"], "digest": self.scene.digest},
            "raster": data["raster"],
            **{name: data[name] for name in ("init", "part")},
        }


def read_resolved(run: RunFolder) -> ResolvedRun:
    """Return the run in ``run.json``. Raises RunError if another version wrote it, or it was edited."""
    data = run.definition()
    present = {entry.name: data[entry.name] for entry in fields(ResolvedRun) if entry.name in data}
    try:
        with absent_guests():
            resolved: ResolvedRun = decode(present, ResolvedRun, "run")
        validate(resolved.recipe)
        check_settings(resolved.raster)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecipeError, DataError, ShapeError) as e:
        raise RunError(
            f"{run.file(RUN_JSON)} is not a run as this version writes it ({e}); restore it, or train again with "
            "--overwrite"
        ) from e
    protocol = resolved.protocol
    return replace(resolved, raster=resolved.raster.for_depths(protocol.depth, protocol.fused_depth))


def check_same_run(run: RunFolder, resolved: ResolvedRun) -> None:
    """Raise RunError with the first difference, if the run in a folder cannot be resumed as ``resolved``."""
    old, new = read_resolved(run).decisive_fields(), resolved.decisive_fields()
    name = next((name for name in new if old[name] != new[name]), None)
    if name is None:
        return
    what = f"{name}{difference(old[name], new[name])}"
    if name == "scene" and old[name]["masks"] == new[name]["masks"]:
        what = "scene: its photographs, cameras, points or maps changed, or the CPU is of another kind"
    elif name == "init":
        what = "--init file"
    elif name == "part":
        what = "start of this part"
    raise RunError(f"{run.path} was made with another {what}; resume with the same options, or choose another --out")


def difference(old: Any, new: Any, where: str = "") -> str:
    """Return the first difference of two JSON values, as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in new:
            if old.get(key) != new[key]:
                return difference(old.get(key), new[key], f"{where}.{key}" if where else key)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (a, b) in enumerate(zip(old, new, strict=True)):
            if a != b:
                name = b.get("name", i) if isinstance(b, dict) else i
                return difference(a, b, f"{where}.{name}" if where else str(name))
    return f" ({where + ': ' if where else ''}{str(old)[:60]}, now {str(new)[:60]})"


# -- a run in memory ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class LoadedRun:
    """A resolved run with everything in memory, ready to train."""

    resolved: ResolvedRun
    scene: Scene
    backend: Backend
    init: Splats | None = None  # initial splats; None: from points
    # Further inputs of the trainer, for a part of a scene.
    options: TrainerOptions = field(default_factory=TrainerOptions)
    processes: int = 1  # number of processes that train together

    @property
    def recipe(self) -> Recipe:
        """The recipe as trained."""
        return self.resolved.recipe

    @property
    def protocol(self) -> Protocol:
        """The protocol."""
        return self.resolved.protocol

    @property
    def settings(self) -> RasterSettings:
        """The constants of the rasterizer."""
        return self.resolved.raster

    def trained(self, splats: Splats, scene: Scene | None = None) -> Trained:
        """Return the result of training: splats, and the scene with what was learned of its views."""
        return Trained(splats, scene or self.scene, self.protocol, self.settings, self.backend, self.recipe)

    def stage_key(self, index: int, processes: Sequence[tuple[int, ...]] | None = None) -> str:
        """Return a hash of everything that determines the bytes of the state at the end of stage ``index``.

        ``processes`` is as in ``TrainState``; by default this run's number, from the start.
        """
        inputs = self.resolved.decisive_fields()
        recipe = {name: value for name, value in inputs["recipe"].items() if name not in ("name", "fused_depth")}
        if processes is None:
            processes = [(0, 0, self.processes)] if self.processes > 1 else []
        inputs |= {
            "recipe": {**recipe, "stages": recipe["stages"][: index + 1]},
            "scene": self.resolved.scene.digest,
            "downscale": None,  # part of the digest of the images
            "versions": {name: versions()[name] for name in ("2dgs-r", "torch")},
            "processes": list(map(list, processes)),
        }
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Trained:
    """Trained splats with what scoring and meshing need.

    Attributes
    ----------
    splats : Splats
    scene : Scene
        With refined cameras and learned appearance (``View.appearance``).
    protocol : Protocol
    settings : RasterSettings
        The constants of the rasterizer in training: near, far, background.
    backend : Backend
    recipe : Recipe or None
        As trained; None for splats from elsewhere.
    """

    splats: Splats
    scene: Scene
    protocol: Protocol
    settings: RasterSettings
    backend: Backend
    recipe: Recipe | None = None

    def render(self, camera: Camera) -> RenderOutput:
        """Render the image of a camera, without gradients."""
        with torch.no_grad():
            return rasterize(self.splats, camera, self.settings, backend=self.backend)


# -- before training ---------------------------------------------------------------------------------------------------
def loaded_run(options: TrainOptions, recipe: Recipe, capture: OpenCapture, digest: str, **extra: Any) -> LoadedRun:
    """Return the run of a recipe on a capture with this digest; ``extra`` are further fields of ``ResolvedRun``."""
    resolved = ResolvedRun(
        recipe=recipe,
        protocol=capture.protocol,
        scene=CaptureRecord.of(capture.scene, digest),
        downscale=capture.downscale,
        raster=raster_settings(capture.protocol, capture.scene.extent, recipe.sh_degree, recipe.mip_px),
        backend=capture.backend.identity(),
        execution=Execution(**values(Execution, options)),
        **extra,
    )
    return LoadedRun(resolved, capture.scene, capture.backend)


def prepare_run(options: TrainOptions, on_event: OnEvent, *, title: str = "") -> LoadedRun:
    """Check the options, read the capture and resolve the run. Writes nothing.

    ``title`` is the heading of the report; empty: the name of the capture.
    """
    check_options(options)
    init, init_digest = (None, None) if options.init is None else read_init(options.init, on_event)
    capture = open_capture(options, on_event)
    digest = scene_digest(capture.scene, on_event, uses_masks=capture.protocol.use_mask_in_training)
    scale = schedule_scale_of(options, capture)
    recipe, capture = resolve(options, capture, on_event, seed=options.seed, schedule_scale=scale)
    digest = with_priors(digest, capture.scene, recipe, on_event)
    run = loaded_run(options, recipe, capture, digest, schedule_scale=scale, title=title, init=init_digest)
    return replace(run, init=init)


def read_init(path: Path, on_event: OnEvent) -> tuple[Splats, str]:
    """Read the splats of ``--init``; return them with the hash of their file."""
    if path.is_dir():
        inside = path / "splats.ply"
        hint = f"use {inside}" if inside.exists() else "name a file of splats"
        raise DataError(f"--init must be a file of splats, got the folder {path}; {hint}")
    splats, kind = read_surfels(path, lambda text: on_event(Notice(text)))
    on_event(Notice(f"starting from {path.name}: {len(splats):,} {kind}", detail=True))
    return splats, hashlib.sha256(path.read_bytes()).hexdigest()


# -- a run on disk -----------------------------------------------------------------------------------------------------
def reload_run(run: RunFolder, on_event: OnEvent) -> LoadedRun:
    """Load a run from its folder, with its refined cameras, to mesh, render or score it again.

    Raises RunError or DataError if the capture has moved or changed.
    """
    resolved = read_resolved(run)
    record = resolved.scene
    if not record.path.exists():
        raise RunError(f"the capture of {run.path} is missing: expected at {record.path}; move or link it there")
    scene = read_scene(record.path, record.format, resolved.downscale, resolved.protocol, on_event, record.masks)
    if (len(scene.train), len(scene.test)) != (record.train, record.test):
        raise RunError(
            f"{record.path} has {len(scene.train)} training and {len(scene.test)} test views, the run was made with "
            f"{record.train} and {record.test}; restore the capture or train again"
        )
    scene = with_refined_poses(run, resolved.recipe, scene)
    scene = with_maps(run, with_learned_appearance(run, resolved.recipe, scene))
    for name in resolved.recipe.quantities:
        if name not in QUANTITIES:
            on_event(Notice(f"{run.path} learned {name}, whose package is not installed: results differ without it"))
    return LoadedRun(resolved, scene, get_backend(resolved.backend["name"]))


def finished_splats(run: RunFolder) -> Splats:
    """Return the splats of a finished run. Raises RunError if the run is not finished, or the file is damaged."""
    path = run.file(SPLATS)
    if not path.exists():
        raise RunError(f"{run.path} is not finished: no {SPLATS}; continue it with `gs2d train ... --resume`")
    splats = splat_ply.read_splats(path)
    finite = torch.stack([tensor.unsqueeze(-1).flatten(1).isfinite().all(dim=1) for _, tensor in splats.items()])
    if broken := len(splats) - int(finite.all(dim=0).sum()):
        raise RunError(
            f"{path} is damaged: {broken} splats hold NaN or infinity; delete it and continue with "
            "`gs2d train ... --resume`"
        )
    return splats


def open_finished(path: Path, threads: int | None, on_event: OnEvent) -> tuple[RunFolder, Trained]:
    """Return a finished run with its splats on the device of its backend."""
    use_threads(threads)
    run = open_run(path)
    splats = finished_splats(run)
    loaded = reload_run(run, on_event)
    return run, loaded.trained(splats.to(loaded.backend.device))


def checked_output(path: Path, out: Path, ending: str = ".ply", what: str = "the file") -> Path:
    """Return ``out`` if it has this ending and is not the splats of the run; ``what`` names its kind for the error."""
    path, out = Path(path), Path(out)
    if not f"/{out.name}".lower().endswith(ending):
        raise RunError(f"--out must name a {ending.removeprefix('/')} file, which {what} is, got {out}")
    if out.resolve() == (path / SPLATS).resolve():
        raise RunError(f"--out {out} is the splats of the run, which must not change; choose another name")
    return out


def trained_elsewhere(
    splats: Splats, scene: Scene, protocol: str | Protocol, backend: str, on_event: OnEvent
) -> Trained:
    """Return splats from elsewhere with the scene that they belong to."""
    opened = capture_in_memory(scene, protocol, backend, on_event)
    settings = raster_settings(opened.protocol, scene.extent, splats.sh_degree)
    return Trained(splats.to(opened.backend.device), scene, opened.protocol, settings, opened.backend)


def spare_photographs(files: Iterable[Path], option: str, scene: Scene) -> None:
    """Raise if an output would overwrite a photograph of the capture."""
    images = {view.path.resolve() for view in scene.views if view.path is not None}
    for file in files:
        if file.resolve() in images:
            raise RunError(f"{option} would overwrite the photograph {file}; choose another name")


# -- the digest of the input -------------------------------------------------------------------------------------------
DECODE_THREADS = 2


def scene_digest(scene: Scene, on_event: OnEvent, *, uses_masks: bool = False) -> str:
    """Decode every photograph and return a hash of the training input.

    Raises DataError if a photograph does not decode, or masks leave no pixel of any training view.
    """
    digest = hashlib.sha256()
    empty: list[View] = []
    train = set(map(id, scene.train))
    for view in counted(scene.preload(DECODE_THREADS), "reading photographs", len(scene.views), on_event):
        digest.update(name_bytes(f"{view.name} {'train' if id(view) in train else 'test'}"))
        mask = view.alpha() if scene.masks.masked == EMPTY else view.mask() if uses_masks else None
        empty += [view] if mask is not None and not mask.any() else []
        camera = view.camera
        arrays = [
            np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
            camera.T_cam_world,
            view.image(),
            *(mask for mask in (view.mask(), view.object_mask()) if mask is not None),
        ]
        for array in arrays:
            digest.update(f"{array.shape} {array.dtype}".encode())
            digest.update(np.ascontiguousarray(array).data)
    if empty:
        what = f"the masks of {len(empty)} of {len(scene.views)} views leave no pixel, first {empty[0].name}"
        if set(map(id, empty)) >= train:
            raise DataError(f"{scene.root}: {what}; white = keep: are the masks inverted?")
        on_event(Notice(f"{what}: these views are not used (white = keep)"))
    if scene.points is not None:
        digest.update(np.ascontiguousarray(scene.points.points).tobytes())
        if scene.points.colors is not None:
            digest.update(np.ascontiguousarray(scene.points.colors).tobytes())
    digest.update(np.float64(scene.extent).tobytes() + np.ascontiguousarray(scene.bounds, np.float64).tobytes())
    return digest.hexdigest()


def with_priors(digest: str, scene: Scene, recipe: Recipe, on_event: OnEvent) -> str:
    """Read the priors of the training views and add them to the digest of the capture, if the recipe uses any.

    Raises DataError if a map is broken, or no view has the priors of the recipe.
    """
    if recipe.depth_prior is None and recipe.normal_prior is None:
        return digest
    priors = Priors(scene, recipe, limit_bytes=0)
    extended = hashlib.sha256(digest.encode())
    depths = normals = 0
    views = counted(scene.train, "reading depths and normals", len(scene.train), on_event)
    for index, view in enumerate(views):
        depth, normal = priors.at(index, torch.float32)
        depths += depth is not None
        normals += normal is not None
        for array in _of_priors(view, priors.plan, normal):
            extended.update(name_bytes(f"{view.name} {array.shape} {array.dtype}"))
            extended.update(np.ascontiguousarray(array).data)
    if priors.plan is not None:
        if not depths:
            raise DataError(f"the depth maps of {scene.name} have no valid value in any training view; are they empty?")
        source = priors.plan.source
        on_event(Notice(f"depth prior ({source}): {depths} of {len(scene.train)} training views", detail=True))
    if priors.axes is not None:
        on_event(
            Notice(f"normal prior: {normals} of {len(scene.train)} training views, axes {priors.axes}", detail=True)
        )
    return extended.hexdigest()


def _of_priors(view: View, plan: DepthPlan | None, normal: NormalTarget | None) -> Sequence[np.ndarray]:
    """Return the arrays that determine the depth and normal priors of a view."""
    arrays = [] if normal is None else [normal.directions.numpy()]
    if plan is not None and plan.source != "sparse" and view.maps is not None and view.maps.files.depth is not None:
        arrays.append(view.maps.depth().values)
    if plan is not None and plan.observed is not None:
        rows = plan.observed.by_view.get(view.name, np.zeros(0, dtype=np.int64))
        arrays += [values[rows] for values in (plan.observed.points, plan.observed.error, plan.observed.track)]
    return arrays
