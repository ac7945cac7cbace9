"""``gs2d export --format html``: the splats of a run or a file as one HTML file."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gs2d.core.camera import Camera, look_at
from gs2d.core.json_files import read_json
from gs2d.core.missing import path_hint
from gs2d.core.splats import Splats
from gs2d.core.transforms import focus_point, up_direction
from gs2d.data import View
from gs2d.data.subject_box import OBJECT, Subject, read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.formats.splat_formats import read_splats
from gs2d.io.meshes import read_mesh, read_textured
from gs2d.io.run_dir import GEOREFERENCE, MESH, PAGE, TEXTURED, RunFolder, is_run, open_run
from gs2d.meshing.simplify import simplify
from gs2d.meshing.web_mesh import web_mesh
from gs2d.pipeline.prepare.loaded import Trained, finished_splats, reload_run
from gs2d.render.types import RasterSettings
from gs2d.report.color_maps import valid_image
from gs2d.training.events import Notice, OnEvent, Phase, ignore
from gs2d.viewer.scene_page import PageScene, PageView, WorldScale, write_page

MAX_VIEWS = 100  # photographs on the page
SUFFIXES = (".html", ".htm")
EMBEDDED_SIDE = 320  # px, longer side of the photographs in a page
EMBEDDED_FACES = 200_000  # of the mesh in a page
EMBEDDED_TEXTURE = 2048  # px, side of its texture
OPENING_DISTANCE = 3.2  # radii of the subject; an image of 4 x 3 with a focal length of 4 then shows all of it
TAIL = 1.0  # per cent of the splats outside the opening box on each side of each axis
MARGIN = 0.1  # of the longest side of that box, added on each side


def page_run(
    path: Path, out: Path | None = None, *, on_event: OnEvent = ignore, trained: Trained | None = None
) -> dict[str, Any]:
    """Write the page of a run or of a file of splats; return ``file``, ``splats``, ``sh_degree``, ``views``, ``bytes``.

    ``out`` is ``scene.html`` in the run, or next to the file, by default. ``trained`` is the run, if it is in memory.
    """
    path = Path(path)
    of_run = path.is_dir() or is_run(path)
    out = (path / PAGE if of_run else path.with_suffix(".html")) if out is None else Path(out)
    if out.suffix.lower() not in SUFFIXES:
        raise RunError(f"--out must name an .html file, got {out}")
    content = page_content(path, on_event, trained)
    if content.run is not None:
        content.run.sweep()
    on_event(Phase("writing the page", 0))
    background = content.scene.settings.background
    photographs = [photograph_jpeg(view, background, EMBEDDED_SIDE) for view in content.photographs]
    written = write_page(
        out,
        content.splats,
        content.scene,
        meshes={} if content.run is None else _embedded_meshes(content.run),
        photographs=photographs,
    )
    return {"file": str(out), "views": len(content.scene.views), **written}


def photograph_jpeg(view: View, background: Sequence[float], side: int) -> bytes:
    """Return the photograph of a view as a JPEG file of at most ``side`` px; transparent pixels show the background."""
    image = Image.fromarray(valid_image(view.image(), view.valid()))
    image.thumbnail((side, side), Image.Resampling.BOX)
    if image.mode == "RGBA":
        behind = Image.new("RGBA", image.size, tuple(round(255 * channel) for channel in background))
        image = Image.alpha_composite(behind, image)
    file = io.BytesIO()
    image.convert("RGB").save(file, "JPEG", quality=90)
    return file.getvalue()


def _embedded_meshes(run: RunFolder) -> dict[str, bytes]:
    """Return the meshes of a run, small enough for a page. A textured mesh with more faces is omitted."""
    meshes = {}
    if run.file(MESH).exists():
        meshes["mesh"] = web_mesh(simplify(read_mesh(run.file(MESH)), faces=EMBEDDED_FACES))
    if run.file(TEXTURED).exists():
        textured = read_textured(run.file(TEXTURED))
        if len(textured.faces) <= EMBEDDED_FACES:
            meshes["textured"] = web_mesh(textured, max_texture=EMBEDDED_TEXTURE)
    return meshes


@dataclass(frozen=True, eq=False)
class PageContent:
    """Content of a page."""

    splats: Splats
    scene: PageScene
    photographs: Sequence[View]  # those of `scene.views`, in order; empty if the capture is missing
    run: RunFolder | None  # None: the splats are of a file


def page_content(path: Path, on_event: OnEvent = ignore, trained: Trained | None = None) -> PageContent:
    """Return the content of the page of a run (``trained``, if it is in memory) or of a file of splats."""
    run = open_run(path) if path.is_dir() or is_run(path) else None
    if run is not None:
        splats = finished_splats(run)
        definition = run.definition()
        title = definition.get("title") or definition["scene"]["name"]
        try:
            trained = trained or reload_run(run, on_event).trained(splats)
        except (RunError, DataError) as error:
            on_event(Notice(f"without the cameras of the photographs: {error}"))
    else:
        if not path.exists():
            raise DataError(f"{path} is no run folder or file of splats{path_hint(path)}")
        splats, title = read_splats(path, lambda text: on_event(Notice(text))), path.stem
    photographs = [] if trained is None else some_views(trained.scene.train)
    scene = page_scene(
        title,
        photographs,
        settings_without_run(splats) if trained is None else trained.settings,
        splats.means.cpu().numpy(),
        subject=None if run is None else _subject(path, on_event),
        world=None if run is None else _world_of(run, on_event),
    )
    return PageContent(splats, scene, photographs, run)


def page_scene(
    title: str,
    photographs: Sequence[View],
    settings: RasterSettings,
    centers: np.ndarray,
    *,
    subject: Subject | None = None,
    world: WorldScale | None = None,
) -> PageScene:
    """Return cameras and focus of a page for splats at ``centers`` [N, 3].

    Without photographs the page opens on the whole subject from the side. The default subject is nearly all splats.
    """
    cameras = [view.camera for view in photographs]
    focus, unit = _focus(cameras, centers)
    if photographs:
        views = [PageView(view.name, view.camera) for view in photographs]
        return PageScene(title, views, settings, focus, unit, up_direction(cameras), subject, world)
    subject = replace(subject or _most_splats(centers), kind=OBJECT)
    side = np.cross(subject.up, [1.0, 0.0, 0.0] if abs(subject.up[0]) < 0.9 else [0.0, 1.0, 0.0])
    arm = side + np.cross(subject.up, side) + 0.7 * subject.up  # diagonally, from above
    eye = subject.center + OPENING_DISTANCE * subject.radius * arm / np.linalg.norm(arm)
    views = [PageView("Opening view", look_at(eye, subject.center, subject.up, width=4, height=3, fx=4.0))]
    return PageScene(title, views, settings, focus, unit, subject.up, subject, world, is_photographed=False)


def _most_splats(centers: np.ndarray) -> Subject:
    """Return the box of nearly all splats, with the third axis up."""
    finite = centers[np.isfinite(centers).all(axis=1)]
    low, high = np.percentile(finite, (TAIL, 100 - TAIL), axis=0) if len(finite) else np.array([[-1.0] * 3, [1.0] * 3])
    margin = np.maximum(MARGIN * (high - low).max(), 1e-6)
    box = (low - margin, high + margin)
    return Subject(OBJECT, *box, (low + high) / 2, np.array([0.0, 0.0, 1.0]), "nearly all splats; there are no cameras")


def some_views(views: Sequence[View], most: int = MAX_VIEWS) -> list[View]:
    """Return at most ``most`` views, evenly spaced, with the first and the last."""
    count = min(len(views), most)
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]


def settings_without_run(splats: Splats) -> RasterSettings:
    """Return settings for splats without a run: white background, near plane at a hundredth of their spread."""
    spread = float((splats.means - splats.means.median(dim=0).values).norm(dim=1).median()) if len(splats) else 1.0
    near = max(0.01 * spread, 1e-9)
    return RasterSettings(near=near, far=1e4 * near, background=(1.0, 1.0, 1.0), sh_degree=splats.sh_degree)


def _focus(cameras: Sequence[Camera], centers: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the focus, and the typical distance of cameras (without cameras: the spread of the splats)."""
    centers = centers[np.isfinite(centers).all(axis=1)]
    if len(cameras) > 1:
        focus = focus_point(list(cameras))
    else:
        focus = np.asarray(np.median(centers, axis=0) if len(centers) else np.zeros(3), np.float64)
    points = np.array([camera.center for camera in cameras]) if cameras else centers
    unit = float(np.median(np.linalg.norm(points - focus, axis=1))) if len(points) else 1.0
    return focus, unit if unit > 1e-12 and math.isfinite(unit) else 1.0


def _world_of(run: RunFolder, on_event: OnEvent) -> WorldScale | None:
    """Return the scale and rotation of a georeferenced run, to measure in metres; None for any other run."""
    if not run.file(GEOREFERENCE).exists():
        return None
    try:
        world = read_json(run.file(GEOREFERENCE))
        rotation = np.array(world["rotation"], np.float64).reshape(3, 3)
        return WorldScale(float(world["metres_per_unit"]), rotation)
    except (DataError, KeyError, TypeError, ValueError) as error:
        on_event(Notice(f"distances are in units of the capture: cannot read {GEOREFERENCE}: {error}"))
        return None


def _subject(folder: Path, on_event: OnEvent) -> Subject | None:
    """Return the subject of the run, if there is one; report a damaged file."""
    try:
        return read_subject(folder)
    except DataError as error:
        on_event(Notice(f"the page does not open at the subject: {error}"))
        return None
