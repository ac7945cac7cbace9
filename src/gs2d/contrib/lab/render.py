"""Writes a table as a page and as Markdown, with measured figures and those of the paper."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from gs2d.config.presets import about_recipe
from gs2d.contrib.lab.aggregate import Cell, ClaimResult, Results, Row
from gs2d.contrib.lab.paper_tables import LOWER_IS_BETTER, METRICS, PaperTable, printed
from gs2d.core.atomic_files import atomic_write
from gs2d.data.image_files import read_image
from gs2d.io.run_dir import RENDERS
from gs2d.report.gallery import read_gallery
from gs2d.report.html_parts import image_tag, page

DIGITS = {"fscore": 3, "chamfer": 3, "psnr": 2, "ssim": 4, "lpips": 4, "bytes": 2, "seconds": 0}
TITLES = {**METRICS, "bytes": "MB", "seconds": "s"}
COSTS = ("bytes", "seconds")  # shown without a spread and without a best
RUN_METRICS = ("psnr", "ssim", "lpips", "fscore", "chamfer")
RUN_HEADS = ["row", "scene", "seed", *(METRICS[m] for m in RUN_METRICS), "splats", "MB", "s"]
IMAGES = {"color": "Colour", "normal": "Normals", "error": "Error"}
IMAGE_WIDTH = 300  # px


def shown(metric: str, value: float | None) -> str:
    """Return a figure with its digits (bytes as MB), or a dash."""
    if value is None:
        return "-"
    value = value / 1e6 if metric == "bytes" else value
    digits = DIGITS[metric]
    if metric == "chamfer" and abs(value) < 0.1:  # world units, not millimetres
        digits = 5
    if metric == "seconds" and abs(value) < 10:
        digits = 1
    return f"{value:.{digits}f}"


# -- the part of one data set ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Figure:
    """A figure as text: mean ("" in quoted rows), spread over seeds, figure of the paper; "" if missing."""

    text: str
    spread: str
    paper: str
    best: bool

    @property
    def measured(self) -> str:
        """Return the mean with its spread."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text

    @property
    def markdown(self) -> str:
        """Return the figure as a cell in Markdown."""
        ours = f"**{self.measured}**" if self.best else self.measured
        return f"{ours} {f'({self.paper})' if self.paper else ''}".strip() or "-"


@dataclass(frozen=True)
class ShownRow:
    """A row of a part; ``about`` describes its training, or the source of its figures."""

    name: str
    quoted: bool
    about: str
    figures: tuple[Figure, ...]


@dataclass(frozen=True)
class TablePart:
    """The part of a table for one data set."""

    data_set: str
    trained: bool
    columns: tuple[str, ...]  # metrics
    rows: tuple[ShownRow, ...]
    scenes: list[str]  # scenes in the means

    @property
    def heads(self) -> list[str]:
        """Return the titles of columns, with an arrow towards better values."""
        arrows = {m: "" if m in COSTS else " ↓" if m in LOWER_IS_BETTER else " ↑" for m in TITLES}
        return [TITLES[metric] + arrows[metric] for metric in self.columns]

    @property
    def quoted_cells(self) -> list[list[str]]:
        """Return the rows with the figures of the paper."""
        return [[row.name, *(figure.paper or "-" for figure in row.figures)] for row in self.rows]


def parts_of(table: PaperTable, results: Results) -> list[TablePart]:
    """Return a part for each trained data set, then for the other data sets of the paper."""
    untrained = [data_set for data_set in table.columns if data_set not in results.data_sets]
    return [_part(table, results, data_set) for data_set in (*results.data_sets, *untrained)]


def _part(table: PaperTable, results: Results, data_set: str) -> TablePart:
    columns, trained = list(table.columns.get(data_set, ())), data_set in results.data_sets
    means = {row.name: results.mean(row, data_set) for row in results.rows}
    if trained:  # other measured figures
        have = {name for mean in means.values() for name, value in mean.items() if value is not None}
        more = ("fscore", "psnr", "ssim", "lpips", "chamfer")
        columns += [*(name for name in more if name in have and name not in columns), *COSTS]
    tops = {metric: _best(metric, [mean[metric] for mean in means.values()]) for metric in columns}
    rows = []
    for row in results.rows:
        paper = row.paper.get(data_set, {})
        if not (row.of(data_set) or paper):
            continue
        spread, is_measured = results.spread(row, data_set), bool(row.of(data_set))
        figures = []
        for metric in columns:
            text = shown(metric, means[row.name][metric]) if is_measured else ""
            around = "" if metric in COSTS or spread[metric] is None else shown(metric, spread[metric])
            quoted = printed(metric, data_set, paper[metric]) if metric in paper else ""
            figures.append(Figure(text, around, quoted, best=is_measured and text == tops[metric]))
        about = "; ".join(filter(None, (row.note, about_row(row))))
        rows.append(ShownRow(row.name, row.recipe is None, about, tuple(figures)))
    return TablePart(data_set, trained, tuple(columns), tuple(rows), results.scenes("psnr", data_set))


def _best(metric: str, means: Sequence[float | None]) -> str:
    """Return the best figure as text, so that rows with equal text are all marked; "" without figures."""
    values = [value for value in means if value is not None]
    if metric in COSTS or len(values) < 2:
        return ""
    return shown(metric, (min if metric in LOWER_IS_BETTER else max)(values))


