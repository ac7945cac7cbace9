"""Compare training in blocks with one training of the whole capture, at equal splat budget and equal iterations.

::

    python -m benchmarks.blocks FOLDER [--photographs 100] [--size 96] [--grid 2x2] [--iterations 4000] [--splats 40000]

A flown capture (``benchmarks.flown_capture``) is trained as a whole and by ``gs2d blocks``. The coarse model and all
blocks together have as many iterations as the single training; ``--block-iterations`` sets the iterations per block
instead. Both runs are scored on the test views (mean PSNR, and PSNR of the pixels that show land within ``--near`` of a
seam) and against the true surface (F-score at ``--within``, overall and near seams). Times are training time in
seconds. Images of the views with the longest seams are written to ``FOLDER/JOB-seam-*.png``: photograph, whole, blocks,
and the seam drawn on the photograph. The table is printed; figures are written to ``FOLDER/JOB-figures.json``. A second
table lists PSNR by distance from a seam, for the single training and for the blocks before and after the seams are
refined. JOB is ``blocks``, or ``blocks-N`` with ``--block-iterations N``, so that both can share a folder and one whole
training; ``--job`` sets another name, for instance for another ``--partition FIELD=VALUE``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.flight import Flight, write_flight
from gs2d.contrib.lab.blocks import blocks
from gs2d.contrib.lab.cells import Cells
from gs2d.contrib.lab.lab_options import BlocksOptions
from gs2d.contrib.lab.merged import MERGED
from gs2d.contrib.lab.partition import make_partition
from gs2d.contrib.lab.split import read_split
from gs2d.contrib.lab.surface_score import evaluate_surface
from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.data.scene import View
from gs2d.errors import Gs2dError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import SPLATS
from gs2d.io.splat_ply import read_splats
from gs2d.meshing.raycast import cast_camera
from gs2d.pipeline.prepare.loaded import Trained, open_finished
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Notice

ALL_OF = {"2dgs": 30_000, "best": 20_000}  # iterations of the recipes
ZOOM = 6  # number of seam images
FROM = (0, 1, 2, 4, 8, 16, 32, 64)  # m, distance from a seam


def job_folder(folder: Path, args: argparse.Namespace) -> Path:
    """Return the job folder; it depends on the number of iterations."""
    own = "blocks" if args.block_iterations is None else f"blocks-{args.block_iterations}"
    return folder / (args.job or own)


def train_both(folder: Path, args: argparse.Namespace) -> None:
    """Make the capture and train it whole and in blocks; skip finished parts."""
    capture = folder / "capture"
    if not (capture / "sparse/0/cameras.bin").exists():
        flight = Flight(args.photographs, args.size, args.size * 3 // 4, side=args.side, points=args.points)
        write_flight(capture, flight)
    changes = (f"min_views={args.min_views}", f"margin={args.margin}", f"extent={args.extent}")
    changes += (f"coarse.side={args.coarse_side}", f"coarse.schedule={args.coarse_schedule}")
    changes += (f"coarse.max_splats={args.coarse_splats}", *args.partition)
    partition = make_partition(args.grid, changes)
    parts = partition.blocks + args.coarse_schedule + partition.seam_schedule
    scale = args.iterations / ALL_OF[args.recipe]
    of_block = scale / parts if args.block_iterations is None else args.block_iterations / ALL_OF[args.recipe]
    common: dict[str, Any] = {
        "scene": capture,
        "recipe": args.recipe,
        "robust": args.robust,
        "overrides": (f"surface.densify.max_splats={args.splats}",),
        "backend": "cpu",
        "threads": args.threads,
        "page": False,
    }

    def tell(event: object) -> None:
        if isinstance(event, Notice):
            print(event.text, file=sys.stderr, flush=True)

    if not (folder / "whole/splats.ply").exists():
        whole = TrainOptions(out=folder / "whole", schedule_scale=scale, resume=True, **common)
        train(whole, tell)
    options = BlocksOptions(
        out=job_folder(folder, args),
        schedule_scale=of_block,
        blocks=args.grid,
        slots=args.slots,
        **(common | {"overrides": (*common["overrides"], *(f"partition.{change}" for change in changes))}),
    )
    blocks(options, tell)


def seam_distances(camera: Camera, truth: Mesh, cells: Cells) -> np.ndarray:
    """Return the distance of each pixel's surface point from a seam [H, W], world units; infinite for background."""
    hits = cast_camera(truth.vertices, truth.faces, camera)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    places = camera.center + (rays * hits.depth[..., None]) @ camera.rotation
    found = cells.distance_to_seam(places.reshape(-1, 3)).reshape(hits.depth.shape)
    return np.where(hits.face >= 0, found, np.inf)


