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
    entries = run.last.get("losses") or {}
    parts = [_loss_part(run, name, entry) for name, entry in entries.items()]
    return Markup("\n").join(parts) if parts else None


def _loss_part(run: RunRecord, name: str, entry: Mapping[str, Any]) -> Markup:
    values = np.array(list((entry.get("by_view") or {}).values()), np.float64)
    return render(
        "losses.html",
        title=str(entry.get("title", name)),
        figure=str(entry.get("figure", name)),
        median=float(np.median(values)) if len(values) else None,
        plot=_plot(values) if len(values) else None,
        views=[_view(run.path / RENDERS / LOSSES, view) for view in entry.get("shown") or ()],
    )


def _view(folder: Path, view: Mapping[str, Any]) -> dict[str, Any]:
    """Return the name of a view, and its images that exist, by title."""
    paths = {title: folder / path for title, path in view["images"].items()}
    return {"name": view["name"], "images": {title: read_image(p) for title, p in paths.items() if p.is_file()}}


def _plot(values: np.ndarray) -> str:
    figure, axes = plot_by_image(2.4)
    axes.bar(np.arange(1, len(values) + 1), values, color="#3f86d6")
    axes.set_ylim(bottom=0)
    axes.tick_params(colors=INK)
    return svg_text(figure)
