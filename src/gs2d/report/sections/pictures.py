"""The pictures of the report: renderings of every stage beside the photographs, and the mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.images import composite, read_image
from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import RENDERS
from gs2d.report.html import color_bar, escape, image_tag, missing, wipe
from gs2d.report.images import ERROR_TOP, HIGHLIGHT, depth_scale, error_scale
from gs2d.report.mesh_images import mesh_images, orbit_cameras

MAX_VIEWS = 4
MAX_FACES = 4_000_000  # a picture of more would take gigabytes
PHOTOS = "photos"
KINDS = {
    "color": "Colour",
    "normal": "Normal",
    "depth": "Depth",
    "error": "Error",
    "high_error": "High-error splats",
}


@dataclass(frozen=True)
class ShownView:
    """A view of which there are pictures; ``file`` is the stem of their names, ``depth_limits`` are world units."""

    name: str
    file: str
    split: str
    depth_limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Gallery:
    """What is in ``renders/``."""

    folder: Path
    views: tuple[ShownView, ...]
    stages: tuple[str, ...]

    def photo(self, view: ShownView) -> np.ndarray | None:
        """The photograph of a view."""
        return _read(self.folder / PHOTOS / f"{view.file}.png")

    def rendering(self, stage: str, view: ShownView, kind: str) -> np.ndarray | None:
        """One rendering."""
        return _read(self.folder / stage / f"{view.file}.{kind}.png")

    def beside(self, view: ShownView, stage: str = PHOTOS, kind: str = "") -> str:
        """Return where a picture lies, seen from the report."""
        return f"{RENDERS}/{stage}/{view.file}.{kind}.png" if kind else f"{RENDERS}/{stage}/{view.file}.png"


def _read(path: Path) -> np.ndarray | None:
    return read_image(path) if path.is_file() else None


def read_gallery(renders: Path) -> Gallery | None:
    """The gallery by its ``index.json``; None where there is none.

    Raises
    ------
    DataError
        The index is broken.
    """
    data = read_index(renders)
    if data is None:
        return None
    views = tuple(
        ShownView(
            view["name"],
            view.get("file", view["name"]),
            str(view.get("split", "")),
            tuple(view["depth_limits"]) if view.get("depth_limits") else None,
        )
        for view in data["views"]
    )
    return Gallery(renders, views, tuple(data["stages"]))


def read_index(renders: Path) -> dict[str, Any] | None:
    """``index.json`` of the pictures: ``views`` and ``stages``, checked; None where there is none.

    Raises
    ------
    DataError
        It is broken.
    """
    path = renders / "index.json"
    if not path.is_file():
        return None
    data = read_json(path)
    if isinstance(data, dict):
        views, stages = data.get("views", []), data.get("stages", [])
        if _are(views, _is_view) and _are(stages, lambda stage: isinstance(stage, str)):
            return {**data, "views": views, "stages": stages}
    raise DataError(
        f"{path} must hold the lists views and stages as gs2d writes them, got something else; "
        "delete it (the report then has no pictures of views), or train again with --overwrite"
    )


def _are(values: Any, holds: Callable[[Any], bool]) -> bool:
    return isinstance(values, list) and all(map(holds, values))


def _is_view(entry: Any) -> bool:
    if not (isinstance(entry, dict) and isinstance(entry.get("name"), str)):
        return False
    limits = entry.get("depth_limits")
    known = limits is None or (_are(limits, lambda value: isinstance(value, int | float)) and len(limits) == 2)
    return known and isinstance(entry.get("file", ""), str) and isinstance(entry.get("camera", {}), dict)


def hero(renders: Path) -> str:
    """The first view large: the photograph wiped over the last stage's colour; its normal and its depth."""
    gallery = read_gallery(renders)
    if gallery is None or not gallery.views or not gallery.stages:
        return ""
    view, stage = gallery.views[0], gallery.stages[-1]
    compared = comparison(gallery, view, width=1000)
    figures = [] if compared else [("Photograph", gallery.photo(view), gallery.beside(view))]
    figures += [
        (f"{KINDS[kind]}, {stage}", gallery.rendering(stage, view, kind), gallery.beside(view, stage, kind))
        for kind in (("normal", "depth") if compared else ("color", "normal", "depth"))
    ]
    others = "".join(
        image_tag(image, title, alt=f"{title} of {view.name}", width=520, full=full)
        for title, image, full in figures
        if image is not None
    )
    beside = f'<div class="hero">{others}</div>' if others else ""
    return f'<div class="hero first">{compared}{beside}</div>' if compared else beside


def comparison(gallery: Gallery, view: ShownView, *, width: int = 800) -> str:
    """Return the photograph of a view wiped over the last stage's rendering; "" where there are not both."""
    stage = gallery.stages[-1]
    photo, color = gallery.photo(view), gallery.rendering(stage, view, "color")
    if photo is None or color is None or photo.shape[:2] != color.shape[:2]:
        return ""
    split = f" ({view.split} view)" if view.split else ""
    return wipe(
        (photo, color),
        ("photograph", "rendering"),
        title=f"{view.name}{split}, {_psnr_caption(color, photo)}",
        width=width,
        full=(gallery.beside(view), gallery.beside(view, stage, "color")),
    )


