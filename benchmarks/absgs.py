"""Choose the thresholds of AbsGS-A, for which the paper gives no values, by a parameter sweep.

::

    python -m benchmarks.absgs --data CAPTURES --out runs/absgs [--scenes lego scan24] [--schedule-scale 0.1]

The paper only says "more sensitive thresholds for size and positional gradient". The sweep therefore divides the
thresholds of AbsGS-D: both gradient thresholds by one factor, the size threshold (``percent_dense``) by another. Every
candidate trains stage 3 only; stages 1 and 2 are shared through ``--cache``, also with `gs2d sweep`. A is the candidate
more sensitive than D with the highest mean PSNR, because the paper tuned for rendering quality. The PSNR is measured on
the reported test views, so row A is optimistic. An interrupted sweep can be restarted.
"""

from __future__ import annotations

import argparse
import itertools
import shlex
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gs2d.contrib.lab.aggregate import Cell, read_cell
from gs2d.contrib.lab.execute import Workers, execute
from gs2d.contrib.lab.lab_options import SweepOptions
from gs2d.contrib.lab.paper_recipes import ABSGS_DEFAULT
from gs2d.contrib.lab.scenes import SweepScene, find_scenes
from gs2d.contrib.lab.table_plan import make_task, trained_recipe
from gs2d.contrib.lab.training_task import TrainingTask
from gs2d.core.atomic_files import atomic_write
from gs2d.core.json_files import write_json
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import machine, versions
from gs2d.training.events import Event, Notice

RECIPE = "2dgs-r-absgs-d"
FACTORS = (1, 2, 4)  # divisors of the thresholds of D
HEADS = ("gradient /", "size /", "clone", "split", "percent_dense", "splats", "PSNR", "surface", "seconds", "runs")


@dataclass(frozen=True)
class Candidate:
    """Thresholds of D with the gradient and size thresholds divided by one factor each."""

    gradient: int
    size: int

    @property
    def thresholds(self) -> dict[str, float]:
        """Return the overrides of ``GradDensify`` fields."""
        return {
            "grad_threshold": ABSGS_DEFAULT.grad_threshold / self.gradient,
            "abs_threshold": ABSGS_DEFAULT.abs_threshold / self.gradient,
            "percent_dense": ABSGS_DEFAULT.percent_dense / self.size,
        }

    @property
    def overrides(self) -> tuple[str, ...]:
        """Return the ``--set`` arguments for `gs2d train --recipe 2dgs-r-absgs-d`."""
        return tuple(f"refine.densify.{name}={value:g}" for name, value in self.thresholds.items())

    @property
    def name(self) -> str:
        """Return a name for files."""
        return f"g{self.gradient}-s{self.size}"


CANDIDATES = tuple(Candidate(g, s) for g, s in itertools.product(FACTORS, FACTORS))


def make_jobs(options: SweepOptions, scenes: Sequence[SweepScene]) -> dict[tuple[Candidate, str, int], TrainingTask]:
    """Return one run per candidate, scene and seed."""
    jobs = {}
    for candidate, scene, seed in itertools.product(CANDIDATES, scenes, options.seeds):
        changed = replace(options, overrides=(*options.overrides, *candidate.overrides))
        job = make_task(changed, scene, RECIPE, trained_recipe(RECIPE, changed), seed)
        name = f"{scene.name}-{candidate.name}-s{seed}"
        run = replace(job.train, out=options.out / "runs" / name)
        record = job.record.with_name(f"{name}.json")
        jobs[candidate, scene.name, seed] = replace(job, name=name, record=record, train=run)
    return jobs


def choose(cells: Mapping[Candidate, Sequence[Cell]]) -> Candidate | None:
    """Return the candidate more sensitive than D with the highest mean PSNR, or None; incomplete candidates are
    ignored.
    """
    scores = {
        candidate: [psnr for cell in found if (psnr := cell.figures["psnr"]) is not None]
        for candidate, found in cells.items()
        if candidate.gradient * candidate.size > 1
    }
    most = max((len(values) for values in scores.values()), default=0)
    whole = {c: statistics.fmean(values) for c, values in scores.items() if values and len(values) == most}
    return max(whole, key=lambda candidate: whole[candidate], default=None)


