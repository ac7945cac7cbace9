"""Aggregates runs into rows: figures of each run, means over scenes and seeds, and checks of the paper's claims."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gs2d.config.protocols import MetricConventions
from gs2d.contrib.lab.paper_tables import DTU, LOWER_IS_BETTER, METRICS, NERF_SYNTHETIC, TNT, Claim, PaperTable
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import open_run

FIGURES = (*METRICS, "bytes", "seconds")
IMAGES = ("psnr", "ssim", "lpips")
DATA_SETS = (DTU, NERF_SYNTHETIC, TNT)
NOT_YET = ("not trained yet", "under way or interrupted")


@dataclass(frozen=True)
class Cell:
    """The figures of one run."""

    scene: str
    data_set: str
    seed: int
    figures: dict[str, float | None]  # one entry for each of FIGURES; None where there is none
    reasons: dict[str, str]  # why figures are None
    run: Path
    # splats, surface thresholds, metrics of each stage, measured views
    details: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return scene, seed and figures as one flat object."""
        entry = {"scene": self.scene, "data_set": self.data_set, "seed": self.seed, **self.figures}
        return {**entry, "reasons": self.reasons, "run": str(self.run), **self.details}


@dataclass(frozen=True)
class Row:
    """A row of a table with its measured cells."""

    name: str
    recipe: str | None
    paper: dict[str, dict[str, float]]
    note: str
    cells: tuple[Cell, ...]
    commands: tuple[str, ...] = ()

    def of(self, data_set: str | None) -> list[Cell]:
        """Return the cells of one data set, or all."""
        return [cell for cell in self.cells if data_set in (None, cell.data_set)]


@dataclass(frozen=True)
class Results:
    """The rows of a table.

    Means are over the runs (scene, seed) that *all* trained rows have, so that rows are comparable; rows without runs
    are ignored. Figures that were measured in different ways have no common mean (:func:`measured_on`). For images,
    test views count if there are any.
    """

    rows: tuple[Row, ...]

    @property
    def data_sets(self) -> tuple[str, ...]:
        """Return the trained data sets."""
        return tuple(dict.fromkeys(cell.data_set for row in self.rows for cell in row.cells))

    def counted(self, metric: str, data_set: str | None = None) -> set[tuple[str, int]]:
        """Return the runs (scene, seed) in the means of a metric; empty without a common mean."""
        kinds = self._kinds(metric, data_set)
        one = "test views" if "test views" in kinds else next(iter(kinds), "")
        if len(kinds) > 1 and metric not in IMAGES:
            return set()
        have = [
            {
                (c.scene, c.seed)
                for c in r.of(data_set)
                if c.figures[metric] is not None and measured_on(c, metric) == one
            }
            for r in self.rows
        ]
        return set.intersection(*filter(None, have)) if any(have) else set()

    def _kinds(self, metric: str, data_set: str | None) -> set[str]:
        """Return the ways in which a metric was measured."""
        cells = (c for r in self.rows for c in r.of(data_set) if c.figures[metric] is not None)
        return {measured_on(cell, metric) for cell in cells}

    def scenes(self, metric: str, data_set: str | None = None) -> list[str]:
        """Return the scenes in the means of a metric."""
        counted = {scene for scene, _ in self.counted(metric, data_set)}
        return [s for s in dict.fromkeys(c.scene for r in self.rows for c in r.of(data_set)) if s in counted]

    def mean(self, row: Row, data_set: str | None = None) -> dict[str, float | None]:
        """Return each figure as the mean over scenes of the mean over seeds; None without values."""
        figures: dict[str, float | None] = {}
        for name in FIGURES:
            values = self._values(row, name, data_set)
            means = [statistics.fmean(by_seed.values()) for by_seed in values.values()]
            figures[name] = statistics.fmean(means) if means else None
        return figures

    def spread(self, row: Row, data_set: str | None = None) -> dict[str, float | None]:
        """Return the deviation over seeds of the mean over scenes; None with fewer than two complete seeds."""
        figures: dict[str, float | None] = {}
        for name in FIGURES:
            means = by_seed(self._values(row, name, data_set))
            figures[name] = statistics.stdev(means) if len(means) > 1 else None
        return figures

    def _values(self, row: Row, name: str, data_set: str | None) -> dict[str, dict[int, float]]:
        """Return the values in the mean by scene and seed."""
        counted = self.counted(name, data_set)
        by_scene: dict[str, dict[int, float]] = {}
        for cell in row.of(data_set):
            value = cell.figures[name]
            if value is not None and (cell.scene, cell.seed) in counted:
                by_scene.setdefault(cell.scene, {})[cell.seed] = value
        return by_scene

    def reasons(self, row: Row) -> dict[str, str]:
        """Return the reasons of figures without a mean."""
        if not row.cells:
            why = "not trained here" if row.recipe is None else "not trained yet"
            return dict.fromkeys(FIGURES, why)
        means, reasons = self.mean(row), {}
        for name in (n for n in FIGURES if means[n] is None):
            cell = next((c for c in row.cells if c.figures[name] is None), None)
            if len(kinds := self._kinds(name, None)) > 1 and name not in IMAGES:
                reasons[name] = f"measured in different ways, which have no common mean: {'; '.join(sorted(kinds))}"
            elif cell is None:
                reasons[name] = "no scene and seed that every row has"
            else:
                reasons[name] = f"{cell.scene}, seed {cell.seed}: {cell.reasons.get(name, 'not measured')}"
        return reasons


