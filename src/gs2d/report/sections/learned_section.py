"""Learned properties of photographs and cameras: exposure, poses and intrinsics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gs2d.core.camera import Zoom
from gs2d.core.json_files import read_json
from gs2d.io.run_dir import LEARNED, POSES
from gs2d.report.html_parts import macro
from gs2d.report.run_record import RunRecord, reading
from gs2d.report.sections.section_registry import register_section


@register_section("learned", title="Learned exposures and cameras")
def learned_section(run: RunRecord) -> str | None:
    """Return a paragraph for each file of learned properties; None if the run has none."""
    paragraphs: list[str] = []
    for name, describe in _FILES.items():
        path = run.path / name
        if not path.is_file():
            continue
        with reading(path):
            paragraphs += filter(None, [describe(read_json(path))])
    return macro("lists.html", "paragraphs", paragraphs) if paragraphs else None


def _appearance(data: Mapping[str, Any]) -> str:
    grey = {
        str(name): np.array([*[0.5] * 3, 1.0]) @ np.array(found["exposure"], np.float64).mean(axis=0)
        for name, found in data["views"].items()
        if "exposure" in found
    }
    gains = {name: float(value) / 0.5 for name, value in grey.items()}
    if not gains:
        return ""
    dark, bright = min(gains, key=gains.__getitem__), max(gains, key=gains.__getitem__)
    return (
        f"Exposure: {dark} is the darkest photograph ({gains[dark]:.2f} times the mean brightness), {bright} the "
        f"brightest ({gains[bright]:.2f} times). Training views are scored in the exposure of their photograph, "
        "test views in a predicted one. The mesh and new renderings use the mean exposure."
    )


def _poses(data: Mapping[str, Any]) -> str:
    moved = {str(entry["name"]): entry["moved"] for entry in data["frames"] if entry["split"] == "train"}
    pixels = {name: float(motion["pixels"]) for name, motion in moved.items()}
    degrees, farthest = np.mean([motion["degrees"] for motion in moved.values()]), max(pixels, key=pixels.__getitem__)
    text = (
        f"Poses: training cameras moved by {np.mean(list(pixels.values())):.2f} px on average ({degrees:.3f} degrees); "
        f"{farthest} moved most ({pixels[farthest]:.2f} px). Test views keep the cameras of the capture."
    )
    zooms = {tuple(map(float, entry["zoom"])) for entry in data["frames"] if "zoom" in entry}
    if zooms:
        lenses = [Zoom(*zoom) for zoom in sorted(zooms)]
        focal = ", ".join(f"{lens.scale:.4f}" for lens in lenses)
        distortion = ", ".join(f"k1 {lens.k1:+.4f} k2 {lens.k2:+.4f}" for lens in lenses if lens.k1 or lens.k2)
        text += f" Focal lengths changed by a factor of {focal}."
        text += f" Distortion: {distortion}." if distortion else ""
    return text


_FILES: dict[str, Callable[[Mapping[str, Any]], str]] = {LEARNED: _appearance, POSES: _poses}