def rows_of(cells: Mapping[Candidate, Sequence[Cell]]) -> list[list[str]]:
    """Return a row per candidate: thresholds, and means over scenes and seeds."""
    rows = []
    for candidate, found in cells.items():
        done = [cell for cell in found if cell.figures["psnr"] is not None]
        surface = "chamfer" if done and all(c.figures["fscore"] is None for c in done) else "fscore"
        figures = [mean([cell.figures[name] for cell in done]) for name in ("psnr", surface, "seconds")]
        splats = mean([cell.details["splats"] for cell in done])
        rows.append(
            [
                str(candidate.gradient),
                str(candidate.size),
                *(f"{value:g}" for value in candidate.thresholds.values()),
                *("-" if v is None else f"{v:,.{d}f}" for v, d in zip((splats, *figures), (0, 2, 4, 0), strict=True)),
                f"{len(done)} of {len(found)}",
            ]
        )
    return rows


def mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of the values that are not missing."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def markdown(cells: Mapping[Candidate, Sequence[Cell]], chosen: Candidate | None, command: str) -> str:
    """Return the table and the chosen candidate in Markdown."""
    lines = ["| " + " | ".join(HEADS) + " |", "|---" * len(HEADS) + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows_of(cells)]
    said = "Nothing can be chosen: no run is finished."
    if chosen is not None:
        said = f"AbsGS-A: {', '.join(chosen.overrides)}."
    reasons = {f"{cell.run.name}: {cell.reasons['psnr']}" for found in cells.values() for cell in found if lost(cell)}
    return "\n".join([*lines, "", said, "", *(f"- {text}" for text in sorted(reasons)), "", f"`{command}`", ""])


def lost(cell: Cell) -> bool:
    """Return True if a run failed."""
    return cell.figures["psnr"] is None and "psnr" in cell.reasons


def sweep(options: SweepOptions) -> Candidate | None:
    """Train all candidates and write ``absgs.json`` and ``absgs.md``."""
    scenes = find_scenes(options.data, options.scenes, truths=options.ground_truth)
    jobs = make_jobs(options, scenes)
    todo = tuple(jobs.values())
    execute(todo, options.out, say, workers=Workers(options.slots, options.threads, options.backend))
    cells: dict[Candidate, list[Cell]] = {candidate: [] for candidate in CANDIDATES}
    for (candidate, name, seed), job in jobs.items():
        scene = next(scene for scene in scenes if scene.name == name)
        place: dict[str, Any] = {
            "scene": name,
            "data_set": scene.data_set,
            "seed": seed,
            "test_on": scene.protocol.test_on,
        }
        cells[candidate].append(read_cell(job.train.out, record=job.status(), **place))
    chosen = choose(cells)
    command = shlex.join(["python", "-m", "benchmarks.absgs", *sys.argv[1:]])
    found = [{**c.thresholds, "runs": [cell.to_json() for cell in cells[c]]} for c in CANDIDATES]
    thresholds = None if chosen is None else chosen.thresholds
    made = {"schedule_scale": options.schedule_scale, "command": command, "machine": machine(), "versions": versions()}
    write_json(options.out / "absgs.json", {"chosen": thresholds, "candidates": found, **made})
    with atomic_write(options.out / "absgs.md", "w") as file:
        file.write(markdown(cells, chosen, command))
    return chosen


def say(event: Event) -> None:
    """Print a notice."""
    if isinstance(event, Notice):
        print(event.text, flush=True)


def main() -> None:
    """Parse the arguments and run the sweep."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.absgs", description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=[])
    parser.add_argument("--schedule-scale", type=float, default=1.0)
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--slots", type=int)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--ground-truth", type=Path)
    given = vars(parser.parse_args())
    given |= {"scenes": tuple(given["scenes"]), "seeds": tuple(given["seeds"])}
    try:
        sweep(SweepOptions(recipes=("absgs",), **given))
    except Gs2dError as error:
        sys.exit(f"error: {error}")
    print((given["out"] / "absgs.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
