"""Reports of single losses: a figure per photograph, and images of a few."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gs2d.data.image_files import read_image
from gs2d.io.run_dir import LOSSES, RENDERS
from gs2d.report.html_parts import render
from gs2d.report.plots import INK, plot_by_image, svg_text
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import register_section


@register_section("losses", title="Losses by photograph")
def losses_section(run: RunRecord) -> str | None:
    """Return the report of each loss that has one, after the last stage."""
    found = run.last.get("losses")
    entries = [(name, e) for name, e in found.items() if isinstance(e, Mapping)] if isinstance(found, Mapping) else []
    parts = [_of_loss(run, str(name), entry) for name, entry in entries]
    return Markup("\n").join(parts) if parts else None


def _of_loss(run: RunRecord, name: str, entry: Mapping[str, Any]) -> Markup:
    values = _figures(entry.get("by_view"))
    return render(
        "losses.html",
        title=str(entry.get("title", name)),
        figure=str(entry.get("figure", name)),
        median=None if values is None else float(np.median(values)),
        plot=None if values is None else _plot(values),
        views=_views(run.path / RENDERS / LOSSES, entry.get("shown")),
    )


def _figures(by_view: Any) -> np.ndarray | None:
    """Return the figure of each view, if an entry of metrics.json has them."""
    if not isinstance(by_view, Mapping) or not all(isinstance(value, int | float) for value in by_view.values()):
        return None
    return np.array(list(by_view.values()), dtype=np.float64) if by_view else None


def _views(folder: Path, shown: Any) -> list[dict[str, Any]]:
    """Return the names of views with the titles and pixels of their images."""
    views = []
    for view in shown if isinstance(shown, list) else ():
        paths = view.get("images") if isinstance(view, Mapping) else None
        named = paths.items() if isinstance(paths, Mapping) else ()
        images = [(title, read_image(folder / path)) for title, path in named if (folder / path).is_file()]
        if images:
            views.append({"name": str(view.get("name")), "images": images})
    return views


def _plot(values: np.ndarray) -> str:
    figure, axes = plot_by_image(2.4)
    axes.bar(np.arange(1, len(values) + 1), values, color="#3f86d6")
    axes.set_ylim(bottom=0)
    axes.tick_params(colors=INK)
    return svg_text(figure)
