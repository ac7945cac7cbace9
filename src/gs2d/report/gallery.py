"""The rendered views of a run, read from ``renders/``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.json_files import read_json
from gs2d.data.image_files import read_image
from gs2d.io.run_dir import RENDERS
from gs2d.report.html_parts import Pair
from gs2d.report.run_record import reading

PHOTOS = "photos"


@dataclass(frozen=True)
class ShownView:
    """A rendered view; ``file`` is the stem of its file names, ``depth_limits`` are in world units."""

    name: str
    file: str
    split: str
    camera: Camera
    depth_limits: tuple[float, float] | None = None

    @property
    def kind(self) -> str:
        """Return "training view", "test view", or nothing if the split is unknown."""
        return {"train": "training view", "test": "test view"}.get(self.split, "")


@dataclass(frozen=True)
class Gallery:
    """The views and stages in ``renders/``."""

    folder: Path
    views: tuple[ShownView, ...]
    stages: tuple[str, ...]

    def photo(self, view: ShownView) -> np.ndarray | None:
        """Return the photograph of a view, or None."""
        return _read(self.folder / PHOTOS / f"{view.file}.png")

    def rendering(self, stage: str, view: ShownView, kind: str) -> np.ndarray | None:
        """Return a rendering of a view, or None."""
        return _read(self.folder / stage / f"{view.file}.{kind}.png")

    def beside(self, view: ShownView, stage: str = PHOTOS, kind: str = "") -> str:
        """Return the path of an image relative to the report."""
        return f"{RENDERS}/{stage}/{view.file}.{kind}.png" if kind else f"{RENDERS}/{stage}/{view.file}.png"


def _read(path: Path) -> np.ndarray | None:
    return read_image(path) if path.is_file() else None


def read_gallery(renders: Path) -> Gallery | None:
    """Return the gallery, or None where there is no ``index.json``; raise DataError if the index is broken."""
    path = renders / "index.json"
    if not path.is_file():
        return None
    with reading(path):
        data = read_json(path)
        return Gallery(renders, tuple(map(_shown_view, data["views"])), tuple(map(str, data["stages"])))


def _shown_view(entry: dict[str, Any]) -> ShownView:
    """Return an entry of ``views``."""
    name, limits = entry["name"], entry.get("depth_limits")
    depth_limits = None if limits is None else (float(limits[0]), float(limits[1]))
    file, split = str(entry.get("file", name)), str(entry.get("split", ""))
    return ShownView(str(name), file, split, Camera(**entry["camera"]), depth_limits)


def compared(gallery: Gallery, view: ShownView, *, width: int = 800) -> Pair | None:
    """Return the photograph of a view and its rendering after the last stage, or None where one is missing."""
    if not gallery.stages:
        return None
    stage = gallery.stages[-1]
    photo, color = gallery.photo(view), gallery.rendering(stage, view, "color")
    if photo is None or color is None or photo.shape[:2] != color.shape[:2]:
        return None
    return Pair(
        (photo, color),
        ("photograph", "rendering"),
        title=f"{view.name} ({view.kind})" if view.kind else view.name,
        full=(gallery.beside(view), gallery.beside(view, stage, "color")),
        width=width,
    )
