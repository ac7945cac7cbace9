"""A table as Markdown, CSV and LaTeX: what was measured, and the paper's figures beside."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from gs2d.paper_tables import LOWER_IS_BETTER, METRICS, PaperTable, printed
from gs2d.pipeline.paper_rows import FIGURES, Results, Row, Verdict

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


# -- files -----------------------------------------------------------------------------------------------------------
def to_markdown(
    table: PaperTable, results: Results, verdicts: Sequence[Verdict], deviations: Sequence[str], commands: Sequence[str]
) -> str:
    """The whole result as Markdown."""
    lines = [f"# {table.title}", "", f"Table `{table.name}` (`{table.label}`). In brackets: the paper's figures.", ""]
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
    lines += ["## Do the paper's orders hold?", ""]
    lines += [f"- **{v.holds}** ({v.data_set}): {v.text}. {verdict_text(v)}" for v in verdicts] or ["- nothing trained"]
    lines += ["", "## How this differs from the paper", "", *(f"- {text}" for text in deviations), ""]
    lines += ["## Commands", "", "```sh", *commands, "```", ""]
    return "\n".join(lines)


def to_csv(results: Results) -> str:
    """One line for each row, data set, scene and seed, and one with the mean of each data set."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["row", "recipe", "data_set", "scene", "seed", *FIGURES, *(f"paper_{m}" for m in METRICS)])
    for row in results.rows:
        for data_set in dict.fromkeys([*(c.data_set for c in row.cells), *row.paper]):
            paper = [row.paper.get(data_set, {}).get(m, "") for m in METRICS]
            for cell in row.of(data_set):
                figures = [_blank(cell.figures[name]) for name in FIGURES]
                writer.writerow(
                    [row.name, row.recipe or "", data_set, cell.scene, cell.seed, *figures, *[""] * len(paper)]
                )
            figures = [_blank(value) for value in results.mean(row, data_set).values()]
            writer.writerow([row.name, row.recipe or "", data_set, "mean", "", *figures, *paper])
    return out.getvalue()


def _blank(value: float | None) -> float | str:
    return "" if value is None else value


_TEX = str.maketrans({"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#"})


def to_latex(table: PaperTable, results: Results) -> str:
    """A ``booktabs`` table: for each data set the measured figures, with the paper's in a small line below."""
    groups = {data_set: columns_of(table, results, data_set) for data_set in results.data_sets}
    spec = "l" + "".join("@{\\quad}" + "c" * len(columns) for columns in groups.values())
    lines = [
        "% \\usepackage{booktabs}",
        "\\begin{table}",
        "  \\centering",
        f"  \\begin{{tabular}}{{{spec}}}",
        "    \\toprule",
    ]
    head, rules, at = [], [], 2
    for data_set, columns in groups.items():
        head.append(f"\\multicolumn{{{len(columns)}}}{{c}}{{{data_set.translate(_TEX)}}}")
        rules.append(f"\\cmidrule(lr){{{at}-{at + len(columns) - 1}}}")
        at += len(columns)
    arrows = [
        TITLES[m] + ("" if m in ("bytes", "seconds") else r"$\downarrow$" if m in LOWER_IS_BETTER else r"$\uparrow$")
        for columns in groups.values()
        for m in columns
    ]
    lines += ["    & " + " & ".join(head) + r" \\", "    " + " ".join(rules), "    & " + " & ".join(arrows) + r" \\"]
    lines.append("    \\midrule")
    for row in rows_for(results, *groups):
        ours, papers = [], []
        for data_set, columns in groups.items():
            for metric in columns:
                text = measured(metric, results, row, data_set).replace("±", r"$\pm$").translate(_TEX)
                bold = row.name in best_rows(metric, results, data_set)
                ours.append(f"\\textbf{{{text}}}" if bold else text)
                figure = row.paper.get(data_set, {}).get(metric)
                papers.append("" if figure is None else f"\\footnotesize({printed(metric, data_set, figure)})")
        if row.recipe is None:
            ours, papers = [figure or "-" for figure in papers], []
        lines.append(f"    {row.name.translate(_TEX)} & " + " & ".join(ours) + r" \\")
        if any(papers):
            lines.append("     & " + " & ".join(papers) + r" \\")
    caption = f"{table.title}. In brackets: the figures of the paper.".translate(_TEX)
    lines += [
        "    \\bottomrule",
        "  \\end{tabular}",
        f"  \\caption{{{caption}}}",
        f"  \\label{{{table.label}-measured}}",
    ]
    return "\n".join([*lines, "\\end{table}", ""])
