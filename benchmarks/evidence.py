"""Run experiments that separate effects of the method from effects of the implementation (docs/notebook/results.md).

::

    python -m benchmarks.evidence DATA FOLDER [--scale 1] [--seed 0] [--captures lego bottle] [--recipes 2dgs ...]
        [--results FILE]

DATA holds the captures. Runs use ``gs2d train ... --set cache=DIR``, so the first 30,000 iterations are trained once.
Finished runs are skipped and interrupted runs are resumed. Times are wall time in seconds, summed over all stages of
a recipe, including cached ones. Figures are written to ``FOLDER/evidence.json`` and a table is printed. ``--results``
merges the rows into FILE, which can collect rows of several days. Each row records its commit and machine; check out
the same commit before continuing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path
from typing import Any

from benchmarks.controls import spec
from benchmarks.quality_run import score_splats
from benchmarks.results import Case, Method, run_case
from gs2d.core.json_files import write_json
from gs2d.io.run_dir import SPLATS, RunFolder
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.render.backends import get_backend
from gs2d.training.events import ignore

CASES = {
    "lego": Case("lego", "nerf_synthetic_lego", downscale=2),
    "bottle": Case("bottle", "rendered_bottle", ground_truth="mesh_gt.ply"),
}
RECIPES = (
    *("2dgs", "2dgs-60k", "2dgs-r", "2dgs-60k-restart", "2dgs-r-restart", "2dgs-no-nc", "2dgs-r-no-clone"),
    *("2dgs-60k-no-nc-late", "best", "2dgs-60k-edges-camera"),
)
KEY = ("capture", "recipe", "seed", "scale")  # of a row


def row_of(case: Case, recipe: str, args: argparse.Namespace) -> dict[str, Any]:
    """Train and score one run unless it is finished, and return its figures."""
    metrics = run_case(case, Method(recipe, recipe, spec(recipe)), str(args.data), args.folder, args.scale, args.seed)
    run = RunFolder(args.folder / f"{case.name}-{recipe}-s{args.seed}")
    stages, surface = metrics["stages"], metrics.get("surface")
    return {
        "capture": case.name,
        "recipe": recipe,
        "seed": args.seed,
        "scale": args.scale,
        "iterations": sum(stage["iterations"] for stage in stages),
        "seconds": sum(stage["seconds"] for stage in stages),
        "train_psnr": (stages[-1].get("train") or {}).get("psnr"),
        **score_splats(reload_run(run, ignore), read_splats(run.file(SPLATS))),
        "f_scores": [] if surface is None else [row["f_score"] for row in surface["thresholds"]],
        "chamfer": None if surface is None else surface["chamfer"],
        "made": made_by(run.definition()),
    }


def made_by(definition: dict[str, Any]) -> dict[str, Any]:
    """Return the provenance of a run: date, machine and versions, and the commit and kernels that score it."""
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(words, capture_output=True, text=True).stdout.strip()
    facts = {name: definition[key] for name, key in (("date", "created"), ("machine", "machine"))}
    return {
        "commit": commit or None,
        **facts,
        "kernels": get_backend("cpu").status().details,
        "versions": definition["versions"],
    }


def merge_row(file: Path, row: dict[str, Any]) -> None:
    """Merge a row into a results file, replacing the row with the same capture, recipe, seed and scale."""
    kept = json.loads(file.read_text())["rows"] if file.exists() else []
    found = {tuple(other[name] for name in KEY): other for other in kept}
    found[tuple(row[name] for name in KEY)] = row
    write_json(file, {"format": 1, "rows": list(found.values())})


def line_of(row: dict[str, Any]) -> str:
    """Return a table row."""
    fine = f"{row['f_scores'][0]:.3f} | {row['chamfer']:.5f}" if row["f_scores"] else " | "
    images = row["images"]
    return (
        f"| {row['capture']} | `{row['recipe']}` | {row['iterations']:,} | {images['psnr']:.2f} "
        f"| {images['worst_psnr']:.2f} | {row['train_psnr']:.2f} | {fine} | {row['splats']:,} "
        f"| {row['longest_splat']:.2f} | {row['seconds']:.0f} |"
    )


def main(arguments: list[str] | None = None) -> None:
    """Run missing experiments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--captures", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--recipes", nargs="+", default=list(RECIPES))
    parser.add_argument("--results", type=Path, help="results file that collects the rows of several days")
    args = parser.parse_args(arguments)
    args.folder.mkdir(parents=True, exist_ok=True)
    names = ("scene", "recipe", "iterations", "PSNR", "worst view", "training views", "F 0.25 %", "Chamfer", "splats")
    print(f"| {' | '.join((*names, 'longest', 'seconds'))} |\n{'|---' * 11}|")
    kept = args.folder / "evidence.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []
    for name in args.captures:
        for recipe in args.recipes:
            wanted = {"capture": name, "recipe": recipe, "seed": args.seed, "scale": args.scale}
            found = next((row for row in rows if wanted.items() <= row.items()), None)
            if found is None:
                found = row_of(CASES[name], recipe, args)
                rows.append(found)
                write_json(kept, rows)
            if args.results:
                merge_row(args.results, found)
            print(line_of(found), flush=True)


if __name__ == "__main__":
    main()
