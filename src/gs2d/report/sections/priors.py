"""What was known beforehand of the photographs, in the report: in words, as a plot, and beside what is rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.images import read_image
from gs2d.report.html import drawing, escape, image_tag, missing
from gs2d.report.plots import INK, plot_by_image, svg_text

TITLES = {
    "known-depth": "known depth",
    "depth": "rendered depth",
    "known-normal": "known normals",
    "normal": "rendered normals",
}


def priors_section(folder: Path, stages: Sequence[Mapping[str, Any]]) -> str:
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
    parts = []
    for found, name, text, title in (
        (depth, "depth_prior", "rendered and known depth differ by {} of the depth", "Error of depth by photograph, %"),
        (normal, "normal_prior", "rendered and known normals differ by {}", "Error of normals by photograph, degrees"),
    ):
        if found is None:
            continue
        by_view, median = found
        figures = 100 * by_view if name == "depth_prior" else by_view
        value = f"{100 * median:.2f} %" if name == "depth_prior" else f"{median:.1f} degrees"
        words = (
            f"In the middle pixel of the middle photograph {text.format(value)}, after {last.get('name', 'training')}."
        )
        parts.append(f"<p>{escape(words)} What is known may be wrong: its weight falls as training goes on.</p>")
        parts.append(f'<div class="curves">{drawing(_plot(figures), title)}</div>')
    return "".join(parts) + _images(folder, last.get("priors_shown"))


def _figures(entry: Any) -> tuple[np.ndarray, float] | None:
    """Errors by view, and their median, if an entry of metrics.json has them."""
    by_view = entry.get("by_view") if isinstance(entry, Mapping) else None
    if not isinstance(by_view, Mapping) or not all(isinstance(value, int | float) for value in by_view.values()):
        return None
    values = np.array(list(by_view.values()), dtype=np.float64)
    return (values, float(np.median(values))) if len(values) else None


def _images(folder: Path, shown: Any) -> str:
    """What is known beside what is rendered."""
    parts = []
    for view in shown if isinstance(shown, list) else ():
        figures = []
        for kind, title in TITLES.items():
            path = folder / f"{view.get('file')}.{kind}.png"
            if path.is_file():
                figures.append(image_tag(read_image(path), title, alt=f"{title} of {view.get('name')}", width=420))
        if figures:
            parts.append(f'<h3>{escape(str(view.get("name")))}</h3><div class="hero">{"".join(figures)}</div>')
    return "".join(parts)


def _plot(values: np.ndarray) -> str:
    figure, axes = plot_by_image(2.4)
    axes.bar(np.arange(1, len(values) + 1), values, color="#3f86d6")
    axes.set_ylim(bottom=0)
    axes.tick_params(colors=INK)
    return svg_text(figure)