def psnr(squares: list[np.ndarray]) -> float:
    """Return the PSNR over all pixels, dB."""
    return -10 * math.log10(float(np.concatenate(squares).mean()))


def shown(job: Trained, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return a rendering of a view [H, W, 3] in [0, 1], and its squared error per pixel [H, W]."""
    color = job.render(view.camera).color.clamp(0, 1).numpy()
    return color, ((color - view.target(job.settings.background)) ** 2).mean(axis=2)


def by_distance(folder: Path, args: argparse.Namespace) -> str:
    """Return PSNR by distance from a seam: the whole training, and blocks before and after the seams are refined."""
    job_of_blocks = job_folder(folder, args)
    cells, truth = read_split(job_of_blocks / "partition").cells, read_mesh(folder / "capture/mesh_gt.ply")
    _, job = open_finished(folder / "whole", args.threads, lambda _event: None)
    views = job.scene.test
    distances = np.concatenate([seam_distances(view.camera, truth, cells).ravel() for view in views])
    ranges = [(low, high) for low, high in itertools.pairwise(FROM) if ((distances >= low) & (distances < high)).any()]
    lines = ["| PSNR, dB | " + " | ".join(f"{low} to {high} m" for low, high in ranges) + " |"]
    lines.append("|---" * (len(ranges) + 1) + "|")
    before, after = (read_splats(job_of_blocks / name) for name in (MERGED, SPLATS))
    for name, splats in {"whole": job.splats, "before seams": before, "blocks": after}.items():
        every = np.concatenate([shown(replace(job, splats=splats), view)[1].ravel() for view in views])
        cells_of = [f"{psnr([every[(distances >= low) & (distances < high)]]):.2f}" for low, high in ranges]
        lines.append(f"| {name} | " + " | ".join(cells_of) + " |")
    return "\n".join(lines)


def measured(folder: Path, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Score both runs, overall and near seams, and draw the views with the longest seams."""
    job_of_blocks = job_folder(folder, args)
    cells, truth = read_split(job_of_blocks / "partition").cells, read_mesh(folder / "capture/mesh_gt.ply")
    folders = {"whole": folder / "whole", "blocks": job_of_blocks}
    runs = {name: open_finished(path, args.threads, lambda _event: None) for name, path in folders.items()}
    views = runs["whole"][1].scene.test
    distances = {view.name: seam_distances(view.camera, truth, cells) for view in views}
    drawn = sorted(views, key=lambda view: -float((distances[view.name] < args.near / 4).mean()))[:3]
    found: dict[str, dict[str, float]] = {}
    colors: dict[str, dict[str, np.ndarray]] = {view.name: {} for view in drawn}
    for name, (run, job) in runs.items():
        pixels, near = 0, []
        for view in views:
            color, square = shown(job, view)
            pixels += square.size
            near.append(square[distances[view.name] < args.near])
            if view.name in colors:
                colors[view.name][name] = color
        cameras = [view.camera for view in job.scene.train]
        score = evaluate_surface(read_mesh(run.file("mesh.ply")), truth, cameras=cameras, thresholds=(args.within,))
        assert score.clouds is not None
        at_seam = [cells.distance_to_seam(points) < args.near for points in (score.clouds.mesh, score.clouds.truth)]
        precision = float((score.clouds.mesh_distances[at_seam[0]] < args.within).mean())
        recall = float((score.clouds.truth_distances[at_seam[1]] < args.within).mean())
        (stage,) = run.metrics()["stages"]
        found[name] = {
            **{"splats": len(job.splats), "iterations": stage["iterations"], "seconds": stage["seconds"]},
            "psnr": stage["test"]["psnr"],
            "psnr_near_seams": psnr(near),
            "pixels_near_seams": np.concatenate(near).size / pixels,
            "f": score.scores[0].f_score,
            "f_near_seams": 2 * precision * recall / max(precision + recall, 1e-12),
        }
    for number, view in enumerate(drawn):
        draw(
            folder / f"{job_of_blocks.name}-seam-{number}.png", view, colors[view.name], distances[view.name], args.near
        )
    return found


def draw(path: Path, view: View, colors: dict[str, np.ndarray], distances: np.ndarray, near: float) -> None:
    """Write photograph, whole, blocks, and the photograph with pixels near a seam in red."""
    photograph = view.target((0.0, 0.0, 0.0))
    red = photograph.copy()
    red[distances < near / 8] = (1.0, 0.0, 0.0)
    panels = [photograph, colors["whole"], colors["blocks"], red]
    picture = (np.concatenate(panels, axis=1).clip(0, 1) * 255).round().astype(np.uint8)
    size = (picture.shape[1] * ZOOM, picture.shape[0] * ZOOM)
    Image.fromarray(picture).resize(size, Image.Resampling.NEAREST).save(path)


def table(found: dict[str, dict[str, float]]) -> str:
    """Return the figures as Markdown."""
    lines = ["| | splats | iterations | seconds | PSNR | near seams | F | near seams |", "|---" * 8 + "|"]
    for name, of in found.items():
        lines.append(
            f"| {name} | {of['splats']:,.0f} | {of['iterations']:,.0f} | {of['seconds']:.0f} | {of['psnr']:.2f} dB | "
            f"{of['psnr_near_seams']:.2f} dB | {of['f']:.4f} | {of['f_near_seams']:.4f} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; return 2 for user errors."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blocks", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, default=100)
    parser.add_argument("--size", type=int, default=96, help="longer image side, px")
    parser.add_argument("--side", type=float, help="approximate side of the land, m")
    parser.add_argument("--points", type=int, help="number of sparse points")
    parser.add_argument("--grid", default="2x2")
    parser.add_argument("--recipe", choices=ALL_OF, default="best")
    parser.add_argument("--robust", choices=("auto", "on", "off"), default="off")
    parser.add_argument("--iterations", type=int, default=4000, help="total iterations of each method")
    parser.add_argument("--block-iterations", type=int, help="iterations per block (default: --iterations in total)")
    parser.add_argument("--splats", type=int, default=40_000, help="total splat budget of each method")
    parser.add_argument("--coarse-splats", type=int, default=15_000)
    parser.add_argument("--coarse-side", type=int, default=48, help="px")
    parser.add_argument("--coarse-schedule", type=float, default=0.5)
    parser.add_argument(
        "--partition",
        nargs="*",
        default=[],
        metavar="FIELD=VALUE",
        help="partition settings that differ from the defaults",
    )
    parser.add_argument("--job", help="name of the job folder")
    parser.add_argument("--min-views", type=int, default=20)
    parser.add_argument("--margin", type=float, default=0.2)
    parser.add_argument("--extent", choices=("scene", "block"), default="scene")
    parser.add_argument("--near", type=float, default=8.0, help="distance from a seam that counts as near, m")
    parser.add_argument("--within", type=float, default=1.0, help="distance threshold of the F-score, m")
    parser.add_argument("--slots", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    try:
        args.folder.mkdir(parents=True, exist_ok=True)
        train_both(args.folder, args)
        found, courses = measured(args.folder, args), by_distance(args.folder, args)
    except (Gs2dError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(found), courses, sep="\n\n")
    (args.folder / f"{job_folder(args.folder, args).name}-figures.json").write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
