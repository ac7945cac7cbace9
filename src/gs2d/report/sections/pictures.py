"""The pictures of the report: renderings of every stage beside the photographs, and the mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gs2d.core.camera import Camera
from gs2d.core.images import composite
from gs2d.core.json_files import read_json
from gs2d.data.image_files import read_image
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh, read_textured
from gs2d.io.run_dir import RENDERS, TEXTURED
from gs2d.report.html import Pair, missing, render
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
        """Return the photograph of a view."""
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
    """Return the gallery by its ``index.json``; None where there is none.

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
    words = all(isinstance(entry.get(name, ""), str) for name in ("file", "split"))
    return known and words and isinstance(entry.get("camera", {}), dict)


def hero(renders: Path) -> Markup:
    """Return the first view large: the photograph wiped over the last stage's colour; its normal and its depth."""
    gallery = read_gallery(renders)
    if gallery is None or not gallery.views or not gallery.stages:
        return Markup()
    view, stage = gallery.views[0], gallery.stages[-1]
    pair = compared(gallery, view, width=1000)
    figures = [] if pair else [("Photograph", gallery.photo(view), gallery.beside(view))]
    figures += [
        (f"{KINDS[kind]}, {stage}", gallery.rendering(stage, view, kind), gallery.beside(view, stage, kind))
        for kind in (("normal", "depth") if pair else ("color", "normal", "depth"))
    ]
    there = [{"title": t, "pixels": pixels, "full": full} for t, pixels, full in figures if pixels is not None]
    return render("hero.html", pair=pair, images=there, name=view.name)


def compared(gallery: Gallery, view: ShownView, *, width: int = 800) -> Pair | None:
    """Return the photograph of a view and the last stage's rendering of it; None where there are not both."""
    stage = gallery.stages[-1]
    photo, color = gallery.photo(view), gallery.rendering(stage, view, "color")
    if photo is None or color is None or photo.shape[:2] != color.shape[:2]:
        return None
    split = f" ({view.split} view)" if view.split else ""
    return Pair(
        (photo, color),
        ("photograph", "rendering"),
        title=f"{view.name}{split}, {_psnr_caption(color, photo)}",
        full=(gallery.beside(view), gallery.beside(view, stage, "color")),
        width=width,
    )


def view_sections(renders: Path, *, expected_stages: Sequence[str]) -> Markup:
    """Return a grid for every shown view: kinds of picture down, photograph and stages across."""
    gallery = read_gallery(renders)
    if gallery is None or not gallery.views:
        return missing("renders/ holds no pictures (gs2d render RUN makes them).")
    stages = list(dict.fromkeys([*gallery.stages, *expected_stages]))
    solid = np.tile(np.array(HIGHLIGHT, dtype=np.float32), (2, 1))
    fade = np.stack([np.full(3, 0.8, dtype=np.float32), solid[0]])
    return render(
        "views.html",
        views=[_shown(gallery, view, stages) for view in gallery.views[:MAX_VIEWS]],
        stages=stages,
        left=max(len(gallery.views) - MAX_VIEWS, 0),
        scales={"error": error_scale(9), "depth": depth_scale(9), "high_error": fade},
        top=f"{ERROR_TOP:g}",
    )


def _shown(gallery: Gallery, view: ShownView, stages: Sequence[str]) -> dict[str, Any]:
    """Return what the grid of a view shows: a row for each kind of picture, a cell for each stage."""
    photo = gallery.photo(view)
    limits = ("near", "far") if view.depth_limits is None else tuple(f"{limit:.3g}" for limit in view.depth_limits)
    rows = []
    for kind, title in KINDS.items():
        cells = []
        for stage in stages:
            pixels = gallery.rendering(stage, view, kind)
            caption = _psnr_caption(pixels, photo) if kind == "color" and pixels is not None else ""
            why, full = _why_missing(kind, stage), gallery.beside(view, stage, kind)
            cells.append({"stage": stage, "pixels": pixels, "caption": caption, "full": full, "why": why})
        rows.append({"kind": kind, "title": title, "cells": cells})
    on_top = view is gallery.views[0] or not gallery.stages
    return {
        "name": view.name,
        "split": view.split,
        "pair": None if on_top else compared(gallery, view),
        "photo": photo,
        "photo_file": gallery.beside(view),
        "limits": limits,
        "rows": rows,
    }


def _why_missing(kind: str, stage: str) -> str:
    if kind == "high_error":
        return "no splats were ranked by error up to this stage"
    return f"not rendered for {stage}"


def _psnr_caption(image: np.ndarray, photo: np.ndarray | None) -> str:
    """PSNR of the two 8-bit pictures, where they have the same size."""
    if photo is None or image.shape[:2] != photo.shape[:2]:
        return ""
    white = (1.0, 1.0, 1.0)
    difference = composite(image, white).astype(np.float64) - composite(photo, white)
    squared = float(np.mean(difference**2))
    return "equal" if squared == 0 else f"{-10 * np.log10(squared):.2f} dB"


def mesh_section(path: Path, cameras: Sequence[Camera]) -> Markup:
    """Return pictures of the mesh as clay and in its colours: those of the textured mesh beside it, if there is one.

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
    textured = read_textured(path.with_name(TEXTURED)) if path.with_name(TEXTURED).is_file() else None
    where = "from cameras of the capture" if cameras else "from two sides, taking the third axis as up"
    return render(
        "mesh.html",
        images=mesh_images(mesh, chosen, textured),
        counts=counts,
        coloring="with its texture" if textured else "in its vertex colours" if mesh.colors is not None else "",
        where=where,
    )
