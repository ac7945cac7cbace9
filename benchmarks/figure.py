"""Draw the image strips of the README and docs/notebook/results.md (photograph, colour, normal, depth, mesh).

::

    python -m benchmarks.figure docs/images/bottle.png runs/bottle-2dgs-no-nc runs/bottle-2dgs-r [--view 1]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.mesh_images import mesh_images
from gs2d.core.atomic_files import atomic_write
from gs2d.core.camera import Camera
from gs2d.io.meshes import read_mesh

KINDS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP"}


def views_of(run: Path) -> int:
    """Return the number of views that a run rendered."""
    return len(json.loads((run / "renders" / "index.json").read_text())["views"])


def images_of(run: Path, view: int, stage: str | None, kinds: Sequence[str]) -> list[np.ndarray]:
    """Return photograph, renderings and mesh image of one view of a run, uint8 [H, W, 3] each."""
    shown = json.loads((run / "renders" / "index.json").read_text())["views"][view]
    stages = [entry["name"] for entry in json.loads((run / "metrics.json").read_text())["stages"]]
    folder = run / "renders" / (stage or stages[-1])
    files = [run / "renders" / "photos" / f"{shown['file']}.png"]
    files += [folder / f"{shown['file']}.{kind}.png" for kind in kinds]
    images = [np.asarray(Image.open(file).convert("RGB")) for file in files]
    saved = shown["camera"]
    camera = Camera(**{**saved, "T_cam_world": np.asarray(saved["T_cam_world"])})
    clay = mesh_images(read_mesh(run / "mesh.ply"), [camera], width=camera.width)[0].shape
    return [*images, (clay * 255).round().astype(np.uint8)]


def strip(run: Path, view: int, stage: str | None, size: int) -> list[np.ndarray]:
    """Return the images of one view of a run as a strip, uint8 [size, W, 3]."""
    images = images_of(run, view, stage, ("color", "normal", "depth"))
    shapes = [(round(size * image.shape[1] / image.shape[0]), size) for image in images]
    pairs = zip(images, shapes, strict=True)
    return [np.asarray(Image.fromarray(image).resize(shape, Image.Resampling.LANCZOS)) for image, shape in pairs]


def main() -> None:
    """Write the strips of several runs, stacked vertically."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--stage")
    parser.add_argument("--size", type=int, default=300)
    args = parser.parse_args()
    if args.out.suffix.lower() not in KINDS:
        parser.error(f"OUT must end in {', '.join(KINDS)}, got {args.out}")
    rows = [np.concatenate(strip(run, args.view, args.stage, args.size), axis=1) for run in args.runs]
    image = np.concatenate(rows, axis=0)
    used = np.flatnonzero((image != 255).any(axis=(1, 2)))  # crop white margins above and below
    with atomic_write(args.out) as file:
        Image.fromarray(image[used[0] : used[-1] + 1]).save(file, format=KINDS[args.out.suffix.lower()], quality=92)


if __name__ == "__main__":
    main()
