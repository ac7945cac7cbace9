"""Training curves as SVG: losses, PSNR, splat count, opacity and area."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeGuard

import numpy as np

INK = "#858b94"  # readable on white and on black
_COLORS = ("#3f86d6", "#e0893a", "#46a56b", "#c6509f", "#8a74d8", "#b9a02d", "#50a9b8")
MAX_VALUE = 1e30  # larger values are not drawn; the limits of axes overflow at 1e308


@dataclass(frozen=True)
class StageSpan:
    """Iterations of a stage within the run: [start, stop)."""

    name: str
    start: int
    stop: int


@dataclass(frozen=True)
class History:
    """The series of a log over iterations, which count over all stages."""

    stages: tuple[StageSpan, ...] = ()
    # (iterations, values) of "splats", "mean_opacity", "mean_area", "psnr", and "loss/<term>" for each term.
    series: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


def read_history(events: Sequence[Mapping[str, Any]]) -> History:
    """Sort the steps of a log into series. Unknown kinds and figures are ignored."""
    lengths: dict[str, int] = {}  # by stage, in order
    for event in events:
        stage = event.get("stage")
        if isinstance(stage, str):
            declared = event.get("iterations") if event.get("kind") == "stage_started" else None
            lengths[stage] = max(lengths.get(stage, 0), _whole(declared), _whole(event.get("iteration")))
    ends = dict(zip(lengths, itertools.accumulate(lengths.values()), strict=True))
    spans = {name: StageSpan(name, ends[name] - lengths[name], ends[name]) for name in lengths}
    points: dict[str, list[tuple[float, float]]] = {}
    for event in events:
        span = spans.get(str(event.get("stage")))
        if event.get("kind") == "progress" and span is not None and "iteration" in event:
            for name, value in _figures(event).items():
                points.setdefault(name, []).append((span.start + _whole(event["iteration"]), value))
    series = {name: (np.array(rows)[:, 0], np.array(rows)[:, 1]) for name, rows in points.items()}
    return History(tuple(spans.values()), series)


def _whole(value: Any) -> int:
    return int(value) if _is_number(value) else 0


def _is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value can be drawn."""
    return isinstance(value, int | float) and abs(value) < MAX_VALUE  # not NaN


def _figures(event: Mapping[str, Any]) -> dict[str, float]:
    """Return the finite numbers of a step."""
    named = {name: event.get(name) for name in ("psnr", "splats", "mean_opacity", "mean_area")}
    named |= {f"loss/{term}": value for term, value in (event.get("losses") or {}).items()}
    return {name: float(value) for name, value in named.items() if _is_number(value)}


def smoothed(values: np.ndarray, count: int = 9) -> np.ndarray:
    """Return a centred running mean over ``count`` values, shorter at the ends."""
    ones = np.convolve(np.ones(len(values)), np.ones(count), mode="same")
    return np.asarray(np.convolve(values, np.ones(count), mode="same") / ones)


def curves(history: History, stage_psnr: Mapping[str, float], split: str) -> dict[str, str]:
    """Return SVG by title; figures without data are left out.

    ``stage_psnr``: PSNR at the end of each stage, dB: scores of the ``split`` views; drawn as points.
    """
    drawn: dict[str, str] = {}
    terms = sorted(name for name in history.series if name.startswith("loss/"))
    if terms:
        lines = {name.removeprefix("loss/"): name for name in terms}
        drawn["Loss terms, weighted"] = _figure(history, lines, log=True, smooth=True)
    if "psnr" in history.series or stage_psnr:
        ends = {span.stop: stage_psnr[span.name] for span in history.stages if span.name in stage_psnr}
        line = {"a few views, while training": "psnr"} if "psnr" in history.series else {}
        if line or ends:
            drawn["PSNR, dB"] = _figure(history, line, smooth=True, marks=(f"all {split} views", ends))
    for name, title, log in (
        ("splats", "Splats", False),
        ("mean_opacity", "Mean opacity", False),
        ("mean_area", "Mean splat area, square world units", True),
    ):
        if name in history.series:
            drawn[title] = _figure(history, {"": name}, log=log)
    return drawn


