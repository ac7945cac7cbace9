"""Measure time to quality: test PSNR, and F-score at 0.25 % if the true surface is known, against training time.

::

    python -m benchmarks.time_to_quality demo [CAPTURE[:DOWNSCALE] ...] [--recipes 2dgs 2dgs-60k 2dgs-r]
        [--scales 0.02 0.05 0.1] [--seeds 0] [--opensplat BINARY] [--opensplat-scales 0.005 0.01] [--threads 2]
        [--out runs/time_to_quality] [--results FILE.json] [--figure FILE.svg] [--ground-truth MESH]

``demo`` is the synthetic capture of ``gs2d demo``, made if missing. Recipes are names listed by ``gs2d recipes``, or
files. Each recipe is trained once per schedule and seed, in a separate process, sequentially, shortest schedules first.
The clock runs from process start to the end of training and includes imports, reading the capture and the
initialisation. Scoring, saving states and meshing are not counted (meshing seconds are in the results). With
``--opensplat``, OpenSplat (``benchmarks/street_peer.py``) trains for as many iterations of its own schedule on the same
photographs. They are composited over our background, because OpenSplat does not support alpha. Captures without points
start from equally many random points. OpenSplat's clock is that of its process, including reading. Both variants are
trained, and the better one per schedule is plotted. Its iterations can take ten times as long as ours:
``--opensplat-scales`` sets separate schedules.

The command can be interrupted and restarted: finished trainings are not repeated, and an interrupted one resumes from
its last point. Changing a recipe, the seed or the threads restarts its trainings. Wall time depends on other load on
the machine; CPU time depends less on it and is plotted by default (``--time``).
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality_plot import TIMES, write_figure
from benchmarks.quality_run import RESULT, SPEC, train_options
from benchmarks.street_peer import (
    ALL,
    OWN_ITERATIONS,
    SPLATS,
    TRAIN,
    VARIANTS,
    canvas,
    draw_test_views,
    run_peer,
    score_images,
    seen_window,
    train_command,
    vertices_of,
    whole_steps,
    write_capture,
)
from benchmarks.street_runs import watch_process
from benchmarks.timing import machine
from gs2d.config.presets import get_recipe
from gs2d.config.schedule import MAX_SCALE, scale_schedule
from gs2d.config.serialize import to_json
from gs2d.contrib.demo.demo_capture import write_demo_capture
from gs2d.core.json_files import write_json
from gs2d.data import Scene
from gs2d.data.scene import PointCloud
from gs2d.errors import DataError, Gs2dError
from gs2d.evaluation.evaluators import choose_truth
from gs2d.pipeline.prepare.loaded import LoadedRun, prepare_run
from gs2d.training.events import ignore

DEMO, PEER = "demo", "opensplat"
CONSOLE, RECIPES, SCALES = "console.txt", ("2dgs", "2dgs-60k", "2dgs-r"), (0.02, 0.05, 0.1)


# -- gs2d ----------------------------------------------------------------------------------------------------------
def specification(capture: Path, downscale: int, recipe: str, scale: float, seed: int, args: Any) -> dict[str, Any]:
    """Return all settings that determine a training and its curve."""
    return {
        "capture": str(capture),
        "downscale": downscale,
        "recipe": recipe,
        "values": to_json(get_recipe(recipe)),
        "scale": scale,
        "seed": seed,
        "set": list(args.set),
        "threads": args.threads,
        "backend": args.backend,
        "points": args.points,
        "ground_truth": None if args.ground_truth is None else str(args.ground_truth),
    }


def run_recipe(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Train a specification unless finished, and return its row.

    Raises
    ------
    DataError
        If the training failed; the message includes its last output.
    """
    file, result = folder / SPEC, folder / RESULT
    if not (file.exists() and json.loads(file.read_text()) == spec):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_json(file, spec)
    if not result.exists():
        command = [sys.executable, "-m", "benchmarks.quality_run", str(file), str(time.time())]
        process = watch_process(command, folder / CONSOLE)
        if process.exit_code:
            said = (folder / CONSOLE).read_text(errors="replace").strip().splitlines()[-1:]
            raise DataError(f"training {spec['recipe']} ended with exit code {process.exit_code}: {' '.join(said)}")
    return {"scale": spec["scale"], "seed": spec["seed"], **json.loads(result.read_text())}


# -- OpenSplat -----------------------------------------------------------------------------------------------------
def with_start(scene: Scene, count: int, seed: int) -> Scene:
    """Return the scene with points: its own, or as many random grey points in its bounds as 2DGS would use."""
    if scene.points is not None and len(scene.points):
        return scene
    low, high = scene.bounds
    points = low + np.random.default_rng(seed).random((count, 3)) * (high - low)
    return replace(scene, points=PointCloud(points, np.full((count, 3), 128, dtype=np.uint8)))


