"""The table of docs/results.md: every row is one `gs2d` command, run here and tabulated.

::

    python -m benchmarks.results --data DIR --out runs/results [--only lego bottle] [--scale 0.1]

``DIR`` holds the captures under the names of ``CASES``. Runs that are finished are not repeated (their ``metrics.json``
is read), so the command can be stopped and started again. Stage 1 is shared through the stage cache.
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
    """One capture: where it is, how it is shrunk for two cores, and what its geometry is scored against."""

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
RECIPES = ("2dgs-no-nc", "2dgs", "2dgs-r", "2dgs-60k")
TITLES = {"2dgs-no-nc": "2DGS without NC", "2dgs": "2DGS", "2dgs-60k": "2DGS, as long as 2DGS-R", "2dgs-r": "2DGS-R"}


def train_command(case: Case, recipe: str, data: str, out: Path, scale: float, seed: int) -> list[str]:
    """The command of one run, as printed in the table."""
    words = ["gs2d", "train", f"{data}/{case.folder}", "--out", str(out / f"{case.name}-{recipe}-s{seed}")]
    words += ["--recipe", recipe, "--schedule-scale", str(scale), "--cache", str(out / "cache"), "--seed", str(seed)]
    if case.downscale > 1:
        words += ["--downscale", str(case.downscale)]
    return words


def execute(words: list[str]) -> None:
    """Run a gs2d command with the interpreter of this process."""
    print("$", " ".join(words), flush=True)
    subprocess.run([sys.executable, "-m", "gs2d", *words[1:], "--quiet"], check=True)


def run_case(case: Case, recipe: str, data: str, out: Path, scale: float, seed: int) -> dict:
    """Train and score one run unless it is done; return its metrics.json."""
    words = train_command(case, recipe, data, out, scale, seed)
    run = Path(words[words.index("--out") + 1])
    done = run / "metrics.json"
    if not (run / "mesh.ply").exists():
        execute([*words, "--resume"])
    if case.ground_truth and not json.loads(done.read_text()).get("surface"):
        execute(["gs2d", "evaluate", str(run), "--ground-truth", f"{data}/{case.folder}/{case.ground_truth}"])
    return dict(json.loads(done.read_text()))


def rows_of(case: Case, recipe: str, metrics: dict) -> list[list[str]]:
    """Table rows of one run: one a stage for 2DGS-R, the last stage for the others."""
    stages = metrics["stages"] if recipe == "2dgs-r" else metrics["stages"][-1:]
    iterations, seconds = 0, 0.0
    rows = []
    for stage in metrics["stages"]:
        iterations += stage["iterations"]
        seconds += stage["seconds"]
        if stage not in stages:
            continue
        image = stage.get(case.split) or {}
        surface = (metrics.get("surface") or {}) if stage is metrics["stages"][-1] else {}
        title = TITLES[recipe] + (f", after {stage['name']}" if recipe == "2dgs-r" else "")
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
    """F-score at the middle threshold of the surface metrics."""
    scores = surface.get("thresholds") or []
    return scores[len(scores) // 2]["f_score"] if scores else None


def number(value: float | None, digits: int) -> str:
    """A figure, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> None:
    """Run what is missing and print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/results"))
    parser.add_argument("--only", nargs="*", default=[case.name for case in CASES])
    parser.add_argument("--recipes", nargs="*", default=list(RECIPES))
    parser.add_argument("--scale", type=float, default=0.1)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    args = parser.parse_args()
    header = ["scene", "method", "iterations", "PSNR", "SSIM", "F-score", "Chamfer", "splats", "MB", "seconds"]
    table = [header, ["---"] * len(header)]
    for case in (c for c in CASES if c.name in args.only):
        for seed in args.seeds:
            for recipe in args.recipes:
                table += rows_of(case, recipe, run_case(case, recipe, args.data, args.out, args.scale, seed))
                (args.out / "table.md").write_text("\n".join("| " + " | ".join(row) + " |" for row in table) + "\n")
    print((args.out / "table.md").read_text())


if __name__ == "__main__":
    main()
