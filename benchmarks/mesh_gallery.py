"""Draw clay renderings of the meshes of several runs next to the true surface (docs/notebook/best.md).

::

    python -m benchmarks.mesh_gallery OUT.png TRUTH.ply RUN [RUN ...] [--views 0 4] [--size 300]

Draws a row per view (indices of test views) and a column per run, labelled with its recipe.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.mesh_images import mesh_images
from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, RunFolder
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.training.events import ignore

SHADES = 64  # clay quantised to these levels: a third of the bytes without a visible difference


def column(name: str, mesh: Mesh, cameras: list[Camera], size: int) -> np.ndarray:
    """Draw a mesh from each camera, stacked below its label: uint8 [H, size, 3]."""
    clay = [(image.shape * 255).round().astype(np.uint8) for image in mesh_images(mesh, cameras, width=size)]
    image = Image.fromarray(np.concatenate(clay, axis=0))
    ImageDraw.Draw(image).text((8, 8), name, fill=(20, 20, 20))
    return np.asarray(image)


def main() -> None:
    """Draw the columns side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--views", type=int, nargs="+", default=[0, 4])
    parser.add_argument("--size", type=int, default=300)
    args = parser.parse_args()
    jobs = [reload_run(RunFolder(run), ignore) for run in args.runs]
    cameras = [jobs[0].scene.test[view].camera for view in args.views]
    named = [(job.recipe.name, read_mesh(run / MESH)) for job, run in zip(jobs, args.runs, strict=True)]
    named.append(("truth", read_mesh(args.truth)))
    image = Image.fromarray(np.concatenate([column(*one, cameras, args.size) for one in named], axis=1))
    image.quantize(SHADES).save(args.out, optimize=True)


if __name__ == "__main__":
    main()
