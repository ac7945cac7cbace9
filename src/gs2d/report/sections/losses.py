"""What the losses with a report of their own say, in the report: a figure by photograph, and pictures of a few."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gs2d.data.image_files import read_image
from gs2d.report.html import missing, render
from gs2d.report.plots import INK, plot_by_image, svg_text


def loss_titles(stages: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the headings of the sections, by name of the loss, from the entries of metrics.json."""
    return {name: str(entry.get("title", name)) for name, entry in _last(stages).items()}


def loss_section(folder: Path, stages: Sequence[Mapping[str, Any]], name: str) -> Markup:
    """Return a sentence, a plot and pictures (HTML).

    Parameters
    ----------
    folder : Path
        With the pictures.
    stages : sequence of mapping
        Entries of metrics.json.
    name : str
        Of the loss.
    """
    entry = _last(stages)[name]
    values = _figures(entry.get("by_view"))
    views = _views(folder, entry.get("shown"))
    if values is None and not views:
        return missing("there was nothing to say of any photograph.")
    figure = str(entry.get("figure", name))
    return render(
        "losses.html",
        figure=figure,
        median=None if values is None else float(np.median(values)),
        plot=None if values is None else _plot(values),
        stage=stages[-1].get("name", "training"),
        views=views,
    )


def _last(stages: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Return the entries of the last stage that has some; those of 0.1 about known depths and normals have no title."""
    last = stages[-1] if stages else {}
    found = last.get("losses")
    found = dict(found) if isinstance(found, Mapping) else {}
    old = {"depth_prior": ("Known depths", "relative error of depth"), "normal_prior": ("Known normals", "degrees")}
    for name, (title, figure) in old.items():
        if isinstance(last.get(name), Mapping):
            found[name] = {"title": title, "figure": figure, **last[name]}
    return {str(name): entry for name, entry in found.items() if isinstance(entry, Mapping)}


def _figures(by_view: Any) -> np.ndarray | None:
    """Return the figures of the views, if an entry of metrics.json has them."""
    if not isinstance(by_view, Mapping) or not all(isinstance(value, int | float) for value in by_view.values()):
        return None
    return np.array(list(by_view.values()), dtype=np.float64) if by_view else None


def _views(folder: Path, shown: Any) -> list[dict[str, Any]]:
    """Return names of views, with titles and pictures of each."""
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