def about_row(row: Row) -> str:
    """Return the description of the training of a row."""
    if row.recipe is None:
        return ""
    about = about_recipe(row.recipe)
    return about if row.name == row.recipe else about.partition(": ")[2] or about


def claim_text(claim: ClaimResult) -> str:
    """Return a claim in one line: its steps with differences and spread."""
    if claim.holds == "unknown":
        return claim.reason
    steps = claim.steps
    if claim.kind == "flat":
        steps = (max(steps, key=lambda step: abs(step.difference)),)
    words = []
    for step in steps:
        spread = "" if step.spread is None else f" ± {shown(claim.metric, step.spread)}"
        seeds = f", {step.seeds_with_sign} of {step.seeds} seeds" if step.seeds > 1 else ""
        sign = "+" if step.difference >= 0 else ""
        words.append(f"{step.lower} → {step.upper}: {sign}{shown(claim.metric, step.difference)}{spread}{seeds}")
    prefix = "largest difference: " if claim.kind == "flat" else ""
    return prefix + "; ".join(words)


def deviations_title(table: PaperTable) -> str:
    """Return the sentence above the deviations."""
    return "How this differs from the paper" if table.of_paper else "What to know about these figures"


# -- files -------------------------------------------------------------------------------------------------------------
@functools.cache
def _templates() -> jinja2.Environment:
    env = jinja2.Environment(
        loader=jinja2.PackageLoader("gs2d.contrib.lab"),
        autoescape=jinja2.select_autoescape(["html"], default=False),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    env.globals |= {"claim_text": claim_text, "deviations_title": deviations_title, "METRICS": METRICS}
    return env


def to_markdown(
    table: PaperTable,
    results: Results,
    checked: Sequence[ClaimResult],
    deviations: Sequence[str],
    commands: Sequence[str],
) -> str:
    """Return the whole result as Markdown."""
    values = {"table": table, "checked": checked, "deviations": deviations, "commands": commands}
    return _templates().get_template("table.md").render(values, parts=parts_of(table, results))


# -- the page ----------------------------------------------------------------------------------------------------------
def write_page(
    table: PaperTable,
    results: Results,
    checked: Sequence[ClaimResult],
    deviations: Sequence[str],
    commands: Sequence[str],
    about: dict[str, Any],
    out: Path,
) -> Path:
    """Write ``index.html`` into a folder."""
    template = _templates().get_template("page.html")
    body = template.render(
        table=table,
        parts=parts_of(table, results),
        checked=checked,
        checkable=[claim for claim in checked if claim.holds != "unknown"],
        deviations=deviations,
        scenes=side_by_side(results),
        run_heads=RUN_HEADS,
        runs=[_run(row, cell) for row in results.rows for cell in row.cells],
        about=about,
        commands=commands,
    )
    path = out / "index.html"
    with atomic_write(path, "w") as file:
        file.write(page(f"{table.title} - {table.command}", [body]))
    return path


def _run(row: Row, cell: Cell) -> list[str | Markup]:
    """Return a row of the table of all runs, with the reason if it has no figures."""
    figures: list[str | Markup] = [shown(metric, cell.figures[metric]) for metric in RUN_METRICS]
    if cell.figures["psnr"] is None:
        figures = [Markup('-<span class="why">{}</span>').format(cell.reasons.get("psnr", "")), *"----"]
    splats = f"{cell.details['splats']:,}" if "splats" in cell.details else "-"
    costs = [shown(name, cell.figures[name]) for name in COSTS]
    return [row.name, cell.scene, str(cell.seed), *figures, splats, *costs]


def side_by_side(results: Results) -> list[dict[str, Any]]:
    """Return one view of each scene in every trained row: its name and its images by kind."""
    scenes: list[dict[str, Any]] = []
    for scene, runs in _runs_by_scene(results).items():
        if not runs:
            scenes.append({"name": scene, "view": None, "runs": []})
            continue
        gallery = read_gallery(next(iter(runs.values())) / RENDERS)
        for view in gallery.views[:1] if gallery is not None else ():
            scenes.append({"name": scene, "view": view, "runs": list(runs)})
            photo = next(iter(runs.values())) / RENDERS / "photos" / f"{view.file}.png"
            scenes[-1]["images"] = images = {}
            for what, title in IMAGES.items():
                first = _image(photo, f"{scene}: photograph") if what == "color" else Markup("<div></div>")
                others = [(name, _last_image(run, view.file, what)) for name, run in runs.items()]
                images[title] = [first, *(_image(p, f"{scene}, {name}: {title.lower()}") for name, p in others)]
    return scenes


def _runs_by_scene(results: Results) -> dict[str, dict[str, Path]]:
    """Return the run with images, of the first seed, by scene and row."""
    by_scene: dict[str, dict[str, Path]] = {}
    for row in results.rows:
        for cell in sorted(row.cells, key=lambda cell: cell.seed):
            runs = by_scene.setdefault(cell.scene, {})
            if (cell.run / RENDERS / "index.json").exists():
                runs.setdefault(row.name, cell.run)
    return by_scene


def _last_image(run: Path, file: str, what: str) -> Path:
    """Return an image after the last rendered stage."""
    gallery = read_gallery(run / RENDERS)
    stage = gallery.stages[-1] if gallery is not None and gallery.stages else "none"
    return run / RENDERS / stage / f"{file}.{what}.png"


def _image(path: Path, alt: str) -> Markup:
    tag = image_tag(read_image(path), alt=alt, width=IMAGE_WIDTH) if path.exists() else '<div class="soft">none</div>'
    return Markup(tag)
