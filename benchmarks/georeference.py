"""Measure the accuracy of a run's scale and position from noisy GPS positions and control points.

::

    python -m benchmarks.georeference FOLDER [--photographs 60] [--size 400] [--seeds 10] [--results FILE.json]

A flown capture (``benchmarks/flown_capture.py``) is rendered; ``gs2d poses`` estimates cameras from its photographs
alone, and ``gs2d train`` makes a short run. For each seed, `gs2d survey` then gets

- noisy photograph positions, some with outliers of 50 m: a corrected receiver (0.02 m), a drone (0.5 m) and a
  phone (2 m and 5 m), along each axis;
- control points: points of the true surface, marked in the photographs with a noise of half a pixel and measured to
  0.01 m; every third is held out as a check point.

The table lists the scale error (relative to a fit of all cameras to the ground truth) and the command's estimate of
that error, the distance of the cameras from their true positions, and the check point residuals beside the true errors.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.flight import Flight, write_flight
from gs2d.contrib.survey.find_georeference import georeference_run
from gs2d.contrib.survey.fit import fit_places
from gs2d.contrib.survey.georeference import CHECK, LEFT_OUT, Georeference
from gs2d.contrib.survey.survey_commands import GeoreferenceOptions
from gs2d.core.camera import Camera
from gs2d.data import View, load_scene
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import open_run
from gs2d.pipeline.prepare.loaded import reload_run

NOISES = (0.0, 0.02, 0.5, 2.0, 5.0)  # m, along each axis
OUTLIERS, FAR = 0.05, 50.0  # share of outlier positions, and their error, m
CONTROL, MARK_NOISE, SURVEY_NOISE = 9, 0.5, 0.01  # points; px; m
SEEN_BY = 4  # minimum photographs per control point
EPSG, WORLD = 32632, np.array([500_000.0, 5_200_000.0, 0.0])  # origin of the flight, m
EDGE = 5.0  # px, image border without marks


@dataclass(frozen=True, eq=False)
class Truth:
    """True cameras by name, and the true surface points [P, 3], m."""

    cameras: dict[str, Camera]
    surface: np.ndarray


def prepared(folder: Path, photographs: int, size: int) -> tuple[Path, Truth]:
    """Return the run, which is made if missing, and the ground truth."""
    flown, capture, run = folder / "flown", folder / "capture", folder / "run"
    if not (flown / "sparse" / "0" / "images.bin").exists():
        write_flight(flown, Flight(photographs, width=size, height=size * 3 // 4, gps_noise=0.0))
    if not run.exists():
        program = [sys.executable, "-m", "gs2d"]
        if not capture.exists():
            subprocess.run([*program, "poses", flown / "images", "--out", capture], check=True)
        short = ["--schedule-scale", "0.0005"]
        subprocess.run([*program, "train", capture, "--out", run, "--recipe", "2dgs", *short], check=True)
    true = load_scene(flown)
    points = true.points
    assert points is not None
    views = (*true.train, *true.test)
    return run, Truth({view.name: view.camera for view in views}, points.points)


def views_of(run: Path) -> list[View]:
    """Return all views of the run."""
    scene = reload_run(open_run(run), lambda _: None).scene
    return [*scene.train, *scene.test]


def write_positions(path: Path, places: dict[str, np.ndarray], noise: float, rng: np.random.Generator) -> int:
    """Write noisy photograph positions and return the number of outliers."""
    names = list(places)
    wrong = set(rng.permutation(len(names))[: round(OUTLIERS * len(names))].tolist()) if noise else set()
    lines = [f"# EPSG:{EPSG}", "name,x,y,z"]
    for k, name in enumerate(names):
        place = places[name] + WORLD + rng.normal(size=3) * noise
        if k in wrong:
            way = rng.normal(size=3)
            place = place + FAR * way / np.linalg.norm(way)
        lines.append(f"{name}," + ",".join(f"{value:.4f}" for value in place))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return len(wrong)


def write_control(path: Path, truth: Truth, names: list[str], rng: np.random.Generator) -> int:
    """Write control points with their marks, every third a check point; return their number."""
    lines, count = [f"# EPSG:{EPSG}", "name,x,y,z,photo,u,v,check"], 0
    for place in truth.surface[rng.permutation(len(truth.surface))]:
        marks = {name: pixel for name in names if (pixel := seen_at(truth.cameras[name], place)) is not None}
        if len(marks) < SEEN_BY or count == CONTROL:
            continue
        measured = ",".join(f"{value:.4f}" for value in place + WORLD + rng.normal(size=3) * SURVEY_NOISE)
        count += 1
        for name, pixel in list(marks.items())[: 2 * SEEN_BY]:
            u, v = pixel + rng.normal(size=2) * MARK_NOISE
            lines.append(f"g{count},{measured},{name},{u:.2f},{v:.2f},{'yes' if count % 3 == 0 else 'no'}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return count


def seen_at(camera: Camera, place: np.ndarray) -> np.ndarray | None:
    """Return the pixel [2] at which a camera sees a point, or None if it is out of frame; occlusion is ignored."""
    x, y, z = camera.rotation @ place + camera.T_cam_world[:3, 3]
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = z > 0 and EDGE < u < camera.width - EDGE and EDGE < v < camera.height - EDGE
    return np.array([u, v]) if inside else None


def judged(found: Georeference, centers: np.ndarray, true: np.ndarray, scale: float) -> dict[str, Any]:
    """Return the true errors and the reported errors of a georeference; cameras are [V, 3], of the run and true."""
    off = np.linalg.norm(found.to_world(centers) - WORLD - true, axis=1)
    told = found.details.get("scale_error")
    return {
        "scale_error": abs(found.scale / scale - 1),
        "told": None if told is None else float(told),
        "cameras_off": float(np.sqrt(np.mean(off**2))),
        "left_out": found.count(LEFT_OUT),
        "rms": found.rms(),
        "check_rms": found.rms(CHECK),
        "doubts": len(found.doubts),
    }


def measured(folder: Path, photographs: int, size: int, seeds: int) -> list[dict[str, Any]]:
    """Return a row per source: the mean and the worst value over the seeds."""
    run, truth = prepared(folder, photographs, size)
    views = views_of(run)
    names = [view.name for view in views]
    centers = np.array([view.camera.center for view in views])
    true = np.array([truth.cameras[name].center for name in names])
    best = fit_places(centers, true, None, robust=False)
    rows = [{"source": "all cameras fitted to the truth", "placed": len(names), "of": len(truth.cameras),
             "cameras_off": float(np.sqrt(np.mean(np.square(best.residuals).sum(axis=1))))}]  # fmt: skip
    places = dict(zip(names, true, strict=True))
    for noise in NOISES:
        tries = []
        for seed in range(seeds if noise else 1):
            wrong = write_positions(folder / "positions.csv", places, noise, np.random.default_rng(seed))
            found = georeference_run(run, GeoreferenceOptions(positions=folder / "positions.csv"))
            assert found is not None
            tries.append({**judged(found, centers, true, best.scale), "outliers": wrong})
        rows.append({"source": f"positions, {noise:g} m", **over_seeds(tries)})
    tries = []
    for seed in range(seeds):
        count = write_control(folder / "control.csv", truth, names, np.random.default_rng(seed))
        found = georeference_run(run, GeoreferenceOptions(control=folder / "control.csv"))
        assert found is not None
        tries.append(judged(found, centers, true, best.scale))
    rows.append({"source": f"{count} control points, {count // 3} of them held out", **over_seeds(tries)})
    return rows


def over_seeds(tries: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means and the worst scale error."""
    names = [name for name in tries[0] if tries[0][name] is not None]
    means = {name: float(np.mean([entry[name] for entry in tries])) for name in names}
    return {**means, "worst_scale_error": max(entry["scale_error"] for entry in tries), "seeds": len(tries)}


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as Markdown."""
    heads = ("scale off, mean", "worst", "told", "cameras off", "left out of outliers", "rms", "check points")
    lines = ["| source | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for row in rows:

        def cell(name: str, form: str, row: dict[str, Any] = row) -> str:
            return form.format(row[name]) if row.get(name) is not None else ""

        left = f"{row['left_out']:.1f} of {row['outliers']:.0f}" if "outliers" in row else ""
        scale = (cell("scale_error", "{:.3%}"), cell("worst_scale_error", "{:.3%}"), cell("told", "{:.3%}"))
        residuals = (cell("rms", "{:.3f} m"), cell("check_rms", "{:.3f} m"))
        cells = (*scale, cell("cameras_off", "{:.3f} m"), left, *residuals)
        lines.append(f"| {row['source']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark and print the table; return 2 for user errors."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.georeference", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, default=60)
    parser.add_argument("--size", type=int, default=400, help="width of the photographs, px")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--results", type=Path)
    args = parser.parse_args(arguments)
    try:
        rows = measured(args.folder, args.photographs, args.size, args.seeds)
    except (Gs2dError, OSError, subprocess.CalledProcessError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(rows))
    if args.results is not None:
        args.results.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
