"""Draw images of finished captures: photograph, rendering of a test view, normals and mesh, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from PIL import Image

from benchmarks.figure import images_of, views_of
from gs2d.io.run_dir import MESH, METRICS

HEIGHT, GAP, QUALITY = 240, 4, 85  # px, px, JPEG quality
KINDS = ("color", "normal")


class Shown(Protocol):
    """Interface of a capture in the gallery."""

    @property
    def name(self) -> str:
        """Return the display name."""

    @property
    def licence(self) -> str:
        """Return the licence of the photographs."""

    @property
    def may_be_shown(self) -> bool:
        """Return True if images of the capture may be published."""


def gallery_row(run: Path, height: int = HEIGHT) -> Image.Image:
    """Return the middle rendered view of a run as photograph, rendering, normals and mesh at one height."""
    view = views_of(run) // 2
    images = [
        Image.fromarray(p).resize((max(1, round(height * p.shape[1] / p.shape[0])), height), Image.Resampling.LANCZOS)
        for p in images_of(run, view, None, KINDS)
    ]
    row = Image.new("RGB", (sum(p.width for p in images) + GAP * (len(images) - 1), height), "white")
    left = 0
    for image in images:
        row.paste(image, (left, 0))
        left += image.width + GAP
    return row


def write_gallery(folder: Path, captures: Sequence[Shown], runs: Path, quality: str) -> list[Path]:
    """Write a JPEG per finished run and a page that lists which may be published; return the image paths."""
    folder.mkdir(parents=True, exist_ok=True)
    files, lines = [], ["| capture | photograph, rendering, normals, mesh | may be published |", "|---|---|---|"]
    for capture in captures:
        run = runs / capture.name / "run"
        if not ((run / MESH).exists() and (run / METRICS).exists()):
            lines.append(f"| {capture.name} | not finished | |")
            continue
        file = folder / f"{capture.name}-{quality}.jpg"
        gallery_row(run).save(file, quality=QUALITY)
        may = "yes" if capture.may_be_shown else "no"
        lines.append(f"| {capture.name} | ![{capture.name}]({file.name}) | {may}: {capture.licence} |")
        files.append(file)
    (folder / f"gallery-{quality}.md").write_text("\n".join(lines) + "\n")
    return files
