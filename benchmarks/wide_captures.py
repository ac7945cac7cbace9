"""Panoramas and fisheyes, drawn in a room, and how well their cameras are found.

::

    python -m benchmarks.wide_captures panorama FOLDER [--count 10] [--width 1024] [--tilt 3]
    python -m benchmarks.wide_captures fisheye FOLDER [--angle 180] ...

Somebody walks through a closed room of 4 x 3.2 x 2.4 m with mottled walls, turns as it comes, and holds the camera
level up to ``--tilt`` degrees (one sigma about each axis). ``FOLDER/photos`` has the photographs, which tell nothing of
their lens, ``FOLDER/truth.json`` their poses (world to camera). Then ``gs2d poses`` finds the cameras
(``FOLDER/capture``), and it is printed how far they are from the truth after the best similarity.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from gs2d.core.json_files import write_json
from gs2d.core.similarity import apply, similarity_scale, umeyama
from gs2d.data.readers.colmap import read_images
from gs2d.errors import Gs2dError
from gs2d.pipeline.options import PosesOptions
from gs2d.pipeline.sfm import find_poses

LOW, HIGH = np.array([-2.0, -1.6, 0.0]), np.array([2.0, 1.6, 2.4])  # m, of the room
CELLS, METRES = 256, 4.0  # of a wall's pattern, and what it covers
BENT = (0.02, -0.006, 0.001, 0.0)  # of the fisheye: r = f (t + k1 t^3 + ...), as OPENCV_FISHEYE has it
LEVEL = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # x right, y down, z ahead of who looks along the world's y
Rays = Callable[[np.ndarray, np.ndarray], np.ndarray]  # columns and rows, px -> rays of the camera; zeros: nothing


def walls(seed: int = 0) -> np.ndarray:
    """Noise of several scales [6, CELLS, CELLS, 3] in [0, 255]."""
    rng = np.random.default_rng(seed)
    made = np.zeros((6, CELLS, CELLS, 3))
    for cells, weight in ((8, 1.0), (32, 1.2), (64, 1.0), (128, 0.7)):
        noise = rng.random((6, cells, cells, 3)).repeat(CELLS // cells, axis=1).repeat(CELLS // cells, axis=2)
        made += weight * noise
    return np.asarray(255 * (made - made.min()) / (made.max() - made.min()))


def colours(patterns: np.ndarray, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Colours [..., 3] that rays of the world [..., 3] see from within the room; black for zeros."""
    found, nearest = np.zeros(rays.shape), np.full(rays.shape[:-1], np.inf)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for side, wall in enumerate((LOW[axis], HIGH[axis])):
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = (wall - eye[axis]) / rays[..., axis]
            hit = (distance > 0) & (distance < nearest)
            points = eye[others] + np.where(hit, distance, 0.0)[..., None] * rays[..., others]
            cell = np.floor(points * (CELLS / METRES)).astype(int) % CELLS
            found = np.where(hit[..., None], patterns[2 * axis + side][cell[..., 0], cell[..., 1]], found)
            nearest = np.where(hit, distance, nearest)
    return np.where(np.isfinite(nearest)[..., None], found, 0.0)


def panorama_rays(width: int) -> Rays:
    """Return the rays of an equirectangular panorama of ``width`` x ``width / 2``."""

    def rays(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        a, b = (u / width - 0.5) * 2 * np.pi, (v / (width / 2) - 0.5) * np.pi
        return np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1)

    return rays


def fisheye_focal(width: int, angle: float) -> float:
    """Return the focal length, px, at which a circle of ``width`` px shows ``angle`` degrees."""
    t = np.radians(angle / 2)
    return float(width / 2 / (t + sum(k * t ** (2 * i + 3) for i, k in enumerate(BENT))))


def fisheye_rays(width: int, height: int, angle: float) -> Rays:
    """Return the rays of a fisheye in whose width fit ``angle`` degrees; zeros beyond the circle."""
    f, t = fisheye_focal(width, angle), np.linspace(0, np.radians(angle / 2), 4000)
    reach = f * (t + sum(k * t ** (2 * i + 3) for i, k in enumerate(BENT)))

    def rays(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x, y = u - width / 2, v - height / 2
        r = np.hypot(x, y)
        at = np.interp(r, reach, t)
        side = np.sin(at) / np.maximum(r, 1e-9)
        found = np.stack([x * side, y * side, np.cos(at)], axis=-1)
        return np.where((r <= reach[-1])[..., None], found, 0.0)

    return rays


def photograph(patterns: np.ndarray, pose: np.ndarray, rays: Rays, size: tuple[int, int]) -> np.ndarray:
    """uint8 [H, W, 3] from a pose T_cam_world [4, 4]; four rays a pixel."""
    width, height = size
    v, u = (np.mgrid[: height * 2, : width * 2] + 0.5) / 2
    eye = -pose[:3, :3].T @ pose[:3, 3]
    seen = colours(patterns, eye, rays(u, v) @ pose[:3, :3])
    return np.rint(seen.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))).astype(np.uint8)


