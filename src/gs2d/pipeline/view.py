"""What the viewer shows of a run, or of a file of splats."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.core.camera import Camera, look_at
from gs2d.core.georeference import Georeference
from gs2d.core.images import to_uint8
from gs2d.core.missing import where_it_ends
from gs2d.core.splats import Splats
from gs2d.core.transforms import up_direction
from gs2d.data import View
from gs2d.data.subject import read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.formats.registry import read_splats
from gs2d.io.georeference import georeference_of_file, read_georeference
from gs2d.io.meshes import glb_bytes, glb_turn, read_mesh
from gs2d.io.run_dir import MESH, TEXTURED, RunFolder, is_run, load_tensors, open_run
from gs2d.pipeline.events import Notice, OnEvent, Phase, Step, counted, ignore
from gs2d.pipeline.finished import finished_splats
from gs2d.pipeline.job import Job, reload_job
from gs2d.pipeline.options import ViewOptions
from gs2d.pipeline.subject import OPAQUE
from gs2d.pipeline.threads import use_threads
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings
from gs2d.report.images import depth_image, normal_image, valid_image
from gs2d.training.state import TrainState
from gs2d.viewer.exact import Drawn, Render, ViewerFrame
from gs2d.viewer.server import Shot, Viewer, ViewerStage, middle_of, required_viser, thumbnail
from gs2d.viewer.splats import preview

MAX_CAMERAS = 200
FINAL = "final"
_TICK = 0.2  # s between looks at Ctrl-C


@dataclass(frozen=True, eq=False)
class _Content:
    """What there is to see."""

    title: str
    stages: dict[str, Callable[[], Splats]]
    views: Sequence[View]
    settings: RasterSettings
    backend: Backend
    depth: str
    mesh: Callable[[OnEvent], tuple[bytes, list[float]] | None]

    @property
    def cameras(self) -> list[Camera]:
        return [view.camera for view in self.views]


def open_viewer(
    path: Path,
    options: ViewOptions = ViewOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
) -> Viewer:
    """Start to serve a run, or a file of splats; ``close`` the viewer when it was looked at.

    Raises
    ------
    RunError, DataError, BackendError
    """
    required_viser()
    use_threads(options.threads)
    content = _of_run(path, on_event) if path.is_dir() or is_run(path) else _of_file(path, on_event)
    load = lru_cache(maxsize=1)(lambda name: content.stages[name]())  # one stage in memory
    final = load(list(content.stages)[-1])
    centers = final.means.cpu().numpy()
    frame, up = frame_around(content.cameras, centers), np.array([0.0, 0.0, 1.0])
    if content.cameras:
        up = up_direction(content.cameras)
    viewer = Viewer(title=f"gs2d: {content.title}", host=options.host, port=options.port, frame=frame, up=up)
    try:
        viewer.add_stages({name: _stage(content, load, name) for name in content.stages})
        mesh = content.mesh(on_event)
        if mesh is not None:
            viewer.add_mesh(*mesh)
        if content.views:
            viewer.add_cameras(shots(content.views, content.settings, on_event))
        first = content.cameras[0] if content.cameras else from_aside(frame, up)
        viewer.look_from(first, frame.origin)
        viewer.add_clip_box(_first_box(path, centers), str(path), of_run=is_run(path))
        viewer.add_ruler(str(path), of_run=is_run(path), world=world_of(path, on_event))
    except BaseException:
        viewer.close()
        raise
    return viewer


def _first_box(path: Path, centers: np.ndarray) -> np.ndarray:
    """Return the box of the subject [2, 3], else that of most splats."""
    subject = read_subject(path) if is_run(path) else None
    if subject is not None:
        return subject.box
    finite = centers[np.isfinite(centers).all(axis=1)]
    return np.percentile(finite, (2, 98), axis=0) if len(finite) else np.array([[-1.0] * 3, [1.0] * 3])


def world_of(path: Path, on_event: OnEvent) -> Georeference | None:
    """Return how the splats of a run or a file lie in the world, to measure in metres; None where that is not known."""
    try:
        if is_run(path):
            return read_georeference(path)
        told = georeference_of_file(path)
        return None if told is None else told.of_local_files()
    except DataError as error:
        on_event(Notice(f"distances are in units of the capture: {error}"))
        return None


def serve(viewer: Viewer, on_event: OnEvent = ignore) -> None:
    """Wait until KeyboardInterrupt (from ``on_event`` or Ctrl-C), or until a picture could not be drawn.

    Raises
    ------
    Exception
        What the drawing thread met.
    """
    while viewer.failure is None:
        on_event(Step(0))  # where a Ctrl-C that somebody swallowed is raised again
        time.sleep(_TICK)
    raise viewer.failure


def frame_around(cameras: Sequence[Camera], centers: np.ndarray) -> ViewerFrame:
    """Around what is looked at; its unit is the distance from which it is, or the spread of the splats."""
    middle = middle_of(cameras, centers)
    points = np.array([camera.center for camera in cameras]) if cameras else centers[np.isfinite(centers).all(axis=1)]
    unit = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 1.0
    return ViewerFrame(middle, unit if unit > 1e-12 and math.isfinite(unit) else 1.0)


def from_aside(frame: ViewerFrame, up: np.ndarray) -> Camera:
    """Where to look from where nobody stood."""
    aside = np.array([2.0, -2.5, 1.5]) * frame.unit
    return look_at(frame.origin + aside, frame.origin, up, width=4, height=3, fx=4.0)


def _of_run(path: Path, on_event: OnEvent) -> _Content:
    run = open_run(path)
    splats = finished_splats(run)
    job: Job | None = None
    try:
        job = reload_job(run, on_event)
    except (RunError, DataError) as error:
        on_event(Notice(f"without cameras: {error}"))
    stages: dict[str, Callable[[], Splats]] = {}
    ends = [checkpoint for checkpoint in run.checkpoints() if checkpoint.iteration is None]
    for checkpoint in ends[:-1]:  # the last one is what splats.ply holds
        stages[checkpoint.stage] = partial(_splats_of, checkpoint.path)
    stages[FINAL] = lambda: splats
    definition, mesh = run.definition(), partial(_mesh_of, run)
    name = definition.get("title") or definition["scene"]["name"]
    if job is None:
        backend = get_backend("auto")
        return _Content(name, stages, (), settings_without_run(splats), backend, "median", mesh)
    return _Content(name, stages, job.scene.train, job.settings, job.backend, job.protocol.depth, mesh)


def _splats_of(checkpoint: Path) -> Splats:
    return TrainState.from_state_dict(load_tensors(checkpoint)["state"]).splats


def _of_file(path: Path, on_event: OnEvent) -> _Content:
    if not path.exists():
        raise DataError(f"expected a run folder or a file of splats at {path}, found nothing{where_it_ends(path)}")
    splats = read_splats(path, lambda text: on_event(Notice(text)))
    settings, backend = settings_without_run(splats), get_backend("auto")
    return _Content(path.name, {FINAL: lambda: splats}, (), settings, backend, "median", lambda _: None)


def settings_without_run(splats: Splats) -> RasterSettings:
    """Of splats without a run: over white, near plane at a hundredth of what they spread over."""
    spread = float((splats.means - splats.means.median(dim=0).values).norm(dim=1).median()) if len(splats) else 1.0
    near = max(0.01 * spread, 1e-9)
    return RasterSettings(near=near, far=1e4 * near, background=(1.0, 1.0, 1.0), sh_degree=splats.sh_degree)


def _mesh_of(run: RunFolder, on_event: OnEvent) -> tuple[bytes, list[float]] | None:
    """Return the textured mesh, else the coloured one, as a .glb file and the turn that it contains."""
    if run.file(TEXTURED).exists():
        data = run.file(TEXTURED).read_bytes()
        return data, glb_turn(data)
    if not run.file(MESH).exists():
        return None
    on_event(Phase("preparing the mesh", 0))
    mesh = read_mesh(run.file(MESH))
    return (glb_bytes(mesh), [0.0, 0.0, 0.0, 1.0]) if len(mesh.faces) else None


def _stage(content: _Content, load: Callable[[str], Splats], name: str) -> ViewerStage:
    def render() -> Render:
        splats = load(name).to(content.backend.device)
        return lambda camera, kind: drawn(splats, camera, kind, content.settings, content.backend, content.depth)

    return ViewerStage(lambda: preview(load(name), content.cameras), render)


def drawn(
    splats: Splats, camera: Camera, kind: str, settings: RasterSettings, backend: Backend, depth_kind: str
) -> Drawn:
    """Return the exact picture of a kind ("exact", "normals", "depth") for the viewer."""
    with torch.no_grad():
        output = rasterize(
            splats, camera, replace(settings, with_distortion=False).for_depths(depth_kind), backend=backend
        )
    alpha, depth = output.alpha.cpu().numpy(), output.depth(depth_kind).cpu().numpy()
    if kind == "normals":
        image = normal_image(output.normal.cpu().numpy(), alpha)
    elif kind == "depth":
        image = depth_image(depth, alpha)
    else:
        image = output.color.clamp(0, 1).cpu().numpy()
    return Drawn(to_uint8(image), np.where((alpha >= OPAQUE) & (depth > 0), depth, np.inf).astype(np.float32))


def shots(views: Sequence[View], settings: RasterSettings, on_event: OnEvent) -> list[Shot]:
    """Return some of the photographs, small."""
    some: list[Any] = list(views)
    if len(some) > MAX_CAMERAS:
        on_event(Notice(f"{MAX_CAMERAS} of {len(some)} cameras are shown"))
        some = [some[i] for i in np.linspace(0, len(some) - 1, MAX_CAMERAS).round().astype(int)]
    return [
        Shot(view.name, view.camera, thumbnail(valid_image(view.image(), view.valid()), settings.background))
        for view in counted(some, "thumbnails", len(some), on_event)
    ]