def measured_on(cell: Cell, metric: str) -> str:
    """Return the split of the views, or protocol and unit of a surface; figures of one mean have the same."""
    if metric in IMAGES:
        return f"{cell.details.get('views', 'test')} views"
    if metric not in ("fscore", "chamfer"):
        return ""
    surface = cell.details.get("surface") or {}
    protocol = str(surface.get("evaluator", "visible-surface"))
    if metric == "fscore":
        return f"protocol {protocol}"
    unit = str(surface.get("unit", "world units"))
    if unit != "world units":
        return f"protocol {protocol}, {unit}"
    # world units differ by capture, except within a data set
    return f"protocol {protocol}, units of {cell.data_set if cell.data_set in DATA_SETS else cell.scene}"


def by_seed(values: dict[str, dict[int, float]]) -> list[float]:
    """Return means over scenes, from values by scene and seed, for each seed that all scenes have, by seed."""
    seeds = set.intersection(*(set(of_scene) for of_scene in values.values())) if values else set()
    return [statistics.fmean([of_scene[seed] for of_scene in values.values()]) for seed in sorted(seeds)]


def read_cell(
    run: Path,
    *,
    scene: str,
    data_set: str,
    seed: int,
    test_on: str,
    record: dict[str, Any],
    conventions: MetricConventions = MetricConventions(),  # noqa: B008 (frozen)
) -> Cell:
    """Return the figures of a run from its ``metrics.json``; missing ones are None, with a reason.

    ``test_on`` ("test" or "train") names the views whose image metrics count, ``record`` is the record of the run's
    task. The protocol's ``conventions`` say which image metrics count, and the main figure of the surface.
    """
    figures: dict[str, float | None] = dict.fromkeys(FIGURES)
    place: dict[str, Any] = {"scene": scene, "data_set": data_set, "seed": seed, "run": run}
    failed = record["state"] == "failed"
    if record["state"] != "done" and not (failed and record.get("trained")):  # trained: only its surface is lost
        why = record.get("reason") or NOT_YET[record["state"] == "running"]
        return Cell(figures=figures, reasons=dict.fromkeys(FIGURES, str(why)), **place)
    try:
        folder = open_run(run)
        metrics, backend = folder.metrics(), _backend(folder.definition())
    except Gs2dError as error:
        return Cell(figures=figures, reasons=dict.fromkeys(FIGURES, str(error)), **place)
    if not metrics["stages"]:
        return Cell(figures=figures, reasons=dict.fromkeys(FIGURES, f"{run} has no metrics.json"), **place)
    last, reasons = metrics["stages"][-1], {}
    views = last.get(test_on)
    for name, measured in measured_as(conventions).items():
        figures[name] = (views or {}).get(measured)
        if figures[name] is None:
            why = last.get(f"{test_on}_reason") if views is None else views.get(f"{measured}_reason")
            reasons[name] = str(why or "not measured")
    figures["bytes"] = last["bytes"]
    figures["seconds"] = round(sum(stage["seconds"] for stage in metrics["stages"]), 3)  # shared stages count too
    surface = surface_figures(metrics.get("surface"), data_set)
    figures.update(surface)
    notes = {"surface": record["reason"]} if failed else record.get("notes") or {}
    for name in (n for n in ("fscore", "chamfer") if figures[n] is None):
        reasons[name] = notes.get("surface") or (metrics.get("surface") or {}).get("reason") or "no ground truth"
    details = {
        "backend": backend,
        "splats": last["splats"],
        "views": test_on,
        "headline": "chamfer" if conventions.surface == "chamfer" else "fscore",
        "surface": metrics.get("surface"),
        "stages": [{"name": s["name"], "seconds": s["seconds"], **_scores(s, test_on)} for s in metrics["stages"]],
    }
    return Cell(figures=figures, reasons=reasons, details=details, **place)


def measured_as(conventions: MetricConventions) -> dict[str, str]:
    """Return the names in ``metrics.json`` of the image metrics of a table."""
    suffix = "" if conventions.from_8bit else "_float"
    lpips = "lpips" if conventions.lpips_unit_range else "lpips_signed"
    return {"psnr": f"psnr{suffix}", "ssim": f"ssim{suffix}", "lpips": lpips}


