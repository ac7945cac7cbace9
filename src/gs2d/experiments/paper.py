"""One of the paper's tables, or a table of chosen recipes: train what the rows need, score it, write table and page."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gs2d.config.protocol_sources import stated
from gs2d.config.protocols import Protocol
from gs2d.config.surface_protocols import (
    DTU_SURFACE,
    TNT_SURFACE,
    VISIBLE_SURFACE,
    DtuSurface,
    TntSurface,
    VisibleSurface,
)
from gs2d.core.files import atomic_write
from gs2d.core.json_files import read_json, write_json
from gs2d.errors import RunError
from gs2d.experiments.aggregate import FIGURES, Results, Row, Verdict, judge, read_cell
from gs2d.experiments.commands import commands_of, paper_command
from gs2d.experiments.deviations import deviations_of
from gs2d.experiments.plan import PaperOptions, Plan, make_plan
from gs2d.experiments.render_page import write_page
from gs2d.experiments.render_text import to_csv, to_latex, to_markdown
from gs2d.experiments.scenes import FoundScene
from gs2d.experiments.slots import run_sweep
from gs2d.experiments.tables import DTU, SWEEP, TNT, PaperTable
from gs2d.io.run_dir import machine, make_folder, versions
from gs2d.pipeline.events import Notice, OnEvent, ignore

ABOUT = "about.json"
FIXED = ("table", "protocol", "schedule_scale", "downscale", "backend", "overrides")  # of all runs in a folder


@dataclass(frozen=True)
class PaperResult:
    """What came out.

    Attributes
    ----------
    files : tuple of Path
        table.json first.
    results : Results
    verdicts : tuple of Verdict
    failures : dict
        Job -> reason, of runs that failed.
    unfinished : int
        Runs that are not there yet (tabulated without training).
    """

    table: PaperTable
    files: tuple[Path, ...]
    results: Results
    verdicts: tuple[Verdict, ...]
    failures: dict[str, str]
    unfinished: int


def paper(options: PaperOptions, on_event: OnEvent = ignore) -> PaperResult:
    """Train what a table needs and is not there, and write the table.

    A run that fails leaves its cells empty, with the reason; the others go on.

    Raises
    ------
    Gs2dError
        The options or the data folder are wrong; nothing is trained then.
    """
    asked = make_plan(options)
    check_folder(asked)
    plan = with_other_rows(asked)
    others = [name for name in plan.options.recipes if name not in options.recipes]
    if others:
        on_event(Notice(f"{options.out} has rows of earlier commands, which stay: {', '.join(others)}"))
    if options.train:
        if options.lpips_weights is not None:
            from gs2d.evaluation.lpips import load_lpips  # loads torch

            load_lpips(options.lpips_weights)  # a wrong file is said now, not after hours of training
        make_folder(options.out)
        write_json(options.out / ABOUT, about(plan, None, ()))
        run_sweep(
            plan.sweep,
            on_event,
            slots=options.slots,
            threads=options.threads,
            backend=options.backend,
            slurm=options.slurm,
            after_job=lambda _job: _tabulate_so_far(plan),
        )
    return tabulate(with_other_rows(plan), on_event)


def _tabulate_so_far(plan: Plan) -> None:
    tabulate(with_other_rows(plan), pictures=False)


def with_other_rows(plan: Plan) -> Plan:
    """A sweep's plan with the rows of other commands too, earlier ones and those under way: none takes them away."""
    path = plan.options.out / ABOUT
    if plan.options.table != SWEEP or not path.exists():
        return plan
    found = read_json(path).get("recipes")
    if not isinstance(found, list):
        raise RunError(f"{path} must list the recipes of its sweep, got {found!r}; choose another --out")
    names = tuple(dict.fromkeys([*map(str, found), *plan.options.recipes]))
    return plan if names == plan.options.recipes else make_plan(replace(plan.options, recipes=names))


def check_folder(plan: Plan) -> None:
    """Refuse a folder whose runs were made for something else.

    Raises
    ------
    RunError
    """
    path = plan.options.out / ABOUT
    if plan.options.out.is_file():
        raise RunError(f"--out must be a folder, {plan.options.out} is a file")
    if not path.exists():
        return
    before, after = read_json(path).get("options"), json.loads(json.dumps(_defining(plan.options)))
    if not isinstance(before, dict):
        raise RunError(f"{path} must be one that gs2d paper or sweep wrote, got another file; choose another --out")
    for name, value in after.items():
        if before.get(name) != value:
            raise RunError(
                f"{plan.options.out} holds a table made with {name} = {before.get(name)}, now {value}; "
                "choose another --out (--cache may stay: stages that are the same are taken from there)"
            )