def walk(count: int, *, tilt: float, turn: float, seed: int = 0) -> list[np.ndarray]:
    """Poses T_cam_world [4, 4] of a walk through the room; each looks up to ``turn`` degrees aside."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(count):
        eye = np.array([-1.2 + 2.4 * i / max(count - 1, 1), 0.5 * np.sin(2.1 * i) - 0.3, 1.2 + 0.3 * np.sin(1.3 * i)])
        held = Rotation.from_euler("xyz", rng.normal(0, tilt, 3), degrees=True).as_matrix()
        turned = Rotation.from_euler("y", rng.uniform(-turn, turn), degrees=True).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = held @ turned @ LEVEL
        pose[:3, 3] = -pose[:3, :3] @ eye
        found.append(pose)
    return found


def write_photographs(
    folder: Path, kind: str, *, count: int = 10, width: int = 1024, angle: float = 180.0, tilt: float = 3.0
) -> dict[str, np.ndarray]:
    """Write ``000.jpg`` ... of a "panorama" or "fisheye" (4:3); returns their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    size = (width, width // 2 if kind == "panorama" else 3 * width // 4)
    rays = panorama_rays(width) if kind == "panorama" else fisheye_rays(*size, angle)
    patterns, poses = walls(), walk(count, tilt=tilt, turn=180.0 if kind == "panorama" else 25.0)
    names = [f"{i:03}.jpg" for i in range(count)]
    for name, pose in zip(names, poses, strict=True):
        Image.fromarray(photograph(patterns, pose, rays, size)).save(folder / name, quality=95)
    return dict(zip(names, poses, strict=True))


def errors(capture: Path, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """How far the cameras of a capture are from the truth: m (root mean square and worst), and degrees (worst)."""
    mine = {image.name: image.T_cam_world for image in read_images(capture / "sparse/0", "bin")}
    names = sorted(mine.keys() & truth.keys())
    found, there = (np.stack([-T[n][:3, :3].T @ T[n][:3, 3] for n in names]) for T in (mine, truth))
    fit = umeyama(found, there)
    off = np.linalg.norm(apply(fit, found) - there, axis=1)
    R = fit[:3, :3] / similarity_scale(fit)
    turns = [Rotation.from_matrix(mine[n][:3, :3] @ R.T @ truth[n][:3, :3].T).magnitude() for n in names]
    return {
        "placed": len(names),
        "centres_rms_m": float(np.sqrt((off**2).mean())),
        "centres_worst_m": float(off.max()),
        "turned_worst_degrees": float(np.degrees(max(turns))),
    }


def main(arguments: list[str] | None = None) -> int:
    """Draw, find the cameras and print how well they were found; 2 for what the user can mend."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.wide_captures", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("kind", choices=("panorama", "fisheye"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--width", type=int, default=1024, help="px")
    parser.add_argument("--angle", type=float, default=180.0, help="degrees in the width of a fisheye")
    parser.add_argument("--tilt", type=float, default=3.0, help="degrees, one sigma")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    photos = args.folder / "photos"
    try:
        truth = write_photographs(
            photos, args.kind, count=args.count, width=args.width, angle=args.angle, tilt=args.tilt
        )
        write_json(args.folder / "truth.json", {name: pose.tolist() for name, pose in truth.items()})
        began = time.monotonic()
        made: dict[str, Any] = find_poses(
            PosesOptions(photos=photos, out=args.folder / "capture", overwrite=True, threads=args.threads)
        )
        found = errors(args.folder / "capture", truth)
    except (Gs2dError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = {**found, "seconds": round(time.monotonic() - began, 1), "mean_error_px": made["mean_error_px"]}
    print(json.dumps({**rows, "lens": made["lens"]["chosen"], "cameras": made["cameras"]}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
