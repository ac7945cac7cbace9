"""Measure the error of rendered depths against the true surface in all views, where a mesh would hide wall defects.

::

    python -m benchmarks.prior_depths RUN [RUN ...]

The capture of each run holds ``mesh_gt.ply``. The error at a pixel that shows the mesh is |z / truth - 1|, with z the
mean depth, clipped at 1. It is 1 where less than half of the pixel is covered.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from gs2d.core.mesh import Mesh
from gs2d.core.splats import Splats
from gs2d.data.scene import View
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import SPLATS, open_run
from gs2d.io.splat_ply import read_splats
from gs2d.meshing.raycast import cast_camera
from gs2d.pipeline.prepare.loaded import LoadedRun, reload_run
from gs2d.render.api import rasterize

WITHIN = (0.01, 0.03)


def errors(splats: Splats, views: Sequence[View], mesh: Mesh, job: LoadedRun) -> np.ndarray:
    """Return the errors [P] of all pixels of some views that show the mesh."""
    found = []
    for view in views:
        truth = torch.from_numpy(cast_camera(mesh.vertices, mesh.faces, view.camera).depth)
        with torch.no_grad():
            output = rasterize(splats, view.camera, job.settings, backend=job.backend)
        error = (output.depth_mean / truth.clamp(min=1e-6) - 1).abs().clamp(max=1)
        error[output.alpha < 0.5] = 1
        found.append(error[truth > 0].numpy())
    return np.concatenate(found)


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    print("| run | views | median | mean | " + " | ".join(f"within {100 * w:g} %" for w in WITHIN) + " |")
    print("|---" * (4 + len(WITHIN)) + "|")
    for run in parser.parse_args().runs:
        job = reload_run(open_run(run), lambda event: None)
        mesh, splats = read_mesh((job.scene.root or run) / "mesh_gt.ply"), read_splats(run / SPLATS)
        for split, views in (("test", job.scene.test), ("train", job.scene.train)):
            error = errors(splats, views, mesh, job)
            fractions = " | ".join(f"{100 * (error < w).mean():.1f} %" for w in WITHIN)
            print(f"| {run} | {split} | {100 * np.median(error):.2f} % | {100 * error.mean():.2f} % | {fractions} |")


if __name__ == "__main__":
    main()
