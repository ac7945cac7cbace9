"""Render an animated orbit around the subject of a run, with rendering and clay mesh side by side (README.md).

::

    python -m benchmarks.orbit RUN OUT.webp [--frames 72] [--size 560 480] [--fps 15] [--quality 70]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.mesh_images import mesh_images
from gs2d.contrib.pictures.orbits import orbit_cameras
from gs2d.contrib.pictures.pictures_command import RenderOptions
from gs2d.contrib.pictures.render_run import render_run
from gs2d.core.camera import Camera
from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, RunFolder
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.training.events import ignore


def cropped(image: Image.Image, width: int, height: int) -> Image.Image:
    """Return the centre of an image, ``width`` x ``height`` px; the image already has this height."""
    left = (image.width - width) // 2
    return image.crop((left, 0, left + width, height))


def orbit(run: Path, frames: int) -> list[Camera]:
    """Return the cameras of ``gs2d render RUN --orbit FRAMES``."""
    subject = read_subject(run)
    focus = None if subject is None or subject.kind != OBJECT else subject.center
    return orbit_cameras([view.camera for view in reload_run(RunFolder(run), ignore).scene.train], frames, focus)


def main(words: Sequence[str] | None = None) -> None:
    """Render the frames, draw the mesh from the same cameras, and write the animation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=72)
    parser.add_argument("--size", type=int, nargs=2, default=[560, 480], help="of one side, px")
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--quality", type=int, default=70)
    args = parser.parse_args(words)
    mesh, cameras = read_mesh(args.run / MESH), orbit(args.run, args.frames)
    across, height = args.size
    width = round(height * cameras[0].width / cameras[0].height)
    images = []
    with tempfile.TemporaryDirectory() as folder:
        render_run(args.run, RenderOptions(orbit=args.frames, width=width), out=Path(folder))
        for frame, camera in zip(sorted(Path(folder).glob("*.png")), cameras, strict=True):
            clay = (mesh_images(mesh, [camera], width=width)[0].shape * 255).round().astype(np.uint8)
            both = Image.new("RGB", (2 * across, height))
            both.paste(cropped(Image.open(frame).convert("RGB"), across, height), (0, 0))
            both.paste(cropped(Image.fromarray(clay), across, height), (across, 0))
            images.append(both)
    images[0].save(
        args.out,
        save_all=True,
        append_images=images[1:],
        duration=round(1000 / args.fps),
        loop=0,
        quality=args.quality,
        method=6,
    )


if __name__ == "__main__":
    main()
