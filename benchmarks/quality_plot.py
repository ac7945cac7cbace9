"""Plot time to quality: PSNR, and F-score at 0.25 % if the true surface is known, against seconds, for each capture.

A marker is the end of a complete schedule with that many iterations; markers of one recipe are joined. A faint line is
the intermediate quality during one training. Intermediate points have no markers, because their learning rates and
densification are unfinished: half of a long schedule is not a short schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gs2d.report.plots import INK, line_style, svg_text

FRACTION = "0.0025"  # fraction of the true surface's diagonal; coarser thresholds give F near 1 for every recipe
TIMES = {"user_seconds": "user CPU seconds", "seconds": "seconds"}

Value = Callable[[dict[str, Any]], float | None]


def psnr_of(point: dict[str, Any]) -> float | None:
    """Return the PSNR of a point, dB."""
    value = point.get("images", {}).get("psnr")
    return None if value is None else float(value)


def f_of(point: dict[str, Any]) -> float | None:
    """Return the F-score of a point's mesh, or None without a true surface."""
    value = (point.get("surface") or {}).get("f_scores", {}).get(FRACTION)
    return None if value is None else float(value)


def ends(curve: dict[str, Any], time: str, value: Value) -> tuple[list[float], list[float]]:
    """Return seconds and means over seeds of a curve, one per schedule, shortest first."""
    scales = sorted({run["scale"] for run in curve["runs"]})
    xs, ys = [], []
    for scale in scales:
        rows = [(run[time], value(run)) for run in curve["runs"] if run["scale"] == scale]
        known = [(x, y) for x, y in rows if y is not None]
        if known:
            xs.append(sum(x for x, _ in known) / len(known))
            ys.append(sum(y for _, y in known) / len(known))
    return xs, ys


def draw(document: dict[str, Any], time: str) -> Any:
    """Return a matplotlib figure of a results document, a row per capture."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    captures = document["captures"]
    surfaces = any(
        f_of(run) is not None for capture in captures for curve in capture["curves"] for run in curve["runs"]
    )
    columns = 1 + surfaces
    figure = Figure(figsize=(4.6 * columns, 3.1 * len(captures) + 0.4), layout="constrained")
    FigureCanvasSVG(figure)
    names: list[str] = []
    for capture in captures:
        names += [curve["name"] for curve in capture["curves"] if curve["name"] not in names]
    grid = figure.subplots(len(captures), columns, squeeze=False)
    for row, capture in zip(grid, captures, strict=True):
        split = "test" if capture["test_views"] else "training"
        _panel(row[0], capture, names, time, psnr_of, f"{capture['name']}: PSNR of {split} views, dB")
        if surfaces and capture["truth"]:
            _panel(row[1], capture, names, time, f_of, f"{capture['name']}: F at 0.25 % of its size")
        elif surfaces:
            row[1].set_axis_off()
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines() if line.get_label()[0] != "_"}
    shown = [name for name in names if name in lines]
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": min(5, max(1, len(shown)))}
    figure.legend([lines[n] for n in shown], shown, fontsize=8, frameon=False, labelcolor=INK, **place)
    return figure


def _panel(axes: Any, capture: dict[str, Any], names: Sequence[str], time: str, value: Value, title: str) -> None:
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    for curve in capture["curves"]:
        look = line_style(names.index(curve["name"]))
        look["zorder"] = look.pop("order")
        for run in curve["runs"]:
            course = [(p[time], value(p)) for p in (*run.get("course", ()), run) if value(p) is not None]
            if len(course) > 1:
                xs, ys = zip(*course, strict=True)
                axes.plot(xs, ys, linewidth=0.8, alpha=0.35, **look)
        xs, ys = ends(curve, time, value)
        if xs:
            axes.plot(xs, ys, marker="o", markersize=4.5, linewidth=1.6, label=curve["name"], **look)
    axes.set_title(title, fontsize=9, color=INK)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(TIMES[time], fontsize=8, color=INK)
    axes.tick_params(colors=INK, labelsize=8, which="both", length=3)
    axes.grid(True, which="both", color=INK, alpha=0.16, linewidth=0.6)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(INK)


def write_figure(file: Path, document: dict[str, Any], time: str) -> None:
    """Write the figure of a results document as PNG or SVG; the SVG is byte-identical for the same document."""
    figure = draw(document, time)
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".svg":
        file.write_text(svg_text(figure))
    else:
        figure.savefig(file, dpi=150, facecolor="white")
