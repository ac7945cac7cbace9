"""Scores of the mesh against the true surface."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.data.image_files import read_image
from gs2d.report.html_parts import render
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import register_section

_COLUMNS = {"threshold": "Threshold", "precision": "Precision", "recall": "Recall", "f_score": "F-score"}
_COUNTED = {  # by evaluator
    "visible-surface": "Only surface that training views see counts. Thresholds are in units of the true surface.",
    "tnt": "Only the crop volume of the scene counts, after alignment with the scan.",
}
_CLOUDS = (
    "Mesh above, true surface below, along three axes: green where the other surface is close, red where it is far, "
    "grey out of reach. The point clouds are in surface/."
)
_MEANINGS = {  # entries of metrics.json, in the order of the report
    "evaluator": ("Protocol", ""),
    "unit": ("Unit", "of all distances"),
    "ground_truth": ("True surface", ""),
    "accuracy": ("Accuracy", "mean distance from the mesh to the true surface"),
    "completeness": ("Completeness", "mean distance from the true surface to the mesh"),
    "chamfer": ("Chamfer distance", "mean of accuracy and completeness"),
    "accuracy_median": ("Accuracy, median", ""),
    "completeness_median": ("Completeness, median", ""),
    "diagonal": ("Size", "diagonal of the bounding box of the true surface"),
    "mesh_points": ("Points on the mesh", ""),
    "truth_points": ("Points on the true surface", ""),
    "mesh_hidden": ("Mesh hidden", "share of the mesh that no training view sees; it does not count"),
    "truth_hidden": ("Truth hidden", "share of the true surface that fewer than three training views see; not counted"),
    "dropped_mesh": ("Mesh dropped", "share of the mesh that is too far from the scan to count"),
    "dropped_truth": ("Truth dropped", "share of the scan that is too far from the mesh to count"),
    "culled": ("Mesh culled", "share of the mesh outside the silhouette of a photograph"),
    "reason": ("No score", "reason"),
}
_FRACTIONS = ("mesh_hidden", "truth_hidden", "dropped_mesh", "dropped_truth", "culled")


@register_section("surface", title="Surface scores")
def surface_section(run: RunRecord) -> str | None:
    """Return scores and distances, or the reason why there are none; None for runs without a true surface."""
    surface = run.surface
    if not surface:
        return None
    scores = [
        [f"{row['threshold']:.4g}", *(_score(row.get(name)) for name in list(_COLUMNS)[1:])]
        for row in surface.get("thresholds") or []
    ]
    rest = (name for name in surface if name not in _MEANINGS and name not in _COLUMNS)
    names = [*(name for name in _MEANINGS if name in surface), *rest]
    columns = list(_COLUMNS.values())
    return render(
        "surface.html",
        scores=scores,
        columns=columns,
        counted=_COUNTED.get(str(surface.get("evaluator", "visible-surface")), ""),
        warnings=_warnings(surface.get("self_check") or {}),
        figures=[_row(name, surface[name]) for name in names if _is_figure(surface[name])],
        pixels=_image(surface.get("files"), run.path),
        clouds=_CLOUDS,
    )


def _warnings(check: Mapping[str, Any]) -> list[str]:
    """Return the messages of the alignment check."""
    messages = [str(message) for message in check.get("messages") or ()]
    return messages if check.get("ok", True) else [f"These scores are not reliable: {'; '.join(messages)}."]


def _image(files: Any, folder: Path) -> np.ndarray | None:
    """Return the image of the scored points, coloured by distance."""
    name = files.get("picture") if isinstance(files, Mapping) else None
    return None if name is None or not (folder / name).is_file() else read_image(folder / name)


def _is_figure(value: Any) -> bool:
    return isinstance(value, int | float | str) and not isinstance(value, bool)


def _score(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, int | float) else "-"


def _row(name: str, value: Any) -> list[str]:
    label, meaning = _MEANINGS.get(name, (name.replace("_", " ").capitalize(), ""))
    if name == "ground_truth":
        shown = Path(str(value)).name
    elif name in _FRACTIONS and isinstance(value, float):
        shown = f"{100 * value:.1f} %"
    elif isinstance(value, float):
        shown = f"{value:.5g}"
    else:
        shown = f"{value:,}" if isinstance(value, int) else str(value)
    return [label, shown, meaning]
