"""A resolved run with its capture in memory: prepared from options before training, or reloaded from its folder."""

from __future__ import annotations

import hashlib
import json
import shlex
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe, validate
from gs2d.core.splats import Splats
from gs2d.core.text import name_bytes
from gs2d.data import Scene, View
from gs2d.data.known_captures import missing_lines
from gs2d.data.masks import EMPTY
from gs2d.errors import DataError, RunError
from gs2d.io import splat_ply
from gs2d.io.formats.splat_formats import read_splats, read_surfels
from gs2d.io.run_dir import SPLATS, RunFolder, open_run, versions
from gs2d.pipeline.prepare.limits import use_threads
from gs2d.pipeline.prepare.open_capture import SHOWN_SKIPS, open_capture, read_scene, without_masked_points
from gs2d.pipeline.prepare.options import TrainOptions, values
from gs2d.pipeline.prepare.part import LoadedPart, Part, load_part, part_scene
from gs2d.pipeline.prepare.photographs import already_prepared, with_prepared
from gs2d.pipeline.prepare.resolve import by_quality, check_execution, check_options, resolve
from gs2d.pipeline.prepare.resolved import CaptureRecord, Execution, ResolvedRun, read_resolved
from gs2d.pipeline.prepare.run_appearance import with_learned_appearance
from gs2d.pipeline.prepare.run_poses import with_found_poses
from gs2d.pipeline.prepare.view_priors import with_priors
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings
from gs2d.training.cached_objective import is_cacheable
from gs2d.training.events import Notice, OnEvent, Phase, Step
from gs2d.training.initialize import usable_points
from gs2d.training.trainer import raster_settings

DECODE_THREADS = 2
NEAR_SAMPLES = 2000  # sparse points by which the near plane is checked


