"""Render panoramas and fisheye images in a room, and measure the accuracy of the estimated cameras.

::

    python -m benchmarks.wide_captures panorama FOLDER [--count 10] [--width 1024] [--tilt 3]
    python -m benchmarks.wide_captures fisheye FOLDER [--angle 180] [--across width] [--off 0] [--camera-model auto] ...

The camera moves through a closed room of 4 x 3.2 x 2.4 m with mottled walls (and three boxes, for fisheyes), turns
randomly, and is held level up to ``--tilt`` degrees (one sigma about each axis). The fisheye circle fits the
``--across`` height (circular images), width (dark corners) or diagonal of the image (all pixels valid), and its centre
may be ``--off`` the image centre. ``FOLDER/photos`` has the images, without lens metadata, and ``FOLDER/truth.json``
their poses (world to camera). ``gs2d poses`` then estimates the cameras (``FOLDER/capture``), and their errors are
printed after the best similarity alignment.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from gs2d.core.json_files import write_json
from gs2d.core.similarity import apply, similarity_scale, umeyama
from gs2d.data.readers.colmap import read_images
from gs2d.errors import Gs2dError
from gs2d.pipeline.prepare.options import LensModel, PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.training.events import Notice

LOW, HIGH = np.array([-2.0, -1.6, 0.0]), np.array([2.0, 1.6, 2.4])  # m, size of the room
CELLS, METRES = 256, 4.0  # cells of a wall's pattern, and its size
BENT = (0.02, -0.006, 0.001, 0.0)  # fisheye coefficients: r = f (t + k1 t^3 + ...), as in OPENCV_FISHEYE
NO_BOXES = np.zeros((0, 2, 3))
BOXES = np.array(  # m: a shelf, a chest, a stool
    [
        [[-1.5, 1.0, 0.0], [-0.9, 1.4, 1.3]],
        [[0.3, 0.8, 0.0], [1.3, 1.3, 0.6]],
        [[-0.4, 0.7, 0.0], [-0.1, 1.0, 0.45]],
    ]
)
LEVEL = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # x right, y down, z forward, along the world's y
Rays = Callable[[np.ndarray, np.ndarray], np.ndarray]  # columns and rows, px -> rays of the camera; zeros: no ray


def walls(seed: int = 0, finest: int = 128) -> np.ndarray:
    """Return noise at several scales [6, CELLS, CELLS, 3] in [0, 255], of up to ``finest`` cells along a side."""
    rng = np.random.default_rng(seed)
    made = np.zeros((6, CELLS, CELLS, 3))
    for cells, weight in ((8, 1.0), (32, 1.2), (64, 1.0), (128, 0.7)):
        if cells > finest:
            break
        noise = rng.random((6, cells, cells, 3)).repeat(CELLS // cells, axis=1).repeat(CELLS // cells, axis=2)
        made += weight * noise
    return np.asarray(255 * (made - made.min()) / (made.max() - made.min()))


def colours(patterns: np.ndarray, eye: np.ndarray, rays: np.ndarray, boxes: np.ndarray = NO_BOXES) -> np.ndarray:
    """Return colours [..., 3] of world rays [..., 3] from inside the room; black for zeros.

    ``boxes`` [B, 2, 3] holds two corners per box, m; no camera is inside a box.
    """
    flat = rays.reshape(-1, 3)
    seen = np.flatnonzero(flat.any(axis=1))
    d = flat[seen]
    with np.errstate(divide="ignore", invalid="ignore"):
        walls_at = (np.where(d > 0, HIGH, LOW) - eye) / d
        walls_at[~(d != 0)] = np.inf
        axis = walls_at.argmin(axis=1)
        nearest = walls_at[np.arange(len(d)), axis]
        shown = _painted(patterns, 2 * axis + (d[np.arange(len(d)), axis] > 0), eye + nearest[:, None] * d, axis)
        for number, (low, high) in enumerate(boxes):
            one, other = (low - eye) / d, (high - eye) / d
            enter, leave = np.fmin(one, other), np.fmax(one, other)
            axis, distance = enter.argmax(axis=1), enter.max(axis=1)
            hit = np.flatnonzero((distance > 0) & (distance < leave.min(axis=1)) & (distance < nearest))
            nearest[hit] = distance[hit]
            points = 3 * (eye + distance[hit, None] * d[hit])
            mottled = _painted(patterns, np.full(len(hit), number), points, axis[hit])
            shown[hit] = 0.4 * mottled + 0.6 * 230 * np.eye(3)[number]
    found = np.zeros(flat.shape)
    found[seen] = shown
    return found.reshape(rays.shape)


def distances(eye: np.ndarray, rays: np.ndarray, boxes: np.ndarray = NO_BOXES) -> np.ndarray:
    """Return how many times their length rays [P, 3] from inside the room reach [P]."""
    nearest = ((np.where(rays > 0, HIGH, LOW) - eye) / rays).min(axis=1)
    for low, high in boxes:
        one, other = (low - eye) / rays, (high - eye) / rays
        enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        nearest = np.where((enter > 0) & (enter < leave) & (enter < nearest), enter, nearest)
    return nearest


def _painted(patterns: np.ndarray, which: np.ndarray, points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return colours [P, 3] of points [P, 3] on planes normal to world axes [P], with patterns [P]."""
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    cell = np.floor(np.take_along_axis(points, others, axis=1) * (CELLS / METRES)).astype(int) % CELLS
    return np.asarray(patterns[which, cell[:, 0], cell[:, 1]])


