"""A table as one HTML page that needs nothing else: figures, the paper's orders, pictures side by side, deviations."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gs2d.config.presets import RECIPES, get_recipe
from gs2d.core.files import atomic_write
from gs2d.core.images import read_image
from gs2d.core.json_files import read_json
from gs2d.errors import Gs2dError
from gs2d.experiments.aggregate import Cell, Results, Row, Verdict
from gs2d.experiments.render_text import (
    TITLES,
    best_rows,
    columns_of,
    deviations_title,
    rows_for,
    shown,
    untrained,
    verdict_text,
)
from gs2d.experiments.tables import LOWER_IS_BETTER, METRICS, PaperTable, printed
from gs2d.io.run_dir import RENDERS
from gs2d.pipeline.events import OnEvent, ignore
from gs2d.report.html import drawing, escape, facts, missing, page, picture, table

PICTURE_WIDTH = 300
FIGURE_TITLES = {
    "traces": "Mean coverage K_a and mean opacity over the iterations",
    "changes": "How much each attribute changes an iteration",
}
SHOWN = {"color": "Colour", "normal": "Normals", "error": "Error"}
STYLE = """<style>
td:first-child .paper { max-width: 24rem; white-space: normal; }
td .paper, td .pm { display: block; color: var(--soft); font-size: .74rem; font-weight: 400; }
tr.quoted td { color: var(--soft); } tr.quoted td:first-child { font-style: italic; }
td.claim { text-align: left; white-space: normal; min-width: 16rem; }
td.steps { text-align: left; white-space: normal; color: var(--soft); font-size: .85rem; }
.yes, .no, .open, .unknown { font-weight: 650; } .yes { color: var(--good); } .no { color: var(--accent); }
.open, .unknown { color: var(--soft); }
.figures { display: grid; gap: 1.4rem; margin-bottom: 2rem; }
.figures img { background: #fff; }
</style>"""


def write_page(
    paper_table: PaperTable,
    results: Results,
    verdicts: Sequence[Verdict],
    deviations: Sequence[str],
    commands: Sequence[str],
    about: dict[str, Any],
    out: Path,
    on_event: OnEvent = ignore,
) -> Path:
    """Write ``index.html`` into a folder.

    Raises
    ------
    DiskError
    """
    body = [STYLE, f'<div class="eyebrow">{escape(paper_table.command)}</div>']
    body += [f"<h1>{escape(paper_table.title)}</h1>", lead(paper_table, verdicts, about)]
    for data_set in results.data_sets:
        body += [f"<h2>{escape(data_set)}</h2>", figures_table(paper_table, results, data_set)]
    body += papers_tables(paper_table, results)
    if paper_table.of_paper:
        body += ["<h2>Do the paper&#8217;s orders hold?</h2>", orders_table(verdicts)]
    body += [f"<h2>{deviations_title(paper_table)}</h2>", _list(deviations)]
    body += ["<h2>Side by side</h2>", *side_by_side(results)]
    body += own_figures(paper_table, results, out, on_event)
    body += ["<h2>Every run</h2>", runs_table(results)]
    body += ["<h2>How it was made</h2>", made_with(about, commands)]
    path = out / "index.html"
    with atomic_write(path, "w") as file:
        file.write(page(f"{paper_table.title} - {paper_table.command}", body))
    return path


def lead(paper_table: PaperTable, verdicts: Sequence[Verdict], about: dict[str, Any]) -> str:
    """The result in two sentences."""
    text = _held(verdicts) if paper_table.of_paper else _counted(about)
    scale = about["options"]["schedule_scale"]
    if scale != 1.0:
        text += f" Trained at {scale:g} of the schedule: compare differences, not absolute figures."
    if len(about["seeds"]) < 2:
        text += " One seed: how much a figure moves by chance is not known."
    return f'<p class="lead">{text}</p>'


def _counted(about: dict[str, Any]) -> str:
    """How much was compared."""
    counts = {"recipe": len(about["recipes"]), "scene": len(about["scenes"])}
    return " on ".join(f"{count} {name}{'s' if count != 1 else ''}" for name, count in counts.items()) + "."


def _held(verdicts: Sequence[Verdict]) -> str:
    """How many of the paper's orders hold."""
    known = [verdict for verdict in verdicts if verdict.holds != "unknown"]
    hold = sum(verdict.holds == "yes" for verdict in known)
    if not known:
        text = "None of the paper&#8217;s orders can be checked yet."
    else:
        figure = f"{hold} of {len(known)}"
        text = (
            f"<b>{figure}</b>" if hold == len(known) else figure
        ) + " of the paper&#8217;s orders that could be checked hold."
    if len(known) < len(verdicts):
        text += f" {len(verdicts) - len(known)} could not be checked."
    return text


def figures_table(paper_table: PaperTable, results: Results, data_set: str) -> str:
    """One data set's figures; below each the paper's."""
    columns = columns_of(paper_table, results, data_set)
    best = {metric: best_rows(metric, results, data_set) for metric in columns}
    heads = [TITLES[m] + ("" if m in ("bytes", "seconds") else " ↓" if m in LOWER_IS_BETTER else " ↑") for m in columns]
    rows, listed = [], rows_for(results, data_set)
    for row in listed:
        mean, spread = results.mean(row, data_set), results.spread(row, data_set)
        words = "; ".join(filter(None, (row.note, about_row(row))))
        note = f'<span class="paper">{escape(words)}</span>' if words else ""
        cells = [f"<td>{escape(row.name)}{note}</td>"]
        for metric in columns:
            cells.append(_cell(row, metric, data_set, mean[metric], spread[metric], row.name in best[metric]))
        rows.append(cells)
    built = table(["", *heads], rows)
    for row in listed:
        if row.recipe is None:  # quoted rows are grey
            built = built.replace(f"<tr><td>{escape(row.name)}<", f'<tr class="quoted"><td>{escape(row.name)}<')
    counted = results.scenes("psnr", data_set)
    scenes = (
        f"Means over {len(counted)} scene{'s' if len(counted) != 1 else ''}: {', '.join(counted)}. " if counted else ""
    )
    quoted = "In small print, and in grey rows, the paper's figures. " if paper_table.of_paper else ""
    note = f"{quoted}MB: float32 parameters. s: training alone, shared stages included."
    return built + f'<p class="soft">{escape(scenes + note)}</p>'


def about_row(row: Row) -> str:
    """What is trained for a row, in words: the name of one of the paper's says what the table is about."""
    if row.recipe is None:
        return ""
    about = RECIPES[row.recipe].about
    return about if row.name == row.recipe else about.partition(": ")[2] or about


def _cell(row: Row, metric: str, data_set: str, mean: float | None, spread: float | None, best: bool) -> str:
    figure = row.paper.get(data_set, {}).get(metric)
    if row.recipe is None:
        return "<td>-</td>" if figure is None else f"<td>{printed(metric, data_set, figure)}</td>"
    text = shown(metric, mean)
    if spread is not None and metric not in ("bytes", "seconds"):
        text += f' <span class="pm">± {shown(metric, spread)}</span>'
    if figure is not None:
        text += f'<span class="paper">paper {printed(metric, data_set, figure)}</span>'
    return f'<td class="best">{text}</td>' if best else f"<td>{text}</td>"


def orders_table(verdicts: Sequence[Verdict]) -> str:
    """The claims, and what the rows say."""
    if not verdicts:
        return missing("Nothing is trained yet.")
    rows = [
        [
            f'<td class="claim">{escape(v.text)}</td>',
            f"<td>{escape(v.data_set)}</td>",
            f"<td>{escape(METRICS[v.metric])}</td>",
            f'<td class="{v.holds}">{escape(v.holds)}</td>',
            f'<td class="steps">{escape(verdict_text(v))}</td>',
        ]
        for v in verdicts
    ]
    note = (
        "Differences are taken run by run (same scene, same seed) in the direction of the paper's order, so a "
        "positive one agrees with it; ± is their standard deviation over seeds. Open: the seeds disagree."
    )
    return (
        table(["The paper says", "data set", "figure", "holds", "difference"], rows)
        + f'<p class="soft">{escape(note)}</p>'
    )


def side_by_side(results: Results) -> list[str]:
    """One view of each scene, by every trained row."""
    rows = [row for row in results.rows if row.recipe is not None]
    seen = {(cell.scene, cell.data_set): None for row in rows for cell in row.cells}
    sections = []
    for scene, _ in seen:
        shown_runs = {row.name: run for row in rows if (run := _first_run(row, scene)) is not None}
        sections += _scene_section(scene, shown_runs)
    return sections or [missing("No run has pictures yet.")]


def _first_run(row: Row, scene: str) -> Path | None:
    """The run of the first seed that has pictures."""
    cells = sorted((cell for cell in row.cells if cell.scene == scene), key=lambda cell: cell.seed)
    return next((cell.run for cell in cells if (cell.run / RENDERS / "index.json").exists()), None)


def _scene_section(scene: str, runs: dict[str, Path]) -> list[str]:
    if not runs:
        return [f"<h3>{escape(scene)}</h3>", missing("No run of this scene has pictures.")]
    index = read_json(next(iter(runs.values())) / RENDERS / "index.json")
    if not index["views"]:
        return []
    view = index["views"][0]
    grid = [
        f'<div class="scroll"><div class="views" style="grid-template-columns: 4.5rem repeat({len(runs) + 1}, 1fr)">'
    ]
    grid.append('<div></div><div class="head">Photograph</div>')
    grid += [f'<div class="head">{escape(name)}</div>' for name in runs]
    for what, title in SHOWN.items():
        grid.append(f'<div class="row">{title}</div>')
        photo = next(iter(runs.values())) / RENDERS / "photos" / f"{view['file']}.png"
        grid.append(_picture(photo, f"{scene}: photograph") if what == "color" else "<div></div>")
        for name, run in runs.items():
            grid.append(_picture(_last_picture(run, view["file"], what), f"{scene}, {name}: {title.lower()}"))
    grid.append("</div></div>")
    return [
        f"<h3>{escape(scene)} <small>view {escape(view['name'])} ({escape(view['split'])})</small></h3>",
        "".join(grid),
    ]


def _last_picture(run: Path, file: str, what: str) -> Path:
    """A picture after the last stage that was drawn."""
    stages = read_json(run / RENDERS / "index.json")["stages"]
    return run / RENDERS / (stages[-1] if stages else "none") / f"{file}.{what}.png"


def _picture(path: Path, alt: str) -> str:
    return picture(read_image(path), alt=alt, width=PICTURE_WIDTH) if path.exists() else '<div class="soft">none</div>'


def own_figures(paper_table: PaperTable, results: Results, out: Path, on_event: OnEvent) -> list[str]:
    """The paper's figures (K_a and opacity, traces of the attributes, a map of E_i), a set for each scene."""
    from gs2d.experiments.figures import coverage, write_figures  # loads torch

    rows = [row for row in results.rows if row.recipe is not None]
    sections: list[str] = []
    for scene in dict.fromkeys(cell.scene for row in rows for cell in row.cells):
        runs = {row.name: run for row in rows if (run := _first_run(row, scene)) is not None}
        if not runs:
            continue
        maps = [name for name in runs if _ranks(name, rows)][-1:]  # they need the photographs: one is enough
        try:
            drawn = [_drawing(path) for path in write_figures(runs, out / "figures" / scene, on_event, maps=maps)]
            drawn += coverage_table(coverage(runs), of_paper=paper_table.of_paper)
        except Gs2dError as error:
            drawn = [missing(str(error))]
        sections += [f"<h3>{escape(scene)}</h3>", '<div class="figures">', *drawn, "</div>"] if drawn else []
    return ["<h2>How the splats change in training</h2>", *sections] if sections else []


def coverage_table(means: Mapping[str, Sequence[float]], *, of_paper: bool) -> list[str]:
    """Mean K_a and opacity of each row after stage 1, and both at the end."""
    if not means:
        return []
    rows = [
        [escape(name), *(f"{v:{form}}" for v, form in zip(values, (".2e", ".3f", ".2e", ".3f"), strict=True))]
        for name, values in means.items()
    ]
    heads = ["", "K_a after stage 1", "opacity", "K_a at the end", "opacity"]
    quoted = "; the paper's figure compares 2DGS with and without NC after 30k iterations" if of_paper else ""
    note = f"Means over all splats{quoted}."
    return [f'<div>{table(heads, rows)}<p class="soft">{escape(note)}</p></div>']


def _ranks(name: str, rows: Sequence[Row]) -> bool:
    """Whether the recipe of a row ranks splats by their error."""
    recipe = next(row.recipe for row in rows if row.name == name)
    return recipe is not None and any(stage.name == "appearance" for stage in get_recipe(recipe).stages)


def _drawing(path: Path) -> str:
    title = FIGURE_TITLES.get(path.stem, "E_i, the colour error of each splat, and the high-error splats")
    if path.suffix == ".svg":
        return drawing(path.read_text(encoding="utf-8"), title)
    return picture(read_image(path), title, alt=title, width=1400)


def papers_tables(paper_table: PaperTable, results: Results) -> list[str]:
    """The paper's figures of the data sets that were not trained here."""
    sections = []
    for data_set, metrics in untrained(paper_table, results).items():
        rows = [
            [escape(row.name), *(printed(m, data_set, known[m]) if m in known else "-" for m in metrics)]
            for row in paper_table.rows
            if (known := row.paper.get(data_set))
        ]
        sections += [f"<h3>{escape(data_set)}</h3>", table(["", *(TITLES[m] for m in metrics)], rows)]
    return ["<h2>What the paper has on other data sets</h2>", *sections] if sections else []


def runs_table(results: Results) -> str:
    """Every run's figures, with reasons where there are none."""
    rows = []
    for row in (row for row in results.rows if row.recipe is not None):
        for cell in row.cells:
            rows.append(
                [
                    escape(row.name),
                    escape(cell.scene),
                    str(cell.seed),
                    *(_run_figure(cell, name) for name in ("psnr", "ssim", "lpips", "fscore", "chamfer")),
                    f"{cell.details['splats']:,}" if "splats" in cell.details else "-",
                    at_the_clone(cell),
                    shown("bytes", cell.figures["bytes"]),
                    shown("seconds", cell.figures["seconds"]),
                ]
            )
    heads = ["row", "scene", "seed", *(METRICS[m] for m in ("psnr", "ssim", "lpips", "fscore", "chamfer"))]
    return table([*heads, "splats", "PSNR at the clone", "MB", "s"], rows)


def at_the_clone(cell: Cell) -> str:
    """PSNR just before the clone, just after it, and at the end."""
    stages = cell.details.get("stages", [])
    for before, after in itertools.pairwise(stages):
        if "psnr_after_clone" in after:
            return " → ".join(shown("psnr", v) for v in (before["psnr"], after["psnr_after_clone"], after["psnr"]))
    return "-"


def _run_figure(cell: Cell, metric: str) -> str:
    value = cell.figures[metric]
    if value is not None or cell.figures["psnr"] is not None:
        return shown(metric, value)
    return f'-<span class="why">{escape(cell.reasons.get(metric, ""))}</span>' if metric == "psnr" else "-"


def made_with(about: dict[str, Any], commands: Sequence[str]) -> str:
    """Versions, machine and commands."""
    host = about["machine"]
    pairs = [
        ("machine", f"{host['processor']}, {host['cores']} cores, {host['system']}"),
        ("versions", ", ".join(f"{name} {version}" for name, version in about["versions"].items())),
        ("seeds", ", ".join(map(str, about["seeds"]))),
        ("written", about["written"]),
    ]
    lines = "\n".join([about["command"], "", "# which does, run by run:", *commands])
    folded = [f"<details><summary>Commands</summary><pre>{escape(lines)}</pre></details>"]
    for name, numbers in about.get("protocols", {}).items():
        rows = [[escape(number[key]) for key in ("field", "value", "source")] for number in numbers]
        numbered = table(["", "value", "where it comes from"], rows, texts=(0, 1, 2))
        folded.append(f"<details><summary>Protocol {escape(name)}</summary>{numbered}</details>")
    return facts(pairs) + "".join(folded)


def _list(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"
