"""The surface in the report: scores against the true surface, and what each figure means."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.report_html import escape, missing, table

SCORES = (
    "Precision: the share of the mesh that is nearer to the true surface than the distance in the first column. "
    "Recall: the share of the true surface that is nearer to the mesh. F-score: their harmonic mean. Only what the "
    "training views see counts; the distance is in the units of the true surface."
)
_MEANINGS = {  # of the entries of metrics.json, in the order of the report
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
    "reason": ("No score", "why there is none"),
}


def surface_scores(surface: Mapping[str, Any] | None, reason: str | None) -> str:
    """Distances and scores against the true surface as HTML, or why there are none."""
    if not surface:
        why = reason or "no true surface was given (gs2d evaluate RUN --ground-truth FILE)"
        return missing(f"The surface was not scored: {why}.")
    parts = []
    rows = [
        [f"{row['threshold']:.4g}", *(_score(row.get(name)) for name in ("precision", "recall", "f_score"))]
        for row in surface.get("thresholds") or []
    ]
    if rows:
        parts.append(table(["Nearer than", "Precision", "Recall", "F-score"], rows))
        parts.append(f'<p class="soft">{escape(SCORES)}</p>')
    names = [*(name for name in _MEANINGS if name in surface), *(name for name in surface if name not in _MEANINGS)]
    figures = [_row(name, surface[name]) for name in names if _is_figure(surface[name])]
    if figures:
        parts.append(table(["Figure", "Value", "Meaning"], figures, texts=(2,)))
    return "".join(parts) or missing("metrics.json has a surface entry without figures.")


def _is_figure(value: Any) -> bool:
    return isinstance(value, int | float | str)


def _score(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, int | float) else "-"


def _row(name: str, value: Any) -> list[str]:
    label, meaning = _MEANINGS.get(name, (name.replace("_", " ").capitalize(), ""))
    if name == "ground_truth":
        shown = Path(str(value)).name
    elif name.endswith("_hidden") and isinstance(value, float):
        shown = f"{100 * value:.1f} %"
    elif isinstance(value, float):
        shown = f"{value:.5g}"
    else:
        shown = f"{value:,}" if isinstance(value, int) else str(value)
    return [escape(label), escape(shown), escape(meaning)]
