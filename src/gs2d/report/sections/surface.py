"""The surface in the report: scores against the true surface, and what each figure means."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gs2d.data.image_files import read_image
from gs2d.report.html import missing, render
from gs2d.report.terms import titles_of

SCORES = (
    "Precision: the share of the mesh that is nearer to the true surface than the distance in the first column. "
    "Recall: the share of the true surface that is nearer to the mesh. F-score: their harmonic mean. "
)
_COUNTS = {  # by evaluator
    "visible-surface": "Only what the training views see counts; the distance is in the units of the true surface.",
    "tnt": "Only what lies in the scene's crop volume counts, after the mesh was aligned with the scan.",
}
CLOUDS = (
    "Above the mesh, below the true surface, along three axes: green where the other one is near, yellow to red where "
    "it is far, grey where it is out of reach. The point clouds lie beside it, in surface/."
)
_IN_TABLE = ("threshold", "precision", "recall", "f_score")
_MEANINGS = {  # of the entries of metrics.json, in the order of the report
    "evaluator": ("Protocol", "how it was scored (docs/guides/evaluation.md)"),
    "unit": ("Unit", "of the distances"),
    "ground_truth": ("True surface", "the file that the mesh is compared with"),
    "accuracy": ("Accuracy", "mean distance from the mesh to the true surface"),
    "completeness": ("Completeness", "mean distance from the true surface to the mesh"),
    "chamfer": ("Chamfer distance", "mean of accuracy and completeness"),
    "accuracy_median": ("Accuracy, median", "half of the mesh is nearer to the true surface than this"),
    "completeness_median": ("Completeness, median", "half of the true surface is nearer to the mesh than this"),
    "diagonal": ("Size", "diagonal of the box around the true surface, to judge the distances by"),
    "mesh_points": ("Points on the mesh", "that were compared"),
    "truth_points": ("Points on the true surface", "that were compared"),
    "mesh_hidden": ("Mesh hidden", "share of the mesh that no training view sees; it counts for nothing"),
    "truth_hidden": ("Truth hidden", "share of the true surface that fewer than three training views see; not counted"),
    "dropped_mesh": ("Mesh dropped", "share of the mesh's points that is too far from the scan to count"),
    "dropped_truth": ("Truth dropped", "share of the scan's points that is too far from the mesh to count"),
    "culled": ("Mesh culled", "share of the mesh's corners outside some photograph's silhouette"),
    "reason": ("No score", "why there is none"),
}
_FRACTIONS = ("mesh_hidden", "truth_hidden", "dropped_mesh", "dropped_truth", "culled")


def surface_scores(surface: Mapping[str, Any] | None, reason: str | None, folder: Path | None = None) -> Markup:
    """Distances and scores against the true surface as HTML, or why there are none.

    Parameters
    ----------
    surface : mapping or None
        The entry of ``metrics.json``.
    reason : str or None
        Why there is none.
    folder : Path, optional
        The run: where the picture that the entry names lies.
    """
    if not surface:
        why = reason or "no true surface was given (gs2d evaluate RUN --ground-truth FILE)"
        return missing(f"The surface was not scored: {why}.")
    scores = [
        [f"{row['threshold']:.4g}", *(_score(row.get(name)) for name in ("precision", "recall", "f_score"))]
        for row in surface.get("thresholds") or []
    ]
    rest = (name for name in surface if name not in _MEANINGS and name not in _IN_TABLE)
    names = [*(name for name in _MEANINGS if name in surface), *rest]
    values: dict[str, Any] = {
        "scores": scores,
        "doubts": _doubts(surface.get("self_check")),
        "figures": [_row(name, surface[name]) for name in names if _is_figure(surface[name])],
        "pixels": _image(surface.get("files"), folder),
    }
    if not any(value is not None and len(value) for value in values.values()):
        return missing("metrics.json has a surface entry without figures.")
    columns = ["Nearer than", "Precision", "Recall", "F-score"]
    meaning = SCORES + _COUNTS.get(str(surface.get("evaluator", "visible-surface")), "")
    about = {"columns": columns, "titles": titles_of(columns), "meaning": meaning, "clouds": CLOUDS}
    return render("surface.html", **values, **about)


def _doubts(check: Any) -> list[str]:
    """Return what the score's own check says: whether both surfaces lie in one place at all."""
    if not isinstance(check, Mapping):
        return []
    messages = [str(message) for message in check.get("messages") or ()]
    if not check.get("ok", True):
        messages = ["Do not believe these figures, their own check failed: " + ("; ".join(messages) or "no score")]
    return messages


def _image(files: Any, folder: Path | None) -> np.ndarray | None:
    """Return the scored points of both sides, coloured by distance."""
    name = files.get("picture") if isinstance(files, Mapping) else None
    if folder is None or name is None or not (folder / name).is_file():
        return None
    return read_image(folder / name)


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
