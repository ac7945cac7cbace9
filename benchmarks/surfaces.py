"""Judge surfaces: train recipes on rendered scenes with exact ground truth, or take any meshes, and score them.

::

    python -m benchmarks.surfaces [--scenes tuning | reported | NAME ...] [--recipes best 2dgs-60k FILE ...]
        [--scale 0.03] [--seeds 0] [--size 400] [--threads 1] [--set FIELD=VALUE ...] [--train="OPTIONS"]
        [--mesh NAME=FOLDER ...] [--captures FOLDER] [--out runs/surfaces] [--results FILE.json] [--pictures]

Scenes (``benchmarks/surface_scenes.py``) are rendered if missing, into OUT/scenes/SIZE-SEED or ``--captures``. Each
recipe is trained once per scene and seed by ``gs2d train`` in its own process; finished runs are reused. ``--recipes``
without names trains nothing. ``--mesh NAME=FOLDER`` scores FOLDER/SCENE.ply, in the frame of the capture, as recipe
NAME; FOLDER/SCENE.json or FOLDER/NAME.json may hold ``cpu_seconds``. ``--pictures`` draws clay renderings: a row per
recipe below the photographs and the truth. Other programs can use the COLMAP model and images of a scene.

Figures are defined in ``benchmarks/surface_judge.py``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.mesh_images import mesh_images
from benchmarks.street_runs import Process, watch_process
from benchmarks.surface_judge import PHOTOS, SCENE, TrueScene, read_scene, score_mesh
from benchmarks.surface_photographs import write_scene
from benchmarks.surface_scenes import REPORTED, SCENES, TUNING
from benchmarks.timing import machine
from gs2d.config.presets import get_recipe
from gs2d.config.schedule import MAX_SCALE
from gs2d.config.serialize import to_json
from gs2d.core.json_files import read_json, write_json
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError, Gs2dError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, METRICS

GROUPS = {"all": tuple(SCENES), "tuning": tuple(TUNING), "reported": tuple(REPORTED)}
SPEC, SCORE, CONSOLE, PROCESS, RUN = "spec.json", "score.json", "console.txt", "process.json", "run"
VIEWS, WIDTH = (0, 16, 32), 300  # test views in the clay pictures, and their width, px
COLUMNS = {
    "scene": lambda row: row["scene"],
    "recipe": lambda row: row["recipe"],
    "Chamfer %": lambda row: text(row, "chamfer", 3),
    "F 0.1": lambda row: text(row["f_area"], "0.1", 3),
    "F 0.25": lambda row: text(row["f_area"], "0.25", 3),
    "F 0.5": lambda row: text(row["f_area"], "0.5", 3),
    "scan F 0.25": lambda row: text(row["f_scan"], "0.25", 3),
    "normals, deg": lambda row: text(row, "normal_error", 1),
    "holes %": lambda row: text(row, "holes", 1),
    "excess %": lambda row: text(row, "excess", 1),
    "pieces": lambda row: f"{row['pieces']:,}",
    "faces": lambda row: f"{row['faces']:,}",
    "test PSNR": lambda row: text(row, "psnr", 2),
    "CPU s": lambda row: text(row, "cpu_seconds", 0),
}


def text(values: dict[str, Any], name: str, digits: int) -> str:
    """Format a figure; a dash if it is missing."""
    value = values.get(name)
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of rows, with the mean over scenes of each recipe that has several."""
    rows = [*rows, *means(rows)]
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join(column(row) for column in COLUMNS.values()) + " |" for row in rows]
    return "\n".join(lines)