def run_opensplat(binary: Path, job: LoadedRun, scale: float, threads: int | None, folder: Path) -> dict[str, Any]:
    """Train OpenSplat for a schedule, each variant unless finished, and return the row of the better one.

    Raises
    ------
    DataError
        If OpenSplat failed.
    """
    iterations = whole_steps(scale * OWN_ITERATIONS)
    scene = with_start(job.scene, job.recipe.init_points, job.recipe.seed)
    around, background = [canvas(view.camera) for view in scene.views], job.settings.background
    facts = {"iterations": iterations, "digest": job.resolved.scene.digest, "threads": threads, "binary": str(binary)}
    if not (folder / SPEC).exists() or json.loads((folder / SPEC).read_text()) != facts:
        shutil.rmtree(folder, ignore_errors=True)
        seen = [seen_window(view.camera, view.mask()) for view in scene.train]
        write_capture(folder / TRAIN, scene, scene.train, seen, background)
        write_capture(folder / ALL, scene, scene.views, around, background)
        write_json(folder / SPEC, facts)
    rows = {}
    for variant in VARIANTS:
        place = folder / variant
        took = _trained(binary, folder / TRAIN, place, iterations, variant, threads)
        files = draw_test_views(binary, folder / ALL, place, scene, around, iterations)
        images = dict(score_images(job, files)["test"] or {})
        images.pop("psnr_by_view", None)
        rows[variant] = {**took, "images": images, "splats": vertices_of(place / SPLATS)}
    best = max(rows, key=lambda name: rows[name]["images"].get("psnr", 0.0))
    return {"scale": scale, "seed": job.recipe.seed, "variant": best, **rows[best], "variants": rows}


def _trained(
    binary: Path, capture: Path, folder: Path, iterations: int, variant: str, threads: int | None
) -> dict[str, Any]:
    file = folder / RESULT
    if not file.exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        command = train_command(binary, capture, folder / SPLATS, iterations, variant)
        process = run_peer(command, folder, "train", {} if threads is None else {"OMP_NUM_THREADS": str(threads)})
        facts = {"iterations": iterations, "seconds": process.seconds, "user_seconds": process.user_seconds}
        write_json(file, {**facts, "system_seconds": round(process.cpu_seconds - process.user_seconds, 2)})
    return dict(json.loads(file.read_text()))


# -- command -------------------------------------------------------------------------------------------------------
def place_of(text: str, out: Path) -> tuple[str, Path, int]:
    """Return name, folder and downscale of ``CAPTURE[:DOWNSCALE]``.

    Raises
    ------
    DataError
        If the folder does not exist or the downscale is below 1.
    """
    path, colon, factor = text.rpartition(":")
    path, factor = (path, factor) if colon and factor.isdigit() else (text, "1")
    if path == DEMO:
        return DEMO, out / DEMO / "capture", int(factor)
    folder = Path(path).resolve()
    if not folder.is_dir():
        raise DataError(f"a capture must be a folder or 'demo', got {path}")
    if int(factor) < 1:
        raise DataError(f"{text}: the downscale must be a whole number >= 1")
    return folder.name, folder, int(factor)


def measure(text: str, args: argparse.Namespace, keep: Any) -> None:
    """Train everything on a capture; ``keep`` gets its results entry after every update."""
    name, capture, downscale = place_of(text, args.out)
    if name == DEMO and not (capture / "transforms_train.json").exists():
        print("photographing the demo scene", flush=True)
        write_demo_capture(capture, seed=0)
    base = args.out / (name if downscale == 1 else f"{name}-{downscale}")
    first = specification(capture, downscale, args.recipes[0], 1.0, args.seeds[0], args)
    job = prepare_run(train_options(first, base), ignore)
    truth = args.ground_truth is not None or choose_truth(None, capture, lambda text: None) is not None
    curves = {recipe: {"name": Path(recipe).name, "runs": []} for recipe in args.recipes}
    if args.opensplat is not None and job.scene.test:
        curves[PEER] = {"name": "OpenSplat", "runs": []}
    entry = {"name": name, "downscale": downscale, "train_views": len(job.scene.train), "truth": truth}
    entry |= {"test_views": len(job.scene.test), "curves": list(curves.values())}
    for scale in sorted(args.scales):
        for seed in args.seeds:
            for recipe in args.recipes:
                spec = specification(capture, downscale, recipe, scale, seed, args)
                row = run_recipe(spec, base / f"{Path(recipe).name.replace(':', '-')}-{scale:g}-s{seed}")
                told(name, curves[recipe], row)
                keep(entry)
    for scale in sorted(args.opensplat_scales or args.scales) if PEER in curves else ():
        recipe = scale_schedule(job.recipe, scale)
        scaled = replace(job, resolved=replace(job.resolved, recipe=recipe))
        row = run_opensplat(args.opensplat, scaled, scale, args.threads, base / f"{PEER}-{scale:g}")
        told(name, curves[PEER], row)
        keep(entry)


