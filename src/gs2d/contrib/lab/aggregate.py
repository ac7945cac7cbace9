"""From runs to rows: the figures of each run, means over scenes and seeds, and whether the paper's claims hold."""

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
    """What one run came to.

    Attributes
    ----------
    scene, data_set : str
    seed : int
    figures : dict
        One entry for each of FIGURES; None where there is none.
    reasons : dict
        Why, for those that are None.
    run : Path
    details : dict
        Other facts: splats, surface thresholds, image metrics of each stage, which views were measured.
    """

    scene: str
    data_set: str
    seed: int
    figures: dict[str, float | None]
    reasons: dict[str, str]
    run: Path
    details: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Flat: the figures beside scene and seed."""
        facts = {"scene": self.scene, "data_set": self.data_set, "seed": self.seed, **self.figures}
        return {**facts, "reasons": self.reasons, "run": str(self.run), **self.details}


@dataclass(frozen=True)
class Row:
    """A row of a table with what was measured for it."""

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

    Means are over the runs (scene, seed) that *every* trained row has: a mean over other scenes than those of the row
    above would be compared with it all the same. Rows of which nothing is there yet do not count for this. Figures that
    were measured otherwise have no common mean (:func:`measured_on`); of images, test views count where there are any.
    """

    rows: tuple[Row, ...]

    @property
    def data_sets(self) -> tuple[str, ...]:
        """Those that were trained."""
        return tuple(dict.fromkeys(cell.data_set for row in self.rows for cell in row.cells))

    def counted(self, metric: str, data_set: str | None = None) -> set[tuple[str, int]]:
        """Return the (scene, seed) that means of a metric are taken over; none where there is no common mean."""
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
        """On what, and how, a metric was measured."""
        cells = (c for r in self.rows for c in r.of(data_set) if c.figures[metric] is not None)
        return {measured_on(cell, metric) for cell in cells}

    def scenes(self, metric: str, data_set: str | None = None) -> list[str]:
        """Return the scenes that means of a metric are taken over."""
        counted = {scene for scene, _ in self.counted(metric, data_set)}
        return [s for s in dict.fromkeys(c.scene for r in self.rows for c in r.of(data_set)) if s in counted]

    def mean(self, row: Row, data_set: str | None = None) -> dict[str, float | None]:
        """Mean over scenes of the mean over seeds of each figure; None where there is none."""
        found: dict[str, float | None] = {}
        for name in FIGURES:
            values = self._values(row, name, data_set)
            means = [statistics.fmean(by_seed.values()) for by_seed in values.values()]
            found[name] = statistics.fmean(means) if means else None
        return found

    def spread(self, row: Row, data_set: str | None = None) -> dict[str, float | None]:
        """Return the deviation over seeds of the mean over scenes; None with fewer than two seeds that have all."""
        found: dict[str, float | None] = {}
        for name in FIGURES:
            means = by_seed(self._values(row, name, data_set))
            found[name] = statistics.stdev(means) if len(means) > 1 else None
        return found

    def _values(self, row: Row, name: str, data_set: str | None) -> dict[str, dict[int, float]]:
        """Scene -> seed -> value, of those that count."""
        counted = self.counted(name, data_set)
        found: dict[str, dict[int, float]] = {}
        for cell in row.of(data_set):
            value = cell.figures[name]
            if value is not None and (cell.scene, cell.seed) in counted:
                found.setdefault(cell.scene, {})[cell.seed] = value
        return found

    def reasons(self, row: Row) -> dict[str, str]:
        """Why a figure has no mean."""
        if not row.cells:
            why = "not trained here" if row.recipe is None else "not trained yet"
            return dict.fromkeys(FIGURES, why)
        means, found = self.mean(row), {}
        for name in (n for n in FIGURES if means[n] is None):
            cell = next((c for c in row.cells if c.figures[name] is None), None)
            if len(kinds := self._kinds(name, None)) > 1 and name not in IMAGES:
                found[name] = f"measured in different ways, which have no common mean: {'; '.join(sorted(kinds))}"
            elif cell is None:
                found[name] = "no scene and seed that every row has"
            else:
                found[name] = f"{cell.scene}, seed {cell.seed}: {cell.reasons.get(name, 'not measured')}"
        return found


def measured_on(cell: Cell, metric: str) -> str:
    """Return what figures must share to have a mean: the split of the views, the protocol and unit of surfaces."""
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
    # every capture has world units of its own, but for those that one data set has in common
    return f"protocol {protocol}, units of {cell.data_set if cell.data_set in DATA_SETS else cell.scene}"


def by_seed(values: dict[str, dict[int, float]]) -> list[float]:
    """Means over scenes (scene -> seed -> value) at each seed that all of the scenes have, in order of the seeds.

    A seed that lacks a scene would be compared with others over other scenes.
    """
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
    """Return the figures of a run, from its ``metrics.json``; None with a reason where there are none.

    Parameters
    ----------
    test_on : str
        "test" or "train": the views whose image metrics count.
    record : dict
        What the sweep wrote about the task.
    conventions : MetricConventions
        The protocol's: which of the image metrics count, and which figure of the surface is the headline.
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
    """Return the image metrics of a table -> their names in ``metrics.json``."""
    suffix = "" if conventions.from_8bit else "_float"
    lpips = "lpips" if conventions.lpips_unit_range else "lpips_signed"
    return {"psnr": f"psnr{suffix}", "ssim": f"ssim{suffix}", "lpips": lpips}


def surface_metric(rows: Sequence[Row], data_set: str) -> str:
    """Return the headline figure of a data set's surfaces: what its protocol says."""
    named = {c.details["headline"] for row in rows for c in row.of(data_set) if "headline" in c.details}
    return named.pop() if len(named) == 1 else "chamfer" if data_set == DTU else "fscore"