def _defining(options: PaperOptions) -> dict[str, Any]:
    return {name: getattr(options, name) for name in FIXED}


# -- tabulating ------------------------------------------------------------------------------------------------------
def tabulate(plan: Plan, on_event: OnEvent = ignore, *, pictures: bool = True) -> PaperResult:
    """Write table.json, .md, .csv, .tex, about.json and (with ``pictures``) index.html, from the runs as they are."""
    unfinished = sum(plan.sweep.record(job)["state"] not in ("done", "failed") for job in plan.sweep.jobs)
    results = Results(tuple(_row(plan, row) for row in plan.table.rows))
    verdicts = judge(plan.table, results)
    deviations = deviations_of(plan.options, plan.scenes, plan.table, results)
    out = plan.options.out
    make_folder(out)
    commands = [line for job in plan.sweep.jobs for line in commands_of(job)]
    write_json(out / "table.json", [row_json(row, results, deviations) for row in results.rows])
    write_json(out / ABOUT, {**about(plan, results, verdicts), "deviations": deviations})
    texts = {
        "table.md": to_markdown(plan.table, results, verdicts, deviations, [paper_command(plan.options), *commands]),
        "table.csv": to_csv(results),
        "table.tex": to_latex(plan.table, results),
    }
    for name, text in texts.items():
        with atomic_write(out / name, "w") as file:
            file.write(text)
    files = [out / name for name in ("table.json", *texts, ABOUT)]
    if pictures:
        facts = about(plan, results, verdicts)
        files.append(write_page(plan.table, results, verdicts, deviations, commands, facts, out, on_event))
    return PaperResult(plan.table, tuple(files), results, verdicts, plan.sweep.failures(), unfinished)


def _row(plan: Plan, row: Any) -> Row:
    cells, commands = [], []
    for scene in plan.scenes if row.recipe is not None else ():
        for seed in plan.options.seeds:
            job = plan.jobs[row.recipe, scene.name, seed]
            cells.append(
                read_cell(
                    job.train.out,
                    scene=scene.name,
                    data_set=scene.data_set,
                    seed=seed,
                    test_on=scene.protocol.test_on,
                    record=plan.sweep.record(job),
                    conventions=scene.protocol.metrics,
                )
            )
            commands += commands_of(job)
    paper_figures = {data_set: dict(figures) for data_set, figures in row.paper.items()}
    return Row(row.name, row.recipe, paper_figures, row.note, tuple(cells), tuple(commands))


def row_json(row: Row, results: Results, deviations: Sequence[str]) -> dict[str, Any]:
    """A row of table.json."""
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


def about(plan: Plan, results: Results | None, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """What the whole table was made with."""
    options = plan.options
    return {
        "table": plan.table.name,
        "title": plan.table.title,
        "recipes": [row.recipe for row in plan.table.trained],
        "options": _defining(options),
        "data": str(options.data),
        "scenes": {scene.name: {"data_set": scene.data_set, **_scene_facts(scene)} for scene in plan.scenes},
        "protocols": {name: [asdict(number) for number in stated(p)] for name, p in _protocols(plan).items()},
        "seeds": list(options.seeds),
        "spread": "standard deviation over seeds of the mean over scenes",
        "orders": [verdict.to_json() for verdict in verdicts],
        "failures": plan.sweep.failures() if results is not None else {},
        "command": paper_command(options),
        "versions": versions(),
        "machine": machine(),
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _protocols(plan: Plan) -> dict[str, Protocol | DtuSurface | TntSurface | VisibleSurface]:
    """The protocols of the scenes, and those that surfaces are scored by."""
    found: dict[str, Any] = {scene.protocol.name: scene.protocol for scene in plan.scenes}
    surfaces = {DTU: ("surface: dtu", DTU_SURFACE), TNT: ("surface: tnt", TNT_SURFACE)}
    for scene in plan.scenes:
        if scene.scored:
            name, protocol = surfaces.get(scene.data_set, ("surface: visible", VISIBLE_SURFACE))
            found[name] = protocol
    return found


def _scene_facts(scene: FoundScene) -> dict[str, Any]:
    truth = "found beside it" if scene.scored and scene.truth is None else scene.truth and str(scene.truth)
    facts = {"path": str(scene.path), "format": scene.format, "downscale": scene.downscale, "ground_truth": truth}
    return {**facts, "missing": list(scene.missing), "protocol": asdict(scene.protocol)}