def surface_metric(rows: Sequence[Row], data_set: str) -> str:
    """Return the main figure of the surfaces of a data set."""
    named = {c.details["headline"] for row in rows for c in row.of(data_set) if "headline" in c.details}
    return named.pop() if len(named) == 1 else "chamfer" if data_set == DTU else "fscore"


def _backend(definition: dict[str, Any]) -> str:
    """Return the name of the backend of a run."""
    return str((definition.get("backend") or {}).get("name", "unknown"))


def _scores(stage: dict[str, Any], test_on: str) -> dict[str, Any]:
    return {"splats": stage["splats"], "psnr": (stage.get(test_on) or {}).get("psnr")}


def surface_figures(surface: dict[str, Any] | None, data_set: str) -> dict[str, float | None]:
    """Return F-score at the first threshold, and Chamfer distance, from ``surface`` of ``metrics.json``."""
    if not surface:
        return {"fscore": None, "chamfer": None}
    return {"fscore": surface.get("f_score"), "chamfer": surface.get("chamfer")}


# -- claims ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class StageStep:
    """The difference of two neighbouring rows of a claim, in the direction of the paper."""

    lower: str
    upper: str  # the row that is better in the paper (or not worse, or equal)
    metric: str
    difference: float  # mean over scenes and seeds of upper minus lower, with inverted sign if lower values are better
    spread: float | None  # standard deviation over seeds of the mean over scenes of the difference
    seeds: int
    seeds_with_sign: int  # seeds with the order of the paper


@dataclass(frozen=True)
class ClaimResult:
    """Result of a claim of the paper on one data set.

    ``holds`` is "yes", "no", "open" (the seeds disagree) or "unknown" (a figure is missing: ``reason``).
    """

    text: str
    metric: str
    kind: str
    data_set: str
    holds: str
    steps: tuple[StageStep, ...]
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def check_claims(table: PaperTable, results: Results) -> tuple[ClaimResult, ...]:
    """Check each claim of a table on each trained data set."""
    return tuple(check_claim(claim, results.rows, d) for d in results.data_sets for claim in table.claims)


def check_claim(claim: Claim, rows: Sequence[Row], data_set: str) -> ClaimResult:
    """Check a claim on a data set."""
    metric = claim.metric
    if metric == "surface":
        metric = surface_metric(rows, data_set)
    by_name = {row.name: row for row in rows}
    common = (claim.text, metric, claim.kind, data_set)
    for name in claim.rows:
        cells = by_name[name].of(data_set)
        if all(cell.figures[metric] is None for cell in cells):
            why = cells[0].reasons.get(metric, "not measured") if cells else "not trained"
            return ClaimResult(*common, "unknown", (), f"no {METRICS[metric]} of {name}: {why}")
    steps = tuple(_step(by_name[a], by_name[b], metric, data_set, claim) for a, b in _pairs(claim))
    if not all(step.seeds for step in steps):
        return ClaimResult(*common, "unknown", (), "no seed at which both rows have all of their scenes")
    if all(step.seeds_with_sign == step.seeds for step in steps):
        holds = "yes"
    elif any(step.seeds_with_sign == 0 for step in steps):
        holds = "no"
    else:
        holds = "open"
    return ClaimResult(*common, holds, steps)


def _pairs(claim: Claim) -> list[tuple[str, str]]:
    rows = claim.rows
    if claim.kind == "best":
        return [(row, rows[-1]) for row in rows[:-1]]
    if claim.kind == "flat":  # all pairs, so that the worst and best are shown
        return [(a, b) for i, a in enumerate(rows) for b in rows[i + 1 :]]
    return list(itertools.pairwise(rows))


def _step(lower: Row, upper: Row, metric: str, data_set: str, claim: Claim) -> StageStep:
    sign = -1.0 if metric in LOWER_IS_BETTER else 1.0
    values = {row.name: {(c.scene, c.seed): c.figures[metric] for c in row.of(data_set)} for row in (lower, upper)}
    by_scene: dict[str, dict[int, float]] = {}
    for (scene, seed), high in values[upper.name].items():
        low = values[lower.name].get((scene, seed))
        if high is not None and low is not None:
            by_scene.setdefault(scene, {})[seed] = sign * (high - low)
    differences = by_seed(by_scene)
    within = claim.within or 0.0
    if claim.kind == "flat":
        right = [abs(d) <= within for d in differences]
    elif claim.kind == "at least":  # within the rounding of the paper
        right = [d >= -ROUNDING[metric] for d in differences]
    else:
        right = [d > 0 for d in differences]
    spread = statistics.stdev(differences) if len(differences) > 1 else None
    mean = statistics.fmean(differences) if differences else 0.0
    return StageStep(lower.name, upper.name, metric, mean, spread, len(right), sum(right))


ROUNDING = {"fscore": 0.005, "chamfer": 0.005, "psnr": 0.005, "ssim": 0.0005, "lpips": 0.0005}
