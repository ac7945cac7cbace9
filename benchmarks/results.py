"""Make the tables of docs/notebook/results.md: every row is a `gs2d` command that is run and tabulated here.

::

    python -m benchmarks.results --data DIR --out runs/results [--only lego bottle] [--scale 0.1] [--why]

``DIR`` holds the captures under the names of ``CASES``. Finished runs are not repeated (their ``metrics.json`` is
read), so an interrupted command can be restarted. Stage 1 is shared through the stage cache.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Case:
    """Capture: its folder, its reduction for two cores, and its geometry reference."""

    name: str
    folder: str
    downscale: int = 1
    split: str = "test"
    ground_truth: str | None = None


CASES = (
    Case("bottle", "rendered_bottle", ground_truth="mesh_gt.ply"),
    Case("lego", "nerf_synthetic_lego"),
    Case("fox", "fox_instant_ngp", downscale=2),
    Case("dtu24", "dtu_scan24", downscale=4, split="train"),
    Case("fountain", "strecha_fountain_P11", downscale=4),
)


@dataclass(frozen=True)
class Method:
    """Table row: a recipe with overrides."""

    name: str
    title: str
    recipe: str
    changes: tuple[str, ...] = ()


METHODS = (
    Method("2dgs-no-nc", "2DGS without NC", "2dgs-no-nc"),
    Method("2dgs", "2DGS", "2dgs"),
    Method("2dgs-r", "2DGS-R", "2dgs-r"),
    Method("2dgs-60k", "2DGS, as long as 2DGS-R", "2dgs-60k"),
    Method("best", "`best`", "best"),
)
PRESERVE = ("refine.on_enter.clone_in_place.options.opacity=preserve",)
LONG_STAGE_3 = ("appearance.iterations=1", "refine.iterations=2999")
# Sources of the gain of stage 3. The numbers of iterations are for --scale 0.1.
WHY = (
    Method("60k-2000", "2DGS continued for as long as stage 3 alone", "2dgs-60k", ("continue.iterations=2000",)),
    Method("r-2999", "2DGS-R, all but 1 of stage 2 given to stage 3", "2dgs-r", LONG_STAGE_3),
    Method("r-free", "2DGS-R, opacity free in stage 3", "2dgs-r-freeze-none"),
    Method("r-preserve", "2DGS-R, clones share the opacity", "2dgs-r", PRESERVE),
    Method("r-k30", "2DGS-R, K = 30", "2dgs-r-k30"),
)


def train_command(case: Case, method: Method, data: str, out: Path, scale: float, seed: int) -> list[str]:
    """Return the command of one run, as printed in the table."""
    words = ["gs2d", "train", f"{data}/{case.folder}", "--out", str(out / f"{case.name}-{method.name}-s{seed}")]
    words += ["--recipe", method.recipe, "--schedule-scale", str(scale), "--robust", "off"]  # not part of the paper
    words += ["--set", f"cache={out / 'cache'}", "--seed", str(seed)]
    for change in method.changes:
        words += ["--set", change]
    if case.downscale > 1:
        words += ["--downscale", str(case.downscale)]
    return words


def execute(words: list[str]) -> None:
    """Run a gs2d command with this Python; if it fails, exit (the command has printed the reason)."""
    print("$", " ".join(words), flush=True)
    code = subprocess.run([sys.executable, "-m", "gs2d", *words[1:], "--quiet"]).returncode
    if code:
        sys.exit(code)


def run_case(case: Case, method: Method, data: str, out: Path, scale: float, seed: int) -> dict:
    """Train and score one run unless it is finished; return its metrics.json."""
    words = train_command(case, method, data, out, scale, seed)
    run = Path(words[words.index("--out") + 1])
    done = run / "metrics.json"
    if not (run / "mesh.ply").exists():
        execute([*words, "--resume"])
    if case.ground_truth and not json.loads(done.read_text()).get("surface"):
        execute(["gs2d", "evaluate", str(run), "--ground-truth", f"{data}/{case.folder}/{case.ground_truth}"])
    return dict(json.loads(done.read_text()))


def rows_of(case: Case, method: Method, metrics: dict) -> list[list[str]]:
    """Return table rows of one run: one per stage for 2DGS-R, the last stage for the others."""
    by_stage = method.name == "2dgs-r"
    stages = metrics["stages"] if by_stage else metrics["stages"][-1:]
    iterations, seconds = 0, 0.0
    rows = []
    for stage in metrics["stages"]:
        iterations += stage["iterations"]
        seconds += stage["seconds"]
        if stage not in stages:
            continue
        image = stage.get(case.split) or {}
        surface = (metrics.get("surface") or {}) if stage is metrics["stages"][-1] else {}
        title = method.title + (f", after {stage['name']}" if by_stage else "")
        rows.append(
            [
                case.name,
                title,
                str(iterations),
                number(image.get("psnr"), 2),
                number(image.get("ssim"), 4),
                number(f_score(surface), 4),
                number(surface.get("chamfer"), 5),
                f"{stage['splats']:,}",
                f"{stage['bytes'] / 1e6:.2f}",
                f"{seconds:.0f}",
            ]
        )
    return rows


def f_score(surface: dict) -> float | None:
    """Return the F-score at the smallest threshold, 0.25 % of the diagonal: at 0.5 % all methods score alike."""
    scores = surface.get("thresholds") or []
    return scores[0]["f_score"] if scores else None


def number(value: float | None, digits: int) -> str:
    """Format a number; a dash if it is missing."""
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> None:
    """Run missing experiments and print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/results"))
    parser.add_argument("--only", nargs="*", default=[case.name for case in CASES])
    parser.add_argument("--why", action="store_true", help="print the ablation of stage 3 instead of the main table")
    parser.add_argument("--scale", type=float, default=0.1)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    args = parser.parse_args()
    header = ["scene", "method", "iterations", "PSNR", "SSIM", "F 0.25 %", "Chamfer", "splats", "MB", "seconds"]
    table = [header, ["---"] * len(header)]
    file = args.out / ("why.md" if args.why else "table.md")
    args.out.mkdir(parents=True, exist_ok=True)
    for case in (c for c in CASES if c.name in args.only):
        for seed in args.seeds:
            for method in WHY if args.why else METHODS:
                table += rows_of(case, method, run_case(case, method, args.data, args.out, args.scale, seed))
                file.write_text("\n".join("| " + " | ".join(row) + " |" for row in table) + "\n")
    print(file.read_text())


if __name__ == "__main__":
    main()