@dataclass(frozen=True, eq=False)
class LoadedRun:
    """A resolved run with what it needs in memory, ready to train.

    Attributes
    ----------
    resolved : ResolvedRun
    scene : Scene
    backend : Backend
    init : Splats or None
        What training starts from instead of points.
    part : LoadedPart or None
        What a part of a larger training begins with and is surrounded by.
    processes : int
        That train together.
    """

    resolved: ResolvedRun
    scene: Scene
    backend: Backend
    init: Splats | None = None
    part: LoadedPart | None = None
    processes: int = 1

    @property
    def recipe(self) -> Recipe:
        """The recipe as it is trained."""
        return self.resolved.recipe

    @property
    def protocol(self) -> Protocol:
        """The protocol."""
        return self.resolved.protocol

    @property
    def settings(self) -> RasterSettings:
        """The constants of the rasterizer."""
        return self.resolved.raster

    @property
    def downscale(self) -> int:
        """Photographs are this factor smaller than their files."""
        return self.resolved.downscale

    def stage_key(self, index: int, processes: Sequence[tuple[int, ...]] | None = None) -> str:
        """Hash of all that decides the state at the end of stage ``index``: equal keys, equal bytes.

        ``processes``: since which stage and iteration how many trained (``TrainState.processes``); by default those of
        this run, all the time.
        """
        facts = self.resolved.decisive_facts()
        recipe = {name: value for name, value in facts["recipe"].items() if name not in ("name", "fused_depth")}
        if processes is None:
            processes = [(0, 0, self.processes)] if self.processes > 1 else []
        facts |= {
            "recipe": {**recipe, "stages": recipe["stages"][: index + 1]},
            "scene": self.resolved.scene.digest,
            "downscale": None,  # the digest of the images has it
            "stage2_cache_bytes": facts["stage2_cache_bytes"] if self._uses_cached_views(index) else 0,
            "versions": {name: versions()[name] for name in ("2dgs-r", "torch")},
            "processes": list(map(list, processes)),
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def _uses_cached_views(self, index: int) -> bool:
        """Whether stage ``index`` or one before it can train from cached views."""
        views, stages = len(self.scene.train), self.recipe.stages[: index + 1]
        return any(is_cacheable(self.recipe, stage, backend=self.backend, views=views) for stage in stages)


class RenderedScene(typing.Protocol):
    """What drawing splats from the cameras of a scene needs; a LoadedRun and ``in_memory.Trained`` have it."""

    @property
    def scene(self) -> Scene:
        """The views and points."""

    @property
    def protocol(self) -> Protocol:
        """The protocol."""

    @property
    def settings(self) -> RasterSettings:
        """The constants of the rasterizer."""

    @property
    def backend(self) -> Backend:
        """The rasterizer."""


# -- before training ---------------------------------------------------------------------------------------------------
def prepare_run(options: TrainOptions, on_event: OnEvent, *, title: str = "", part: Part | None = None) -> LoadedRun:
    """Check the options, cheapest first, then read the capture and resolve the run. Writes only prepared photographs.

    Parameters
    ----------
    options : TrainOptions
    on_event : callable
    title : str
        Heading of the report; empty: the name of the capture.
    part : Part or None
        The part of a larger training that this is; its recipe and protocol replace those of the options.
    """
    if part is None:
        check_options(options)
        options = by_quality(options, on_event)
    else:
        check_execution(options)
        options = replace(options, protocol=part.protocol, test_every=None)
    init, init_digest = (None, None) if options.init is None else read_init(options.init, on_event)
    capture = open_capture(options, on_event)
    scene, home = capture.scene, options.out
    if part is not None:
        scene, home = part_scene(scene, part), part.prepared or options.out
    execution = Execution(**values(Execution, options))
    scene = with_prepared(scene, home, execution, on_event, shared=home != options.out)
    _say_some(missing_lines(options.scene), "pieces are missing", on_event)
    digest = scene_digest(scene, on_event, uses_masks=capture.protocol.use_mask_in_training)
    capture, scale = replace(capture, scene=scene), 1.0 if options.schedule_scale is None else options.schedule_scale
    if part is None:
        recipe, capture = resolve(options, capture, on_event, seed=options.seed, schedule_scale=scale)
    else:
        recipe = validate(part.recipe)
        capture = replace(capture, scene=without_masked_points(scene, capture.protocol, on_event))
    scene, protocol = capture.scene, capture.protocol
    digest = with_priors(digest, scene, recipe, on_event)
    loaded_part = None if part is None or part.splats is None else load_part(part, scene, recipe)
    settings = raster_settings(protocol, scene.extent, recipe.sh_degree)
    _tell_near_plane(settings.near, protocol, scene, options.scene, on_event)
    resolved = ResolvedRun(
        recipe=recipe,
        protocol=protocol,
        scene=CaptureRecord.of(scene, digest),
        downscale=capture.downscale,
        raster=settings,
        backend=capture.backend.facts(),
        stage2_cache_bytes=options.stage2_cache_mb << 20,
        schedule_scale=scale,
        title=title,
        init=init_digest,
        part=None if loaded_part is None else loaded_part.digest,
        execution=execution,
    )
    return LoadedRun(resolved, scene, capture.backend, init, loaded_part)


def _tell_near_plane(near: float, protocol: Protocol, scene: Scene, path: Path, on_event: OnEvent) -> None:
    """Say where the near plane is if the scene decided it, and warn if it cuts the scene away."""
    if protocol.near is None:
        text = f"near plane at {near:.4g}: 1 % of the scene's extent of {scene.extent:.4g}"
        on_event(Notice(text, detail=True))
    if (cut := near_cuts(scene, near)) > 0.5:
        on_event(
            Notice(
                f"near plane at {near:.4g} cuts away {cut:.0%} of the sparse points, and with them the scene: "
                f"check the camera positions with `gs2d info {shlex.quote(str(path))}`, or use a --protocol "
                "with another near plane"
            )
        )


def near_cuts(scene: Scene, near: float) -> float:
    """Return the fraction of the sparse points in front of the training cameras that ``near`` makes unusable."""
    if scene.points is None:
        return 0.0
    points = scene.points.points[:: max(1, len(scene.points) // NEAR_SAMPLES)]
    ahead = usable_points(points, scene, 0.0)
    return 1 - float(usable_points(points[ahead], scene, near).mean()) if ahead.any() else 0.0


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


# -- a run on disk -----------------------------------------------------------------------------------------------------
def reload_run(run: RunFolder, on_event: OnEvent, *, backend: str = "auto") -> LoadedRun:
    """Load a run on disk to mesh, render or score it again, with the cameras that it found.

    Raises
    ------
    RunError, DataError
        The capture has moved or changed.
    """
    resolved = read_resolved(run)
    record = resolved.scene
    if not record.path.exists():
        raise RunError(
            f"the capture of {run.path} was at {record.path}, which is not there; put it back or link it there"
        )
    scene = read_scene(record.path, record.format, resolved.downscale, resolved.protocol, on_event, record.masks)
    found = (len(scene.train), len(scene.test))
    if found != (record.train, record.test):
        raise RunError(
            f"the capture at {record.path} has {found[0]} + {found[1]} views, the run was made with "
            f"{record.train} + {record.test}; restore it or train again"
        )
    scene = with_found_poses(run, resolved.recipe, already_prepared(scene, run.path))
    scene = with_learned_appearance(run, resolved.recipe, scene)
    chosen = get_backend(resolved.backend["name"] if backend == "auto" else backend)
    return LoadedRun(resolved, scene, chosen)


def finished_splats(run: RunFolder) -> Splats:
    """Return the splats of a finished run.

    Raises
    ------
    RunError
        Not finished yet, or the file was damaged.
    """
    path = run.file(SPLATS)
    if not path.exists():
        raise RunError(f"{run.path} is not finished: no {SPLATS}; continue it with `gs2d train ... --resume`")
    splats = splat_ply.read_splats(path)
    whole = torch.stack([tensor.unsqueeze(-1).flatten(1).isfinite().all(dim=1) for _, tensor in splats.items()])
    broken = len(splats) - int(whole.all(dim=0).sum())
    if broken:
        raise RunError(
            f"{path} must hold finite numbers, got NaN or infinity in {broken} splats, which would not be drawn; "
            "it was damaged: delete it and continue with `gs2d train ... --resume`"
        )
    return splats


def open_finished(
    path: Path, threads: int | None, on_event: OnEvent, *, splats_file: Path | None = None, out: Path | None = None
) -> tuple[RunFolder, LoadedRun, Splats]:
    """Return a run, what defines it, and its splats on the device of its backend.

    Parameters
    ----------
    splats_file : Path or None
        Take the splats of this file instead, of any format that is read, in the frame of the run.
    out : Path or None
        Where what is made of it goes, which must be said then: files of the run are of its own splats.
    """
    use_threads(threads)
    run = open_run(path)
    splats = finished_splats(run) if splats_file is None else _splats_of(Path(splats_file), out, on_event)
    loaded = reload_run(run, on_event)
    return run, loaded, splats.to(loaded.backend.device)


def _splats_of(path: Path, out: Path | None, on_event: OnEvent) -> Splats:
    if out is None:
        raise RunError("--splats needs --out: what is in the run is made of its own splats; name another place")
    if path.is_dir():
        raise DataError(f"--splats must be a file of splats, got the folder {path}; give the splats.ply in it")
    return read_splats(path, lambda text: on_event(Notice(text)))


def checked_output(path: Path, out: Path, ending: str = ".ply", what: str = "") -> Path:
    """``out``, if it may be written: a PLY by its name, and not the splats of the run, from which all else is made.

    Parameters
    ----------
    ending : str
        That of its name.
    what : str
        What needs that ending, for the error.
    """
    path, out = Path(path), Path(out)
    if not f"/{out.name}".lower().endswith(ending):
        raise RunError(
            f"--out must name a {ending.removeprefix('/')} file, which is what {what or 'is written'}, got {out}"
        )
    if out.resolve() == (path / SPLATS).resolve():
        raise RunError(f"--out {out} is the splats of the run, which stay as they are; choose another name")
    return out