def line_style(k: int) -> dict[str, Any]:
    """Return colour, dashes and drawing order of line ``k``; 28 lines differ."""
    dashes = ("-", "--", ":", "-.")[k // len(_COLORS) % 4]
    return {"color": _COLORS[k % len(_COLORS)], "linestyle": dashes, "order": 3 - 0.01 * k}


def draw_stages(
    axes: Any, history: History, name: str, *, label: str, smooth: bool, color: str, linestyle: str, order: float
) -> None:
    """Draw one line per stage, without connecting stages."""
    for span in history.stages if name in history.series else ():
        x, y = history.series[name]
        within = ((x > span.start) if span.start else (x >= 0)) & (x <= span.stop)
        if not within.any():
            continue
        x, y = x[within], y[within]
        if smooth and len(x) > 30:
            axes.plot(x, y, color=color, linewidth=0.6, alpha=0.25, zorder=order)
            y = smoothed(y)
        axes.plot(x, y, color=color, linewidth=1.5, linestyle=linestyle, zorder=order)
    axes.plot([], [], color=color, linewidth=1.5, linestyle=linestyle, label=label)


def _axes(width: float, height: float) -> tuple[Any, Any]:
    """Return a figure of a size in inches, and its axes."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    axes.tick_params(colors=INK, labelsize=8, which="both", length=3)
    axes.grid(True, color=INK, alpha=0.18, linewidth=0.6)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(INK)
    return figure, axes


def _figure(
    history: History,
    lines: Mapping[str, str],
    *,
    log: bool = False,
    smooth: bool = False,
    marks: tuple[str, Mapping[int, float]] | None = None,
) -> str:
    figure, axes = _axes(5.4, 2.7)
    for k, (label, name) in enumerate(lines.items()):
        draw_stages(axes, history, name, label=label, smooth=smooth, **line_style(k))
    if marks and marks[1]:
        x_marks, y_marks = list(marks[1]), list(marks[1].values())
        axes.plot(x_marks, y_marks, "o", color=_COLORS[1], markersize=5, label=marks[0], clip_on=False)
        for x_mark, y_mark in marks[1].items():
            style = {"textcoords": "offset points", "ha": "right", "fontsize": 8, "color": INK}
            axes.annotate(f"{y_mark:.2f}", (x_mark, y_mark), (-5, 5), **style)
    dress_axes(axes, history, log=log, legend=any(lines) or bool(marks and marks[1]))
    return svg_text(figure)


def lines_by_image(curves: Mapping[str, Sequence[float]]) -> str:
    """Return an SVG of values of the training photographs, one line per entry; several lines get a legend."""
    figure, axes = _axes(8.2, 2.4)
    axes.set_xlabel("training photograph, by name", fontsize=8, color=INK)
    for k, (label, values) in enumerate(curves.items()):
        style = line_style(k)
        axes.plot(range(1, len(values) + 1), values, ".", ls=style["linestyle"], color=style["color"], label=label)
    if len(curves) > 1:
        axes.legend(frameon=False, labelcolor=INK, fontsize=8)
    else:
        axes.set_ylabel(next(iter(curves)), fontsize=8, color=INK)
    return svg_text(figure)


def svg_text(figure: Any) -> str:
    """Return a figure as SVG with reproducible bytes."""
    import matplotlib

    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "gs2d"}):  # the same run gives the same bytes
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    return text.getvalue()


def dress_axes(axes: Any, history: History, *, log: bool, legend: bool) -> None:
    """Style the axes, and mark the stages."""
    from matplotlib.ticker import EngFormatter

    values = [y for line in axes.get_lines() for y in np.atleast_1d(line.get_ydata()) if y > 0]
    if log and values:
        axes.set_yscale("log")
    last = max((span.stop for span in history.stages), default=1)
    axes.set_xlim(0, max(last, 1))
    for span in history.stages:
        if span.start:
            axes.axvline(span.start, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        if len(history.stages) > 1 and span.stop - span.start >= 0.06 * last:
            middle = (span.start + span.stop) / 2
            axes.text(middle, 1.02, span.name, transform=axes.get_xaxis_transform(), ha="center", fontsize=8, color=INK)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("iteration", fontsize=8, color=INK)
    if legend:
        axes.legend(fontsize=8, frameon=False, labelcolor=INK, loc="best", handlelength=1.4)
    if any(side > 9999 for side in axes.get_ylim()) and not log:
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
