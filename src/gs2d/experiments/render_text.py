"""A table as Markdown, CSV and LaTeX: what was measured, and the paper's figures beside."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from gs2d.experiments.aggregate import FIGURES, Results, Row, Verdict
from gs2d.experiments.tables import LOWER_IS_BETTER, METRICS, PaperTable, printed

DIGITS = {"fscore": 3, "chamfer": 3, "psnr": 2, "ssim": 4, "lpips": 4, "bytes": 2, "seconds": 0}
TITLES = {**METRICS, "bytes": "MB", "seconds": "s"}


def shown(metric: str, value: float | None) -> str:
    """A figure with its digits (bytes as MB), or a dash."""
    if value is None:
        return "-"
    value = value / 1e6 if metric == "bytes" else value
    digits = DIGITS[metric]
    if metric == "chamfer" and abs(value) < 0.1:  # world units, not millimetres
        digits = 5
    if metric == "seconds" and abs(value) < 10:
        digits = 1
    return f"{value:.{digits}f}"


def columns_of(table: PaperTable, results: Results, data_set: str) -> list[str]:
    """The metrics to show for a data set: the paper's, what else was measured, storage and time."""
    order = list(table.columns.get(data_set, ()))
    have = {name for row in results.rows for name, v in results.mean(row, data_set).items() if v is not None}
    for name in ("fscore", "psnr", "ssim", "lpips", "chamfer"):
        if name not in order and name in have:
            order.append(name)
    return [*order, "bytes", "seconds"]


def rows_for(results: Results, *data_sets: str) -> list[Row]:
    """The rows that have something to show for a data set: trained ones, and quoted ones with a figure."""
    return [row for row in results.rows if row.recipe is not None or any(row.paper.get(d) for d in data_sets)]


def untrained(table: PaperTable, results: Results) -> dict[str, tuple[str, ...]]:
    """The paper's data sets that nothing was trained on here, with its metrics."""
    return {data_set: metrics for data_set, metrics in table.columns.items() if data_set not in results.data_sets}


def measured(metric: str, results: Results, row: Row, data_set: str) -> str:
    """Mean, with the spread over seeds where there are several."""
    mean, spread = results.mean(row, data_set)[metric], results.spread(row, data_set)[metric]
    text = shown(metric, mean)
    return f"{text} ± {shown(metric, spread)}" if spread is not None and metric not in ("bytes", "seconds") else text


def best_rows(metric: str, results: Results, data_set: str) -> set[str]:
    """Names of the rows whose shown figure is the best of the trained ones."""
    means = {row.name: results.mean(row, data_set)[metric] for row in results.rows}
    known = {name: value for name, value in means.items() if value is not None}
    if metric in ("bytes", "seconds") or len(known) < 2:
        return set()
    top = (min if metric in LOWER_IS_BETTER else max)(known.values())
    return {name for name, value in known.items() if shown(metric, value) == shown(metric, top)}


def verdict_text(verdict: Verdict) -> str:
    """One line about an order: its steps with differences and spread."""
    if verdict.holds == "unknown":
        return verdict.reason
    steps = verdict.steps
    if verdict.kind == "flat":
        steps = (max(steps, key=lambda step: abs(step.difference)),)
    words = []
    for step in steps:
        spread = "" if step.spread is None else f" ± {shown(verdict.metric, step.spread)}"
        seeds = f", {step.seeds_with_sign} of {step.seeds} seeds" if step.seeds > 1 else ""
        digits = shown(verdict.metric, step.difference)
        sign = "+" if step.difference >= 0 else ""
        words.append(f"{step.lower} → {step.upper}: {sign}{digits}{spread}{seeds}")
    prefix = "largest difference: " if verdict.kind == "flat" else ""
    return prefix + "; ".join(words)


def deviations_title(table: PaperTable) -> str:
    """What stands above the deviations."""
    return "How this differs from the paper" if table.of_paper else "What to know about these figures"