def told(capture: str, curve: dict[str, Any], row: dict[str, Any]) -> None:
    """Keep a row and print it."""
    curve["runs"].append(row)
    print(table([{"name": capture, "curves": [{**curve, "runs": [row]}]}]).splitlines()[-1], flush=True)


def table(captures: Sequence[dict[str, Any]]) -> str:
    """Return the ends of all schedules as Markdown; the longest splat is a fraction of the scene's extent."""
    head = (
        "| capture | recipe | schedule | user CPU s | s | PSNR | worst view | F 0.25 % | Chamfer | splats | longest |"
    )
    lines = [head, "|---" * 11 + "|"]
    for capture in captures:
        for curve in capture["curves"]:
            for row in curve["runs"]:
                images, surface = row["images"], row.get("surface") or {}
                cells = [capture["name"], curve["name"], f"{row['scale']:g}", f"{row['user_seconds']:.1f}"]
                cells += [f"{row['seconds']:.1f}", text(images.get("psnr"), 2), text(images.get("worst_psnr"), 2)]
                cells += [text(surface.get("f_scores", {}).get("0.0025"), 4), text(surface.get("chamfer"), 5)]
                cells += [f"{row['splats']:,}", text(row.get("longest_splat"), 2)]
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def text(value: float | None, digits: int) -> str:
    """Format a figure; a dash if it is missing."""
    return "-" if value is None else f"{value:.{digits}f}"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse and check the command line before any training starts."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.time_to_quality",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[:DOWNSCALE]")
    parser.add_argument("--recipes", nargs="+", default=list(RECIPES))
    parser.add_argument("--scales", nargs="+", type=float, default=list(SCALES), help="lengths of the schedule")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE", help="overrides for every recipe")
    parser.add_argument("--opensplat", type=Path, metavar="BINARY", help="OpenSplat binary (default: no comparison)")
    parser.add_argument("--opensplat-scales", nargs="+", type=float, metavar="SCALE", help="default: --scales")
    parser.add_argument("--ground-truth", type=Path, metavar="MESH", help="default: the file next to a capture")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--backend", default="auto")
    parser.add_argument(
        "--points", type=int, default=8, help="number of points of a training's curve, including its end"
    )
    parser.add_argument("--time", choices=list(TIMES), default="user_seconds", help="time axis of the figure")
    parser.add_argument("--out", type=Path, default=Path("runs/time_to_quality"))
    parser.add_argument("--results", type=Path, metavar="FILE.json", help="also write the results here")
    parser.add_argument("--figure", type=Path, metavar="FILE.svg", help="also plot here (.svg or .png)")
    args = parser.parse_args(arguments)
    try:
        for recipe in args.recipes:
            get_recipe(recipe)
        for text_ in args.captures:
            place_of(text_, args.out)
    except Gs2dError as error:
        parser.error(str(error))
    for scale in (*args.scales, *(args.opensplat_scales or ())):
        if not (0 < scale <= MAX_SCALE and math.isfinite(scale)):
            parser.error(f"--scales must be positive numbers up to {MAX_SCALE:g}, got {scale:g}")
    if args.points < 1:
        parser.error(f"--points must be at least 1, got {args.points}")
    if args.opensplat is not None and not args.opensplat.is_file():
        parser.error(f"--opensplat must be a binary, got {args.opensplat}")
    if args.figure is not None and args.figure.suffix not in (".svg", ".png"):
        parser.error(f"--figure must end in .svg or .png, got {args.figure.name}")
    args.opensplat = None if args.opensplat is None else args.opensplat.resolve()
    return args


def main(arguments: Sequence[str] | None = None) -> int:
    """Run missing trainings; update results and figure after each training. Return 2 for user errors."""
    args = parse(arguments)
    captures: dict[str, Any] = {}
    document = {"format": 1, "date": time.strftime("%Y-%m-%d"), "machine": machine(), "threads": args.threads}
    files = [args.out / "results.json", *([] if args.results is None else [args.results])]
    figures = [args.out / "time_to_quality.svg", *([] if args.figure is None else [args.figure])]

    def keep(text_: str, entry: dict[str, Any]) -> None:
        captures[text_] = entry
        document["captures"] = list(captures.values())
        for file in files:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, document)

    try:
        for text_ in args.captures:
            measure(text_, args, lambda entry, text_=text_: keep(text_, entry))
    except Gs2dError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for file in figures:
        write_figure(file, document, args.time)
    print(table(document["captures"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