def panorama_rays(width: int) -> Rays:
    """Return the rays of an equirectangular panorama of ``width`` x ``width / 2``."""

    def rays(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        a, b = (u / width - 0.5) * 2 * np.pi, (v / (width / 2) - 0.5) * np.pi
        return np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1)

    return rays


def fisheye_focal(width: float, angle: float) -> float:
    """Return the focal length, px, at which a circle of ``width`` px shows ``angle`` degrees."""
    t = np.radians(angle / 2)
    return float(width / 2 / (t + sum(k * t ** (2 * i + 3) for i, k in enumerate(BENT))))


def across(size: tuple[int, int], what: str) -> float:
    """Return the "width", "height" or "diagonal" of an image, px."""
    return {"width": size[0], "height": size[1], "diagonal": float(np.hypot(*size))}[what]


def fisheye_rays(
    width: int, height: int, angle: float, *, circle: float | None = None, off: tuple[float, float] = (0.0, 0.0)
) -> Rays:
    """Return the rays of a fisheye; zeros outside its circle of ``angle`` degrees.

    The circle is ``circle`` px wide (the image width), and its centre is ``off`` px from the image centre.
    """
    circle = float(width) if circle is None else circle
    f, t = fisheye_focal(circle, angle), np.linspace(0, np.radians(angle / 2), 4000)
    reach = f * (t + sum(k * t ** (2 * i + 3) for i, k in enumerate(BENT)))

    def rays(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x, y = u - width / 2 - off[0], v - height / 2 - off[1]
        r = np.hypot(x, y)
        at = np.interp(r, reach, t)
        side = np.sin(at) / np.maximum(r, 1e-9)
        found = np.stack([x * side, y * side, np.cos(at)], axis=-1)
        return np.where((r <= reach[-1])[..., None], found, 0.0)

    return rays


def photograph(
    patterns: np.ndarray,
    pose: np.ndarray,
    rays: Rays,
    size: tuple[int, int],
    boxes: np.ndarray = NO_BOXES,
    samples: int = 2,
) -> np.ndarray:
    """Render uint8 [H, W, 3] from a pose T_cam_world [4, 4], with ``samples``^2 rays per pixel."""
    width, height = size
    v, u = (np.mgrid[: height * samples, : width * samples] + 0.5) / samples
    eye = -pose[:3, :3].T @ pose[:3, 3]
    seen = colours(patterns, eye, rays(u, v) @ pose[:3, :3], boxes)
    return np.rint(seen.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))).astype(np.uint8)


