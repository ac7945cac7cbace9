"""Measure the distance of a capture's sparse points from a run's mesh, a surface check without ground truth.

::

    python -m benchmarks.points RUN [RUN ...]

Structure from motion triangulated these points with an error of about its reprojection error, and training starts from
them. Distances are in pixel widths of the training images at the point, in the nearest view that sees the point. Points
outside the mesh's bounding box are ignored.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gs2d.contrib.lab.surface_score import distances_to_mesh
from gs2d.data.scene import Scene
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, open_run
from gs2d.pipeline.prepare.loaded import reload_run

WITHIN = (0.5, 1.0, 2.0, 5.0)  # px


@dataclass(frozen=True)
class Row:
    """Distances of one run, px."""

    points: int
    median: float
    mean: float  # mean of distances clipped at 10
    within: dict[float, float]  # shares


def pixel_widths(points: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the pixel width at each point [P], world units, in the nearest training view that sees it; infinity if
    none.
    """
    widths = np.full(len(points), np.inf)
    for view in scene.train:
        pixels, depth = view.camera.project(points)
        seen = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= (view.camera.width, view.camera.height)).all(axis=1)
        widths[seen] = np.minimum(widths[seen], depth[seen] / view.camera.fx)
    return widths


def measure(run: Path) -> Row:
    """Return the distances of the capture's points from the run's mesh."""
    job = reload_run(open_run(run), lambda event: None)
    if job.scene.points is None:
        raise SystemExit(f"{run}: its capture has no points")
    mesh = read_mesh(run / MESH)
    points = np.asarray(job.scene.points.points, dtype=np.float64)
    widths = pixel_widths(points, job.scene)
    inside = (points >= mesh.vertices.min(axis=0)).all(axis=1) & (points <= mesh.vertices.max(axis=0)).all(axis=1)
    kept = inside & np.isfinite(widths)
    px = distances_to_mesh(points[kept], mesh) / widths[kept]
    within = {limit: float((px < limit).mean()) for limit in WITHIN}
    return Row(int(kept.sum()), float(np.median(px)), float(np.minimum(px, 10).mean()), within)


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    print("| run | points | median, px | mean (at most 10), px | " + " | ".join(f"< {w:g} px" for w in WITHIN) + " |")
    print("|---" * (4 + len(WITHIN)) + "|")
    for run in parser.parse_args().runs:
        row = measure(run)
        fractions = " | ".join(f"{100 * fraction:.1f} %" for fraction in row.within.values())
        print(f"| {run} | {row.points:,} | {row.median:.3f} | {row.mean:.3f} | {fractions} |", flush=True)


if __name__ == "__main__":
    main()