def _backend(definition: dict[str, Any]) -> str:
    """Return the backend that trained a run, by its name."""
    return str((definition.get("backend") or {}).get("name", "unknown"))


def _scores(stage: dict[str, Any], test_on: str) -> dict[str, Any]:
    scores = {"splats": stage["splats"], "psnr": (stage.get(test_on) or {}).get("psnr")}
    clone = (stage.get("after_clone") or {}).get(test_on)
    return {**scores, "psnr_after_clone": clone["psnr"]} if clone else scores


def surface_figures(surface: dict[str, Any] | None, data_set: str) -> dict[str, float | None]:
    """F-score at the first threshold, and Chamfer distance, from the ``surface`` entry of ``metrics.json``."""
    if not surface:
        return {"fscore": None, "chamfer": None}
    return {"fscore": surface.get("f_score"), "chamfer": surface.get("chamfer")}


# -- claims ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class StageStep:
    """The difference of two neighbouring rows of a claim, in the direction in which the paper has it.

    Attributes
    ----------
    lower, upper : str
        Rows; the paper says that ``upper`` is better (or not worse, or alike).
    metric : str
    difference : float
        Mean over scenes and seeds of better-ness: upper minus lower, the other way round where lower is better.
    spread : float or None
        Standard deviation over seeds of the mean over scenes of the difference, taken seed by seed.
    seeds : int
    seeds_with_sign : int
        At so many of them the order is the paper's.
    """

    lower: str
    upper: str
    metric: str
    difference: float
    spread: float | None
    seeds: int
    seeds_with_sign: int


@dataclass(frozen=True)
class ClaimResult:
    """Whether one of the paper's claims holds on one data set.

    ``holds`` is "yes", "no", "open" (the seeds disagree) or "unknown" (something was not measured: ``reason``).
    """

    text: str
    metric: str
    kind: str
    data_set: str
    holds: str
    steps: tuple[StageStep, ...]
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def check_claims(table: PaperTable, results: Results) -> tuple[ClaimResult, ...]:
    """Every claim of a table, on every data set that was trained."""
    return tuple(check_claim(claim, results.rows, d) for d in results.data_sets for claim in table.claims)


def check_claim(claim: Claim, rows: Sequence[Row], data_set: str) -> ClaimResult:
    """One claim on one data set."""
    metric = claim.metric
    if metric == "surface":
        metric = surface_metric(rows, data_set)
    by_name = {row.name: row for row in rows}
    facts = (claim.text, metric, claim.kind, data_set)
    for name in claim.rows:
        cells = by_name[name].of(data_set)
        if all(cell.figures[metric] is None for cell in cells):
            why = cells[0].reasons.get(metric, "not measured") if cells else "not trained"
            return ClaimResult(*facts, "unknown", (), f"no {METRICS[metric]} of {name}: {why}")
    steps = tuple(_step(by_name[a], by_name[b], metric, data_set, claim) for a, b in _pairs(claim))
    if not all(step.seeds for step in steps):
        return ClaimResult(*facts, "unknown", (), "no seed at which both rows have all of their scenes")
    if all(step.seeds_with_sign == step.seeds for step in steps):
        holds = "yes"
    elif any(step.seeds_with_sign == 0 for step in steps):
        holds = "no"
    else:
        holds = "open"
    return ClaimResult(*facts, holds, steps)


def _pairs(claim: Claim) -> list[tuple[str, str]]:
    rows = claim.rows
    if claim.kind == "best":
        return [(row, rows[-1]) for row in rows[:-1]]
    if claim.kind == "flat":  # the worst and the best decide, but the reader wants to see who they are
        return [(a, b) for i, a in enumerate(rows) for b in rows[i + 1 :]]
    return list(itertools.pairwise(rows))


def _step(lower: Row, upper: Row, metric: str, data_set: str, claim: Claim) -> StageStep:
    sign = -1.0 if metric in LOWER_IS_BETTER else 1.0
    values = {row.name: {(c.scene, c.seed): c.figures[metric] for c in row.of(data_set)} for row in (lower, upper)}
    found: dict[str, dict[int, float]] = {}
    for (scene, seed), high in values[upper.name].items():
        low = values[lower.name].get((scene, seed))
        if high is not None and low is not None:
            found.setdefault(scene, {})[seed] = sign * (high - low)
    differences = by_seed(found)
    within = claim.within or 0.0
    if claim.kind == "flat":
        right = [abs(d) <= within for d in differences]
    elif claim.kind == "at least":  # not worse by more than the paper rounds away
        right = [d >= -ROUNDING[metric] for d in differences]
    else:
        right = [d > 0 for d in differences]
    spread = statistics.stdev(differences) if len(differences) > 1 else None
    mean = statistics.fmean(differences) if differences else 0.0
    return StageStep(lower.name, upper.name, metric, mean, spread, len(right), sum(right))


ROUNDING = {"fscore": 0.005, "chamfer": 0.005, "psnr": 0.005, "ssim": 0.0005, "lpips": 0.0005}