def means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row of means over all scenes and seeds per recipe with more than one row."""

    def mean(values: list[Any]) -> Any:
        if isinstance(values[0], dict):
            return {name: mean([value[name] for value in values]) for name in values[0]}
        known = [value for value in values if value is not None]
        found = sum(known) / len(known) if known else None
        return round(found) if found is not None and all(isinstance(value, int) for value in known) else found

    found = []
    for recipe in dict.fromkeys(row["recipe"] for row in rows):
        own = [row for row in rows if row["recipe"] == recipe]
        if len(own) > 1:
            figures = [name for name in own[0] if name not in ("scene", "recipe", "seed", "run")]
            found.append(
                {
                    "scene": f"mean of {len(own)}",
                    "recipe": recipe,
                    **{name: mean([row.get(name) for row in own]) for name in figures},
                }
            )
    return found


# -- runs ----------------------------------------------------------------------------------------------------------
def train(recipe: str, capture: Path, seed: int, args: argparse.Namespace) -> Path:
    """Train a recipe on a capture unless finished, and return the folder of the run and its process.

    Raises
    ------
    DataError
        If the training failed; the message includes its last output.
    """
    spec = {
        **{"recipe": recipe, "values": to_json(get_recipe(recipe)), "scene": read_json(capture / SCENE)["name"]},
        **{"size": args.size, "scale": args.scale, "seed": seed, "threads": args.threads},
        **{"set": list(args.set), "train": args.train},
    }
    digest = hashlib.sha256(json.dumps([spec["values"], args.set, args.train], sort_keys=True).encode()).hexdigest()[:6]
    folder = args.out / "runs" / spec["scene"] / f"{Path(recipe).stem}-{args.scale:g}-{args.size}-s{seed}-{digest}"
    if not ((folder / SPEC).exists() and read_json(folder / SPEC) == spec and (folder / PROCESS).exists()):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        command = [
            sys.executable,
            "-m",
            "gs2d",
            "train",
            str(capture),
            "--out",
            str(folder / RUN),
            "--set",
            "page=false",
        ]
        command += ["--recipe", recipe, "--schedule-scale", f"{args.scale:g}", "--seed", str(seed)]
        command += ["--threads", str(args.threads)] + [word for change in args.set for word in ("--set", change)]
        process = watch_process([*command, *shlex.split(args.train)], folder / CONSOLE)
        if process.exit_code or not (folder / RUN / METRICS).exists():
            last = (folder / CONSOLE).read_text(errors="replace").strip().splitlines()[-1:]
            raise DataError(f"training {recipe} on {spec['scene']} ended with {process.exit_code}: {' '.join(last)}")
        write_json(folder / SPEC, spec)
        write_json(folder / PROCESS, _costs(process))
    return folder


def _costs(process: Process) -> dict[str, float]:
    return {"seconds": process.seconds, "cpu_seconds": process.cpu_seconds, "peak_rss_bytes": process.peak_rss_bytes}


def score_run(folder: Path, scene: TrueScene) -> dict[str, Any]:
    """Return scores, costs and test PSNR of a finished run; the score of the mesh is kept in ``score.json``."""
    mesh, kept = folder / RUN / MESH, folder / SCORE
    if not kept.exists() or kept.stat().st_mtime < mesh.stat().st_mtime:
        write_json(kept, score_mesh(read_mesh(mesh), scene).as_json())
    stage = read_json(folder / RUN / METRICS)["stages"][-1]
    return {**read_json(kept), "psnr": stage["test"]["psnr"], "splats": stage["splats"], **read_json(folder / PROCESS)}


def score_given(name: str, folder: Path, scene: TrueScene) -> dict[str, Any] | None:
    """Return the scores of a mesh of another program; None if there is none for the scene."""
    file = folder / f"{scene.facts.name}.ply"
    if not file.exists():
        return None
    costs = next((path for path in (file.with_suffix(".json"), folder / f"{name}.json") if path.exists()), None)
    known = {} if costs is None else read_json(costs)
    return {
        **score_mesh(read_mesh(file), scene).as_json(),
        "cpu_seconds": known.get("cpu_seconds", known.get("seconds")),
    }


# -- pictures ------------------------------------------------------------------------------------------------------
def picture(capture: Path, scene: TrueScene, meshes: Sequence[tuple[str, Mesh]]) -> Image.Image:
    """Draw the photographs, the truth and the meshes, a row each, from the same test views."""
    facts = scene.facts
    chosen = [k for k in VIEWS if k < len(facts.views)]
    photos = []
    for k in chosen:
        with Image.open(capture / PHOTOS / facts.views[k]) as photo:
            photos.append(np.asarray(photo.resize((WIDTH, round(WIDTH * photo.height / photo.width)))))
    rows = [("photographs", photos)]
    for name, mesh in (("truth", scene.truth), *meshes):
        cameras = [facts.cameras[k] for k in chosen]
        rows.append(
            (name, [np.rint(255 * image.shape).astype(np.uint8) for image in mesh_images(mesh, cameras, width=WIDTH)])
        )
    drawn = []
    for name, images in rows:
        row = Image.fromarray(np.concatenate(images, axis=1))
        ImageDraw.Draw(row).text((6, 4), name, fill=(200, 20, 20))
        drawn.append(np.asarray(row))
    return Image.fromarray(np.concatenate(drawn))


# -- command -------------------------------------------------------------------------------------------------------
def commit() -> str | None:
    """Return the commit of the source tree; None outside a repository."""
    try:
        command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse and check the command line before anything is rendered or trained."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.surfaces", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["all"], help=f"{', '.join(GROUPS)}, or {', '.join(SCENES)}")
    parser.add_argument("--recipes", nargs="*", default=["best"], help="names or files, as `gs2d train --recipe` takes")
    parser.add_argument("--scale", type=float, default=0.03, help="length of the schedule")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of trainings; scenes use --scene-seed")
    parser.add_argument("--scene-seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=400, help="width of the photographs, px")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE", help="overrides for every recipe")
    parser.add_argument("--train", default="", metavar="OPTIONS", help="more options for `gs2d train`, as one argument")
    parser.add_argument("--mesh", nargs="*", default=[], metavar="NAME=FOLDER", help="meshes of other programs")
    parser.add_argument("--captures", type=Path, metavar="FOLDER", help="rendered scenes (default: in --out)")
    parser.add_argument("--out", type=Path, default=Path("runs/surfaces"))
    parser.add_argument("--results", type=Path, metavar="FILE.json", help="also write the rows here")
    parser.add_argument("--pictures", action="store_true", help="draw clay renderings into OUT/pictures")
    args = parser.parse_args(arguments)
    unknown = [name for name in args.scenes if name not in GROUPS and name not in SCENES]
    if unknown:
        parser.error(f"--scenes must be of {', '.join((*GROUPS, *SCENES))}, got {unknown[0]}")
    args.scenes = list(dict.fromkeys(scene for name in args.scenes for scene in GROUPS.get(name, (name,))))
    if not (0 < args.scale <= MAX_SCALE and math.isfinite(args.scale)):
        parser.error(f"--scale must be a positive number up to {MAX_SCALE:g}, got {args.scale:g}")
    if not 64 <= args.size <= 1000:
        parser.error(f"--size must be between 64 and 1000 px, got {args.size}")
    given = [word.partition("=") for word in args.mesh]
    for name, equals, folder in given:
        if not (name and equals and Path(folder).is_dir()):
            parser.error(f"--mesh must be NAME=FOLDER with an existing folder, got {name}{equals}{folder}")
    args.mesh = [(name, Path(folder)) for name, _, folder in given]
    try:
        for recipe in args.recipes:
            get_recipe(recipe)
    except Gs2dError as error:
        parser.error(str(error))
    args.captures = args.captures or args.out / "scenes" / f"{args.size}-{args.scene_seed}"
    return args


def measure(name: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Render a scene if missing, train the recipes, score all meshes and return a row each."""
    capture = args.captures / name
    if not (capture / SCENE).exists():
        print(f"rendering {name}", file=sys.stderr, flush=True)
        write_scene(name, capture, seed=args.scene_seed, size=args.size)
    scene, rows, files = read_scene(capture), [], []
    for recipe in args.recipes:
        for seed in args.seeds:
            print(f"{name}: {recipe}, seed {seed}", file=sys.stderr, flush=True)
            folder = train(recipe, capture, seed, args)
            label = Path(recipe).stem
            rows.append({"scene": name, "recipe": label, "seed": seed, **score_run(folder, scene), "run": folder.name})
            files.append((label, folder / RUN / MESH))
    for label, folder in args.mesh:
        score = score_given(label, folder, scene)
        if score is not None:
            rows.append({"scene": name, "recipe": label, "seed": None, **score})
            files.append((label, folder / f"{name}.ply"))
    if args.pictures:
        (args.out / "pictures").mkdir(parents=True, exist_ok=True)
        meshes = [(label, read_mesh(file)) for label, file in files]
        picture(capture, scene, meshes).save(args.out / "pictures" / f"{name}.png")
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Run missing trainings, update the results after each scene and print the table. Return 2 for user errors."""
    args = parse(arguments)
    rows: list[dict[str, Any]] = []
    document = {
        **{"format": 1, "date": time.strftime("%Y-%m-%d"), "machine": machine(), "commit": commit()},
        **{"scale": args.scale, "size": args.size, "scene_seed": args.scene_seed, "threads": args.threads},
        **{"set": args.set, "train": args.train, "rows": rows},
    }
    results = args.out / "results.json" if args.results is None else args.results
    try:
        for name in args.scenes:
            rows += measure(name, args)
            results.parent.mkdir(parents=True, exist_ok=True)
            write_json(results, document)
    except Gs2dError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