# -- files -----------------------------------------------------------------------------------------------------------
def to_markdown(
    table: PaperTable, results: Results, verdicts: Sequence[Verdict], deviations: Sequence[str], commands: Sequence[str]
) -> str:
    """The whole result as Markdown."""
    lines = [f"# {table.title}", ""]
    if table.of_paper:
        lines += [f"Table `{table.name}` (`{table.label}`). In brackets: the paper's figures.", ""]
    for data_set in results.data_sets:
        columns = columns_of(table, results, data_set)
        arrows = [
            TITLES[m] + ("" if m in ("bytes", "seconds") else " ↓" if m in LOWER_IS_BETTER else " ↑") for m in columns
        ]
        lines += [f"## {data_set}", "", "| | " + " | ".join(arrows) + " |", "|---" * (len(columns) + 1) + "|"]
        for row in rows_for(results, data_set):
            paper = row.paper.get(data_set, {})
            cells = []
            for metric in columns:
                text = measured(metric, results, row, data_set) if row.recipe is not None else ""
                text = f"**{text}**" if row.name in best_rows(metric, results, data_set) else text
                quoted = f"({printed(metric, data_set, paper[metric])})" if metric in paper else ""
                cells.append(f"{text} {quoted}".strip() or "-")
            lines.append(f"| {row.name} | " + " | ".join(cells) + " |")
        lines.append("")
    for data_set, metrics in untrained(table, results).items():
        lines += [f"## The paper's figures on {data_set}", "", "| | " + " | ".join(TITLES[m] for m in metrics) + " |"]
        lines.append("|---" * (len(metrics) + 1) + "|")
        for name, known in ((row.name, row.paper.get(data_set)) for row in results.rows):
            if known:
                shown_ = [f"({printed(m, data_set, known[m])})" if m in known else "-" for m in metrics]
                lines.append(f"| {name} | " + " | ".join(shown_) + " |")
        lines.append("")
    if table.of_paper:
        judged = [f"- **{v.holds}** ({v.data_set}): {v.text}. {verdict_text(v)}" for v in verdicts]
        lines += ["## Do the paper's orders hold?", "", *(judged or ["- nothing trained"]), ""]
    lines += [f"## {deviations_title(table)}", "", *(f"- {text}" for text in deviations), ""]
    lines += ["## Commands", "", "```sh", *commands, "```", ""]
    return "\n".join(lines)


def to_csv(results: Results) -> str:
    """One line for each row, data set, scene and seed, and one with the mean of each data set.

    The paper's figures have columns where some row has any.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    quoted = METRICS if any(row.paper for row in results.rows) else ()
    writer.writerow(["row", "recipe", "data_set", "scene", "seed", *FIGURES, *(f"paper_{m}" for m in quoted)])
    for row in results.rows:
        for data_set in dict.fromkeys([*(c.data_set for c in row.cells), *row.paper]):
            paper = [row.paper.get(data_set, {}).get(m, "") for m in quoted]
            for cell in row.of(data_set):
                figures = [_blank(cell.figures[name]) for name in FIGURES]
                writer.writerow(
                    [row.name, row.recipe or "", data_set, cell.scene, cell.seed, *figures, *[""] * len(paper)]
                )
            figures = [_blank(value) for value in results.mean(row, data_set).values()]
            if not row.of(data_set) and not any(paper):
                continue  # another method, of which the paper has nothing here
            writer.writerow([row.name, row.recipe or "", data_set, "mean", "", *figures, *paper])
    return out.getvalue()


def _blank(value: float | None) -> float | str:
    return "" if value is None else value


_TEX = str.maketrans(
    {
        **{c: f"\\{c}" for c in "&%_#${}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "±": r"$\pm$",
    }
)


def to_latex(table: PaperTable, results: Results) -> str:
    """``booktabs`` tables in one float, one for each data set: the measured figures, the paper's in small print below.

    Data sets that nothing was trained on follow with the paper's figures alone.
    """
    groups = {data_set: columns_of(table, results, data_set) for data_set in results.data_sets}
    groups |= {data_set: list(metrics) for data_set, metrics in untrained(table, results).items()}
    lines = ["% \\usepackage{booktabs}", "\\begin{table}", "  \\centering"]
    for data_set, columns in groups.items():
        lines += [*_latex_tabular(results, data_set, columns), "  \\par\\medskip"]
    quoted = " In brackets: the figures of the paper." if table.of_paper else ""
    caption = f"{table.title}.{quoted}".translate(_TEX)
    lines += [f"  \\caption{{{caption}}}", f"  \\label{{{table.label}-measured}}", "\\end{table}", ""]
    return "\n".join(lines)


def _latex_tabular(results: Results, data_set: str, columns: Sequence[str]) -> list[str]:
    """The rows of one data set."""
    arrows = [
        TITLES[m] + ("" if m in ("bytes", "seconds") else r"$\downarrow$" if m in LOWER_IS_BETTER else r"$\uparrow$")
        for m in columns
    ]
    lines = [f"  \\begin{{tabular}}{{l{'c' * len(columns)}}}", "    \\toprule"]
    lines.append(f"    {data_set.translate(_TEX)} & " + " & ".join(arrows) + r" \\")
    lines.append("    \\midrule")
    best = {metric: best_rows(metric, results, data_set) for metric in columns}
    for row in rows_for(results, data_set):
        known = row.paper.get(data_set, {})
        if not known and not row.of(data_set):
            continue
        papers = [f"\\footnotesize({printed(m, data_set, known[m])})" if m in known else "" for m in columns]
        ours = [measured(metric, results, row, data_set).translate(_TEX) for metric in columns]
        ours = [f"\\textbf{{{x}}}" if row.name in best[m] else x for m, x in zip(columns, ours, strict=True)]
        if not row.of(data_set):
            ours, papers = [figure or "-" for figure in papers], []
        lines.append(f"    {row.name.translate(_TEX)} & " + " & ".join(ours) + r" \\")
        if any(papers):
            lines.append("     & " + " & ".join(papers) + r" \\")
    return [*lines, "    \\bottomrule", "  \\end{tabular}"]
