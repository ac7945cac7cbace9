"""Diagrams that compare the logs of several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gs2d.report.plots import INK, History, draw_stages, dress_axes, line_style, svg_text


@dataclass(frozen=True)
class Panel:
    """One diagram of a comparison, and the series that it shows."""

    series: str
    title: str
    log: bool = False
    smooth: bool = False


def compared_runs(histories: Mapping[str, History], panels: Sequence[Panel]) -> str | None:
    """Compare runs: one diagram per panel, one line per run, a common legend.

    Parameters
    ----------
    histories : mapping of label to History
    panels : sequence of Panel
        At most four; those without data are left out.

    Returns
    -------
    str or None
        SVG; None without data.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    shown = [panel for panel in panels if any(panel.series in history.series for history in histories.values())]
    if not shown:
        return None
    rows = -(-len(shown) // 2)
    columns = -(-len(shown) // rows)
    figure = Figure(figsize=(4.6 * columns, 2.7 * rows + 0.3), layout="constrained")
    FigureCanvasSVG(figure)
    longest = max(histories.values(), key=lambda history: max((span.stop for span in history.stages), default=0))
    for axes, panel in zip(figure.subplots(rows, columns, squeeze=False).flat, shown, strict=False):
        for k, (label, history) in enumerate(histories.items()):
            draw_stages(axes, history, panel.series, label=label, smooth=panel.smooth, **line_style(k))
        dress_axes(axes, longest, log=panel.log, legend=False)
        axes.set_title(panel.title, fontsize=9, color=INK, pad=16 if len(longest.stages) > 1 else 6)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=min(4, len(labels)),
        fontsize=8,
        frameon=False,
        labelcolor=INK,
    )
    return svg_text(figure)