def view_sections(renders: Path, *, expected_stages: Sequence[str]) -> str:
    """For every shown view a grid: kinds of picture down, photograph and stages across."""
    gallery = read_gallery(renders)
    if gallery is None or not gallery.views:
        return missing("renders/ holds no pictures (gs2d render RUN makes them).")
    stages = list(dict.fromkeys([*gallery.stages, *expected_stages]))
    parts = []
    for view in gallery.views[:MAX_VIEWS]:
        split = f" <small>{escape(view.split)} view</small>" if view.split else ""
        compared = comparison(gallery, view) if view is not gallery.views[0] and gallery.stages else ""  # that: on top
        grid = f'<div class="scroll">{_grid(gallery, view, stages)}</div>'
        parts.append(f"<h3>{escape(view.name)}{split}</h3>{compared}{grid}")
    left = len(gallery.views) - MAX_VIEWS
    if left > 0:
        parts.append(missing(f"{left} more views are in the folder renders/."))
    return "".join(parts)


def _grid(gallery: Gallery, view: ShownView, stages: Sequence[str]) -> str:
    photo = gallery.photo(view)
    cells = ['<div class="head"></div><div class="head">photograph</div>']
    cells += [f'<div class="head">{escape(stage)}</div>' for stage in stages]
    for kind, title in KINDS.items():
        images = [gallery.rendering(stage, view, kind) for stage in stages]
        cells.append(f'<div class="row">{title}</div>')
        if kind == "color":
            missing_photo = missing("no photograph in renders/photos")
            shown = "" if photo is None else image_tag(photo, alt=f"photograph {view.name}", full=gallery.beside(view))
            cells.append(shown or missing_photo)
        else:
            cells.append(_key(kind, view))
        for stage, image in zip(stages, images, strict=True):
            if image is None:
                cells.append(missing(_why_missing(kind, stage)))
                continue
            caption = _psnr_caption(image, photo) if kind == "color" else ""
            alt, full = f"{title} of {view.name} after {stage}", gallery.beside(view, stage, kind)
            cells.append(image_tag(image, caption, alt=alt, full=full))
    columns = f"5.2rem repeat({len(stages) + 1}, minmax(8rem, 1fr))"
    return f'<div class="views" style="grid-template-columns: {columns}">{"".join(cells)}</div>'


def _why_missing(kind: str, stage: str) -> str:
    if kind == "high_error":
        return "no splats were ranked by error up to this stage"
    return f"not rendered for {stage}"


def _key(kind: str, view: ShownView) -> str:
    """What the colours of a row mean."""
    if kind == "error":
        return color_bar(
            error_scale(9), "0", f"{ERROR_TOP:g} and more", "mean absolute error over channels, colours in [0, 1]"
        )
    if kind == "depth":
        near, far = ("near", "far") if view.depth_limits is None else (f"{limit:.3g}" for limit in view.depth_limits)
        return color_bar(depth_scale(9), near, far, "depth along the optical axis, world units")
    if kind == "normal":
        return '<div class="key">world normals facing the camera: red, green, blue for x, y, z</div>'
    solid = np.tile(np.array(HIGHLIGHT, dtype=np.float32), (2, 1))
    fade = np.stack([np.full(3, 0.8, dtype=np.float32), solid[0]])
    return color_bar(fade, "0", "1", "share of the splats with the highest colour error in a pixel")


def _psnr_caption(image: np.ndarray, photo: np.ndarray | None) -> str:
    """PSNR of the two 8-bit pictures, where they have the same size."""
    if photo is None or image.shape[:2] != photo.shape[:2]:
        return ""
    white = (1.0, 1.0, 1.0)
    difference = composite(image, white).astype(np.float64) - composite(photo, white)
    squared = float(np.mean(difference**2))
    return "equal" if squared == 0 else f"{-10 * np.log10(squared):.2f} dB"


def mesh_section(path: Path, cameras: Sequence[Camera]) -> str:
    """Pictures of the mesh as clay and in its colours.

    Raises
    ------
    DataError
        The file is broken.
    """
    if not path.is_file():
        return missing("There is no mesh.ply (gs2d mesh RUN makes it).")
    mesh = read_mesh(path)
    if not len(mesh.faces):
        return missing("mesh.ply has no faces: no surface was covered well enough.")
    counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    if len(mesh.faces) > MAX_FACES:
        return missing(f"mesh.ply has {counts}: too many for a picture here (at most {MAX_FACES:,} faces).")
    chosen = tuple(cameras)[:3] or orbit_cameras(mesh)
    where = "from cameras of the capture" if cameras else "from two sides, taking the third axis as up"
    figures = []
    for shown in mesh_images(mesh, chosen):
        pair = image_tag(shown.shape, alt="the mesh as clay", width=420)
        if shown.color is not None:
            pair += image_tag(shown.color, alt="the mesh in its vertex colours", width=420)
        figures.append(f'<div class="pair">{pair}</div>')
    words = "as clay and in its vertex colours" if mesh.colors is not None else "as clay (it has no vertex colours)"
    return f'<div class="meshes">{"".join(figures)}</div><p class="soft">The mesh, {counts}, {words}, {where}.</p>'
