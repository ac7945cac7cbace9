"""Makes a table of the paper, or of chosen recipes: plan, train, score, aggregate, write table and page."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from gs2d.contrib.lab.aggregate import FIGURES, ClaimResult, Results, Row, check_claims, read_cell
from gs2d.contrib.lab.deviations import deviations_of
from gs2d.contrib.lab.execute import Workers, execute
from gs2d.contrib.lab.lab_options import SWEEP, SweepOptions
from gs2d.contrib.lab.paper_tables import DTU, TNT, PaperRow, PaperTable
from gs2d.contrib.lab.render import to_markdown, write_page
from gs2d.contrib.lab.scenes import SweepScene
from gs2d.contrib.lab.surface_protocols import DTU_SURFACE, TNT_SURFACE, VISIBLE_SURFACE
from gs2d.contrib.lab.table_plan import Plan, commands_of, make_plan, paper_command
from gs2d.contrib.lab.tasks import failures
from gs2d.core.atomic_files import atomic_write
from gs2d.core.json_files import read_json, write_json
from gs2d.errors import RunError
from gs2d.io.run_dir import machine, make_folder, versions
from gs2d.pipeline.prepare.options import values
from gs2d.training.events import Notice, OnEvent, ignore

ABOUT = "about.json"
FIXED = ("table", "protocol", "schedule_scale", "downscale", "backend", "overrides")  # shared options of a folder


@dataclass(frozen=True)
class PaperResult:
    """The result of ``gs2d sweep``."""

    table: PaperTable
    files: tuple[Path, ...]  # table.json first
    results: Results
    checked: tuple[ClaimResult, ...]
    failures: dict[str, str]  # reasons of failed runs by name
    unfinished: int  # number of runs that are not trained (``--no-train``)


def paper(options: SweepOptions, on_event: OnEvent = ignore) -> PaperResult:
    """Train the missing runs of a table, and write the table.

    Cells of a failed run are empty, with the reason; other runs continue.
    """
    requested = make_plan(options)
    check_folder(requested)
    plan = with_other_rows(requested)
    others = [row.name for row in plan.table.rows if row not in requested.table.rows]
    if others:
        on_event(Notice(f"{options.out} has rows of earlier commands, which stay: {', '.join(others)}"))
    if options.train:
        if options.lpips_weights is not None:
            from gs2d.evaluation.lpips import load_lpips  # loads torch

            load_lpips(options.lpips_weights)  # before hours of training
        execute(
            plan.tasks,
            options.out,
            on_event,
            workers=Workers(**values(Workers, options)),
            before=lambda: write_json(options.out / ABOUT, about(plan, None, ())),
            after_task=lambda _task: tabulate(plan, images=False),
        )
    return tabulate(plan, on_event)


def with_other_rows(plan: Plan) -> Plan:
    """Return the plan of a sweep with the rows of earlier commands, which stay in the table."""
    options, path = plan.options, plan.options.out / ABOUT
    if options.table != SWEEP or not path.exists():
        return plan
    recipes = _about(path).get("recipes")
    if not isinstance(recipes, list):
        raise RunError(f"{path} must list the recipes of its sweep, got {recipes!r}; choose another --out")
    names = tuple(dict.fromkeys([*map(str, recipes), *options.recipes]))
    return plan if names == options.recipes else make_plan(replace(options, recipes=names))


def check_folder(plan: Plan) -> None:
    """Raise if the runs of a folder belong to another table."""
    path = plan.options.out / ABOUT
    if plan.options.out.is_file():
        raise RunError(f"--out must be a folder, {plan.options.out} is a file")
    if not path.exists():
        return
    before, after = _about(path).get("options"), json.loads(json.dumps(_defining(plan.options)))
    if not isinstance(before, dict):
        raise RunError(f"{path} must be one that gs2d sweep wrote, got another file; choose another --out")
    for name, value in after.items():
        if before.get(name) != value:
            raise RunError(
                f"{plan.options.out} holds a table made with {name} = {before.get(name)}, now {value}; "
                "choose another --out (--set cache=may stay: stages that are the same are taken from there)"
            )


def _about(path: Path) -> dict[str, Any]:
    """Return the content of ``about.json``."""
    data = read_json(path)
    if isinstance(data, dict):
        return data
    raise RunError(f"{path} must be one that gs2d sweep wrote, got another file; choose another --out")


def _defining(options: SweepOptions) -> dict[str, Any]:
    return {name: getattr(options, name) for name in FIXED}


# -- tabulating ------------------------------------------------------------------------------------------------------
def tabulate(plan: Plan, on_event: OnEvent = ignore, *, images: bool = True) -> PaperResult:
    """Write table.json, table.md, about.json and, with images, index.html from the finished runs."""
    unfinished = sum(task.status()["state"] not in ("done", "failed") for task in plan.tasks)
    results = Results(tuple(_row(plan, row) for row in plan.table.rows))
    checked = check_claims(plan.table, results)
    deviations = deviations_of(plan.options, plan.scenes, plan.table, results)
    out, description = plan.options.out, about(plan, results, checked)
    make_folder(out)
    commands = [line for task in plan.tasks for line in commands_of(task)]
    write_json(out / "table.json", [row_json(row, results, deviations) for row in results.rows])
    write_json(out / ABOUT, {**description, "deviations": deviations})
    with atomic_write(out / "table.md", "w") as file:
        file.write(to_markdown(plan.table, results, checked, deviations, [description["command"], *commands]))
    files = [out / name for name in ("table.json", "table.md", ABOUT)]
    if images:
        files.append(write_page(plan.table, results, checked, deviations, commands, description, out))
    return PaperResult(plan.table, tuple(files), results, checked, failures(plan.tasks), unfinished)


def _row(plan: Plan, row: PaperRow) -> Row:
    cells, commands = [], []
    for scene in plan.scenes if row.recipe is not None else ():
        for seed in plan.options.seeds:
            task = plan.cells[str(row.recipe), scene.name, seed]
            cells.append(
                read_cell(
                    task.train.out,
                    scene=scene.name,
                    data_set=scene.data_set,
                    seed=seed,
                    test_on=scene.protocol.test_on,
                    record=task.status(),
                    conventions=scene.protocol.metrics,
                )
            )
            commands += commands_of(task)
    paper_figures = {data_set: dict(figures) for data_set, figures in row.paper.items()}
    return Row(row.name, row.recipe, paper_figures, row.note, tuple(cells), tuple(commands))


def row_json(row: Row, results: Results, deviations: Sequence[str]) -> dict[str, Any]:
    """Return a row of table.json."""
    return {
        "name": row.name,
        "recipe": row.recipe,
        "mean": results.mean(row),
        "mean_over": {name: results.scenes(name) if row.cells else [] for name in FIGURES},
        "spread": results.spread(row),
        "reasons": results.reasons(row),
        "data_sets": {d: {"mean": results.mean(row, d), "spread": results.spread(row, d)} for d in results.data_sets},
        "scenes": [cell.to_json() for cell in row.cells],
        "paper": row.paper,
        "note": row.note,
        "deviations": list(deviations) if row.recipe is not None else [],
        "commands": list(row.commands),
    }


def about(plan: Plan, results: Results | None, checked: Sequence[ClaimResult]) -> dict[str, Any]:
    """Return the settings of the whole table."""
    options = plan.options
    return {
        "table": plan.table.name,
        "title": plan.table.title,
        "recipes": [row.recipe for row in plan.table.trained],
        "options": _defining(options),
        "data": str(options.data),
        "scenes": {scene.name: {"data_set": scene.data_set, **_scene_entry(scene)} for scene in plan.scenes},
        "protocols": {name: numbers_of(protocol) for name, protocol in _protocols(plan).items()},
        "seeds": list(options.seeds),
        "spread": "standard deviation over seeds of the mean over scenes",
        "claims": [claim.to_json() for claim in checked],
        "failures": failures(plan.tasks) if results is not None else {},
        "command": paper_command(options),
        "versions": versions(),
        "machine": machine(),
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _protocols(plan: Plan) -> dict[str, Any]:
    """Return the protocols of scenes and of surface scores."""
    protocols: dict[str, Any] = {scene.protocol.name: scene.protocol for scene in plan.scenes}
    surfaces = {DTU: ("surface: dtu", DTU_SURFACE), TNT: ("surface: tnt", TNT_SURFACE)}
    for scene in plan.scenes:
        if scene.scored:
            name, protocol = surfaces.get(scene.data_set, ("surface: visible", VISIBLE_SURFACE))
            protocols[name] = protocol
    return protocols


def numbers_of(protocol: Any, within: str = "") -> dict[str, str]:
    """Return the numbers of a protocol as text by field name, with dots for nested fields."""
    numbers: dict[str, str] = {}
    for field in fields(protocol):
        value, name = getattr(protocol, field.name), within + field.name
        if is_dataclass(value):
            numbers |= numbers_of(value, f"{name}.")
        elif name != "name":
            numbers[name] = _words(value)
    return numbers


def _words(value: Any) -> str:
    if value is None:
        return "derived"
    if is_dataclass(value):
        return ", ".join(f"{name} {text}" for name, text in numbers_of(value).items())
    return "; ".join(map(_words, value)) if isinstance(value, tuple) else str(value)


def _scene_entry(scene: SweepScene) -> dict[str, Any]:
    truth = "found beside it" if scene.scored and scene.truth is None else scene.truth and str(scene.truth)
    entry = {"path": str(scene.path), "format": scene.format, "downscale": scene.downscale, "ground_truth": truth}
    return {**entry, "missing": list(scene.missing), "protocol": asdict(scene.protocol)}