def walk(count: int, *, tilt: float, turn: float, seed: int = 0) -> list[np.ndarray]:
    """Return poses T_cam_world [4, 4] of a walk through the room; each looks up to ``turn`` degrees aside."""
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
    folder: Path,
    kind: str,
    *,
    count: int = 10,
    width: int = 1024,
    angle: float = 180.0,
    fits: str = "width",
    off: tuple[float, float] = (0.0, 0.0),
    tilt: float = 3.0,
    finest: int = 128,
    samples: int = 2,
    subsampling: str = "4:2:0",
) -> dict[str, np.ndarray]:
    """Write ``000.jpg`` ... of a "panorama" or "fisheye" (4:3); return their poses.

    The fisheye circle of ``angle`` degrees fits the width, height or diagonal (``fits``).
    """
    folder.mkdir(parents=True, exist_ok=True)
    size, rays, boxes = (width, width // 2), panorama_rays(width), NO_BOXES
    if kind == "fisheye":
        size, boxes = (width, 3 * width // 4), BOXES
        rays = fisheye_rays(*size, angle, circle=across(size, fits), off=off)
    patterns, poses = walls(finest=finest), walk(count, tilt=tilt, turn=180.0 if kind == "panorama" else 25.0)
    names = [f"{i:03}.jpg" for i in range(count)]
    for name, pose in zip(names, poses, strict=True):
        image = Image.fromarray(photograph(patterns, pose, rays, size, boxes, samples))
        image.save(
            folder / name,
            quality=95,
            subsampling=subsampling,
            **({"xmp": whole_sphere(*size)} if kind == "panorama" else {}),
        )
    return dict(zip(names, poses, strict=True))


def whole_sphere(width: int, height: int) -> bytes:
    """Return the XMP tag of a full panorama, as 360-degree cameras write it."""
    sides = (("Width", width), ("Height", height))
    numbers = " ".join(
        f'GPano:{of}{side}Pixels="{size}"' for side, size in sides for of in ("CroppedAreaImage", "FullPano")
    )
    return f'<rdf:Description GPano:ProjectionType="equirectangular" {numbers}/>'.encode()


def errors(capture: Path, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Return camera errors against the ground truth: m (root mean square and worst), and degrees (worst)."""
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
    """Render, estimate the cameras and print their errors; return 2 for user errors."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.wide_captures", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("kind", choices=("panorama", "fisheye"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--width", type=int, default=1024, help="width, px")
    parser.add_argument("--angle", type=float, default=180.0, help="degrees across the circle of a fisheye")
    parser.add_argument(
        "--across",
        choices=("width", "height", "diagonal"),
        default="width",
        help="image dimension that the fisheye circle fits",
    )
    parser.add_argument(
        "--off", type=float, default=0.0, help="offset of the circle's centre to the right and down, px"
    )
    parser.add_argument("--camera-model", choices=get_args(LensModel), default="auto", help="passed to gs2d poses")
    parser.add_argument("--tilt", type=float, default=3.0, help="degrees, one sigma")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    photos = args.folder / "photos"
    try:
        truth = write_photographs(
            photos,
            args.kind,
            count=args.count,
            width=args.width,
            angle=args.angle,
            fits=args.across,
            off=(args.off, args.off),
            tilt=args.tilt,
        )
        write_json(args.folder / "truth.json", {name: pose.tolist() for name, pose in truth.items()})
        began = time.monotonic()
        made: dict[str, Any] = find_poses(
            PosesOptions(
                photos=photos,
                out=args.folder / "capture",
                overwrite=True,
                threads=args.threads,
                camera_model=args.camera_model,
            ),
            lambda event: print(event.text, file=sys.stderr) if isinstance(event, Notice) else None,
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
