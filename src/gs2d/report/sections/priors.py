"""What was known beforehand of the photographs, in the report: in words, as a plot, and beside what is rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gs2d.core.images import read_image
from gs2d.report.html import missing, render
from gs2d.report.plots import INK, plot_by_image, svg_text

TITLES = {
    "known-depth": "known depth",
    "depth": "rendered depth",
    "known-normal": "known normals",
    "normal": "rendered normals",
}


def priors_section(folder: Path, stages: Sequence[Mapping[str, Any]]) -> Markup:
    """Sentences, plots and pictures (HTML).

    Parameters
    ----------
    folder : Path
        With the pictures.
    stages : sequence of mapping
        Entries of metrics.json.
    """
    last = stages[-1] if stages else {}
    depth, normal = _figures(last.get("depth_prior")), _figures(last.get("normal_prior"))
    if depth is None and normal is None:
        return missing("no stage is finished and measured yet.")
    figures = []
    if depth is not None:
        text = f"rendered and known depth differ by {100 * depth[1]:.2f} % of the depth"
        figures.append({"text": text, "title": "Error of depth by photograph, %", "plot": _plot(100 * depth[0])})
    if normal is not None:
        text = f"rendered and known normals differ by {normal[1]:.1f} degrees"
        title = "Error of normals by photograph, degrees"
        figures.append({"text": text, "title": title, "plot": _plot(normal[0])})
    views = _views(folder, last.get("priors_shown"))
    return render("priors.html", figures=figures, stage=last.get("name", "training"), views=views)


def _figures(entry: Any) -> tuple[np.ndarray, float] | None:
    """Errors by view, and their median, if an entry of metrics.json has them."""
    by_view = entry.get("by_view") if isinstance(entry, Mapping) else None
    if not isinstance(by_view, Mapping) or not all(isinstance(value, int | float) for value in by_view.values()):
        return None
    values = np.array(list(by_view.values()), dtype=np.float64)
    return (values, float(np.median(values))) if len(values) else None


def _views(folder: Path, shown: Any) -> list[dict[str, Any]]:
    """Return what is known beside what is rendered: names of views, and titles and pictures of each."""
    views = []
    for view in shown if isinstance(shown, list) else ():
        paths = [(title, folder / f"{view.get('file')}.{kind}.png") for kind, title in TITLES.items()]
        images = [(title, read_image(path)) for title, path in paths if path.is_file()]
        if images:
            views.append({"name": str(view.get("name")), "images": images})
    return views


def _plot(values: np.ndarray) -> str:
    figure, axes = plot_by_image(2.4)
    axes.bar(np.arange(1, len(values) + 1), values, color="#3f86d6")
    axes.set_ylim(bottom=0)
    axes.tick_params(colors=INK)
    return svg_text(figure)
