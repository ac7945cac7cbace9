"""Train a fisheye or panorama capture from its whole photographs and from pinhole faces, and compare new photographs.

::

    python -m benchmarks.wide_training fisheye FOLDER [--count 36] [--width 400] [--angle 175] [--iterations 600]
                                       [--seed 0] [--robust auto] [--set KEY=VALUE ...] [--only whole faces faces-long]

``FOLDER`` is a room of known cameras (``benchmarks.wide_captures``) with sparse points on its surfaces; every sixth
photograph is held out. ``faces-long`` trains the faces for twice as many iterations, which takes about as long as the
whole photographs. Held-out photographs are rendered by the rays of their lens. The PSNR is that of all pixels, and of
three rings of equal width around the axis (of panoramas: bands from the equator to the poles); ``pinhole`` is that of
new pinhole photographs of 90 degrees from the same places, as fine as the photographs on the axis, and ``half`` of the
same at half the size: everywhere coarser than the photographs.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import gs2d
from benchmarks.wide_captures import (
    BENT,
    BOXES,
    NO_BOXES,
    Rays,
    colours,
    distances,
    fisheye_focal,
    fisheye_rays,
    photograph,
    walls,
    write_photographs,
)
from gs2d.core.image_arrays import area_downscale
from gs2d.core.json_files import write_json
from gs2d.data import View
from gs2d.evaluation.image_metrics import psnr_float
from gs2d.pipeline.prepare.options import Training
from gs2d.training.photographs import TrainedViews

HELD_OUT = 6
FINEST, SAMPLES = 64, 4  # detail of about 2 px and more; rays along a side of a pixel
POINTS, NOISE = 4000, 0.004  # sparse points, and their standard deviation, m
RINGS = ("centre", "middle", "rim")
ARMS = {"whole": 1, "faces": 1, "faces-long": 2}  # and the factor of the iterations


def boxes_of(kind: str) -> np.ndarray:
    """Return the boxes in the room of a kind of capture, as ``write_photographs``."""
    return BOXES if kind == "fisheye" else NO_BOXES


def write_capture(folder: Path, kind: str, *, count: int, width: int, angle: float) -> None:
    """Write photographs, the masks of a fisheye, noisy sparse points and ``transforms.json``."""
    poses = write_photographs(
        folder / "images",
        kind,
        count=count,
        width=width,
        angle=angle,
        fits="height",
        tilt=10.0,
        finest=FINEST,
        samples=SAMPLES,
        subsampling="4:4:4",
    )
    height = 3 * width // 4 if kind == "fisheye" else width // 2
    meta: dict[str, Any] = {"w": width, "h": height, "camera_model": "EQUIRECTANGULAR"}
    if kind == "fisheye":
        focal = fisheye_focal(height, angle)
        meta |= {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "camera_model": "OPENCV_FISHEYE"}
        meta |= dict(zip(("k1", "k2", "k3", "k4"), BENT, strict=True))
        v, u = np.mgrid[:height, :width] + 0.5
        shown = fisheye_rays(width, height, angle, circle=height)(u, v).any(axis=-1)
        (folder / "masks").mkdir(exist_ok=True)
        for name in poses:
            Image.fromarray(shown.astype(np.uint8) * np.uint8(255)).save(folder / "masks" / f"{Path(name).stem}.png")
    rng, patterns, rows, frames = np.random.default_rng(1), walls(finest=FINEST), [], []
    for name, pose in sorted(poses.items()):
        opengl = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{name}", "transform_matrix": opengl.tolist()})
        rays, eye = rng.normal(size=(POINTS // count, 3)), -pose[:3, :3].T @ pose[:3, 3]
        at = eye + distances(eye, rays, boxes_of(kind))[:, None] * rays + rng.normal(scale=NOISE, size=rays.shape)
        rows += np.concatenate([at, np.rint(colours(patterns, eye, rays, boxes_of(kind)))], axis=1).tolist()
    names = [frame["file_path"] for frame in frames]
    test = names[HELD_OUT // 2 :: HELD_OUT]
    fields = "".join(f"property float {c}\n" for c in "xyz") + "".join(
        f"property uchar {c}\n" for c in ("red", "green", "blue")
    )
    lines = "".join(f"{x:.5f} {y:.5f} {z:.5f} {r:.0f} {g:.0f} {b:.0f}\n" for x, y, z, r, g, b in rows)
    (folder / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{fields}end_header\n{lines}"
    )
    meta |= {"ply_file_path": "points.ply", "frames": frames}
    split = {"train_filenames": [name for name in names if name not in test], "test_filenames": test}
    write_json(folder / "transforms.json", meta | split)


def rings(rays: np.ndarray, mask: np.ndarray | None, kind: str, angle: float) -> list[np.ndarray]:
    """Return the pixels [H, W] bool of each ring of a photograph with unit rays [H, W, 3]."""
    fisheye = kind == "fisheye"
    off = np.arccos(rays[..., 2].clip(-1, 1)) if fisheye else np.abs(np.arcsin(rays[..., 1].clip(-1, 1)))
    part = off / (np.radians(angle / 2) if fisheye else np.pi / 2) * len(RINGS)
    return [(part >= ring) & (part < ring + 1) & (mask is None or mask) for ring in range(len(RINGS))]


def score(trained: gs2d.Trained, test: Sequence[View], kind: str, angle: float) -> dict[str, float]:
    """Return the mean PSNR of held-out photographs, by ring, and of pinhole photographs; ``test`` has the former."""
    values: dict[str, list[float]] = {name: [] for name in ("all", *RINGS, "pinhole", "half")}
    for view in test:
        color, rays = trained.render(view.camera).color, view.camera.rays
        target = torch.from_numpy(view.target(trained.settings.background))
        assert rays is not None
        parts = rings(rays[..., :3].numpy(), view.mask(), kind, angle)
        for name, pixels in zip(("all", *RINGS), (np.any(parts, axis=0), *parts), strict=True):
            values[name].append(psnr_float(color, target, torch.from_numpy(pixels)))
    for view in trained.scene.test:
        if view.name.endswith("_front.jpg"):
            c = view.camera
            size, boxes = (c.width, c.height), boxes_of(kind)
            truth = photograph(walls(finest=FINEST), c.T_cam_world, pinhole_rays(c), size, boxes, SAMPLES)
            for name, factor in (("pinhole", 1), ("half", 2)):
                color, small = trained.render(c.downscaled(factor)).color, area_downscale(truth, factor)
                values[name].append(psnr_float(color, torch.from_numpy(small).float() / 255))
    return {name: round(float(np.mean(numbers)), 2) for name, numbers in values.items()}


def pinhole_rays(camera: gs2d.Camera) -> Rays:
    """Return the rays of a pinhole camera."""

    def rays(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    return rays


def main(arguments: list[str] | None = None) -> int:
    """Write the capture if it is not there, train each way and print one JSON line for each."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.wide_training", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("kind", choices=("panorama", "fisheye"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=36)
    parser.add_argument("--width", type=int, default=400, help="width, px")
    parser.add_argument("--angle", type=float, default=175.0, help="degrees across the circle of a fisheye")
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robust", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--only", nargs="+", choices=ARMS, default=list(ARMS))
    args = parser.parse_args(arguments)
    if not (args.folder / "transforms.json").exists():
        write_capture(args.folder, args.kind, count=args.count, width=args.width, angle=args.angle)
    scene = gs2d.load_scene(args.folder, masked="ignore")
    test = TrainedViews(scene.test, whole=True, masks=True, like=torch.zeros(())).views
    recipe = replace(gs2d.get_recipe("best"), seed=args.seed)
    for arm in args.only:
        views = scene.train if arm == "whole" else tuple(replace(view, whole=None) for view in scene.train)
        began = time.process_time()
        trained = gs2d.train(
            replace(scene, train=views),
            recipe,
            iterations=args.iterations * ARMS[arm],
            backend="cpu",
            options=Training(robust=args.robust, overrides=tuple(args.set)),
        )
        took = round(time.process_time() - began)
        row = {"arm": arm, "seed": args.seed, **score(trained, test, args.kind, args.angle)}
        print(json.dumps({**row, "splats": len(trained.splats), "cpu_s": took}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
