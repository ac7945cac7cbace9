"""Render a video for the tutorials: the demo's still life, as filmed with a handheld phone in two rounds.

    python -m benchmarks.tutorial_video still_life.mp4          # needs ffmpeg

The camera moves around the table twice, higher the second time, with small hand motions. No real photographs are
needed, and the ground truth is known (`gs2d.contrib.demo`).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gs2d.contrib.demo.demo_capture import CAMERA_ANGLE_X, render_image
from gs2d.contrib.demo.demo_scene import build_scene
from gs2d.contrib.demo.shading import bake
from gs2d.core.camera import Camera, look_at
from gs2d.data.image_files import write_image

ROUNDS, ELEVATIONS = 2, (16.0, 46.0)  # degrees
WALL = np.array([196, 203, 208], dtype=np.float64)  # background behind the table, sRGB
FRAMES_PER_SECOND = 12


def cameras(count: int, size: int, seed: int = 0) -> list[Camera]:
    """Return the cameras of the frames in order."""
    rng = np.random.default_rng(seed)
    sway = np.cumsum(rng.normal(0, 0.006, (count, 3)), axis=0)
    sway -= np.linspace(0, 1, count)[:, None] * sway[-1]  # hand motion, periodic over the video
    views = []
    for k in range(count):
        along = k / count
        azimuth, elevation = 2 * np.pi * ROUNDS * along, np.radians(ELEVATIONS[0] + along * np.ptp(ELEVATIONS))
        level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
        eye = 3.9 * np.array([*level, np.sin(elevation)]) + sway[k]
        fx = size / 2 / np.tan(CAMERA_ANGLE_X / 2)
        views.append(look_at(eye, 0.3 * sway[k], np.array([0, 0, 1.0]), width=size, height=size, fx=fx))
    return views


def main(argv: Sequence[str] | None = None) -> int:
    """Render the frames and write the video."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path, help="output file, .mp4")
    parser.add_argument("--frames", type=int, default=96)
    parser.add_argument("--size", type=int, default=720, help="width and height, px")
    args = parser.parse_args(argv)
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        print("error: ffmpeg was expected, none was found; apt install ffmpeg, or ffmpeg.org", file=sys.stderr)
        return 2
    scene = build_scene(0)
    light = bake(scene)
    with TemporaryDirectory() as folder:
        for k, camera in enumerate(cameras(args.frames, args.size)):
            rgba = render_image(scene, light, camera).rgba.astype(np.float64)
            alpha = rgba[..., 3:] / 255
            frame = np.round(rgba[..., :3] * alpha + WALL * (1 - alpha)).astype(np.uint8)
            write_image(Path(folder) / f"{k:04d}.png", frame)
        rate = ["-framerate", str(FRAMES_PER_SECOND), "-i", f"{folder}/%04d.png"]
        coded = ["-pix_fmt", "yuv420p", "-crf", "16", str(args.video)]
        subprocess.run([ffmpeg, "-loglevel", "error", "-y", *rate, *coded], check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
