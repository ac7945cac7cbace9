"""Measure the effect of long and unseen splats of a run (docs/notebook/results.md, "Longer schedules").

::

    python -m benchmarks.sheets RUN [RUN ...] [--longer 0.1]

Prints for each run, under its rasterizer settings: the number of splats that no training view sees, the number of
splats longer than a fraction of the scene's extent, their coverage of the empty background of the test views (alpha of
the photographs < 1/2), and the PSNR of the test views (8 bit) with and without each group.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from gs2d.core.splats import Splats
from gs2d.evaluation.image_metrics import psnr_float, quantise
from gs2d.io.run_dir import open_run
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.prepare.loaded import LoadedRun, reload_run
from gs2d.render.api import rasterize
from gs2d.training.objective import visible_mask


@torch.no_grad()
def score(splats: Splats, job: LoadedRun) -> tuple[float, float, float]:
    """Return mean and minimum PSNR of the test views, dB, and the mean alpha of their empty background."""
    values, covered = [], []
    for view in job.scene.test:
        out = rasterize(splats, view.camera, job.settings, backend=job.backend)
        target = torch.from_numpy(view.target(job.settings.background).copy())
        values.append(psnr_float(quantise(out.color).float() / 255, quantise(target).float() / 255))
        alpha = view.alpha()
        if alpha is not None and (alpha < 0.5).any():
            covered.append(float(out.alpha[torch.from_numpy(alpha < 0.5)].mean()))
    return float(np.mean(values)), min(values), float(np.mean(covered)) if covered else float("nan")


def report(run: Path, longer: float) -> None:
    """Print the figures of one run."""
    job = reload_run(open_run(run), lambda event: None)
    splats = read_splats(run / "splats.ply")
    seen = visible_mask(splats, job.scene.train, job.settings, job.backend)
    sizes = splats.scales.max(dim=1).values
    long = sizes > longer * job.scene.extent
    print(
        f"{run}: {len(splats):,} splats, crossing ones: {job.settings.near_plane_policy}, "
        f"longest {float(sizes.max()):.4g} world units"
    )
    kept = {"all": seen | ~seen, f"without {int((~seen).sum())} unseen": seen}
    kept |= {f"without {int(long.sum())} long": ~long, "without both": seen & ~long}
    for name, rows in kept.items():
        mean, least, covered = score(splats.rows(rows), job)
        print(f"  {name}: {mean:.2f} dB, least {least:.1f} dB, empty background covered {100 * covered:.1f} %")


def main() -> None:
    """Parse the arguments and report each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--longer", type=float, default=0.1, help="fraction of the scene's extent")
    args = parser.parse_args()
    for run in args.runs:
        report(run, args.longer)


if __name__ == "__main__":
    main()
