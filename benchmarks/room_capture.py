"""Render a capture of the size of published room captures: 292 images of 1560x1040, rendered from splats.

A room with a table and objects, made of splats with colours at several scales, is rendered from two rings of cameras
inside. Cameras and points with tracks are written as a COLMAP text model, images as JPEG. A run reads, downscales by
two, trains at 780x520, scores and meshes as much as a run on bonsai of Mip-NeRF 360, without its photographs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings

VIEWS, SIZE = 292, (1560, 1040)  # px; half of it is the size of bonsai's images_4
SPLATS, POINTS = 200_000, 60_000
HALF = np.array([3.0, 3.0, 1.4])  # world units, size of the room
QUALITY = 92  # JPEG quality
FOUND = 0.15  # share of the visible points that an image observes: about 9 images per point, as after matching
HIDDEN = 0.02  # relative depth tolerance of the visibility test


def surfaces(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points [count, 3], world units, on walls, floor, ceiling, a table top and three balls, with normals."""
    places, normals = [], []
    fractions = [0.09] * 6 + [0.16] + [0.1] * 3
    numbers = np.floor(np.array(fractions) * count).astype(int)
    numbers[0] += count - numbers.sum()
    for side in range(6):
        at = rng.uniform(-1, 1, (numbers[side], 3))
        at[:, side // 2] = 1 if side % 2 else -1
        places.append(at * HALF)
        normals.append(np.repeat(np.eye(3)[side // 2][None], numbers[side], axis=0))
    places.append(np.concatenate([rng.uniform(-0.8, 0.8, (numbers[6], 2)), np.full((numbers[6], 1), -0.4)], axis=1))
    normals.append(np.repeat([[0.0, 0.0, 1.0]], numbers[6], axis=0))
    for number, (x, y, radius) in zip(numbers[7:], ((0.0, 0.0, 0.4), (0.5, 0.4, 0.2), (-0.4, 0.5, 0.15)), strict=True):
        direction = rng.normal(size=(number, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        places.append(np.array([x, y, radius - 0.4]) + radius * direction)
        normals.append(direction)
    return np.concatenate(places), np.concatenate(normals)


def colors(places: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return colours [P, 3] in [0, 1]: waves with lengths from the room's size down to about 10 cm."""
    out = np.full((len(places), 3), 0.5)
    for wave, weight in ((0.8, 0.16), (3.0, 0.12), (9.0, 0.1), (25.0, 0.1)):
        for channel in range(3):
            out[:, channel] += weight * np.sin(places @ rng.normal(size=3) * wave + rng.uniform(0, 2 * math.pi))
    return np.asarray(np.clip(out, 0, 1))


def room_splats(count: int, seed: int) -> tuple[Splats, np.ndarray]:
    """Return the splats of the room and their colours [N, 3] uint8."""
    rng = np.random.default_rng(seed)
    places, normals = surfaces(count, rng)
    painted = colors(places, rng)
    axis = np.cross([0.0, 0.0, 1.0], normals)
    quats = np.concatenate([1 + normals[:, 2:], axis], axis=1)  # half-way between z and the normal
    quats[np.linalg.norm(quats, axis=1) < 1e-6] = (0.0, 1.0, 0.0, 0.0)
    scale = np.where(np.abs(places[:, :2]).max(axis=1) < 0.85, 0.009, 0.035) * np.exp(0.3 * rng.normal(size=count))

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    splats = Splats(
        means=tensor(places),
        quats=tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True)),
        log_scales=tensor(np.repeat(np.log(scale)[:, None], 2, axis=1)),
        opacity_logits=tensor(np.full(count, 3.0)),
        sh0=tensor((painted - 0.5)[:, None] / 0.28209479177387814),
        shN=torch.zeros(count, 15, 3),
    )
    return splats, np.rint(255 * painted).astype(np.uint8)


def room_cameras(count: int, size: tuple[int, int]) -> list[Camera]:
    """Return cameras on two rings in the room that look slightly past the table's centre."""
    found = []
    for number in range(count):
        angle = 4 * math.pi * number / count
        radius, height = (2.0, 0.3) if number < count // 2 else (1.6, 0.9)
        eye = np.array([radius * math.cos(angle), radius * math.sin(angle), height + 0.1 * math.sin(5 * angle)])
        target = np.array([0.2 * math.sin(3 * angle), 0.2 * math.cos(2 * angle), -0.3])
        found.append(look_at(eye, target, np.array([0.0, 0.0, 1.0]), width=size[0], height=size[1], fx=0.75 * size[0]))
    return found


def write_room_capture(
    folder: Path,
    *,
    views: int = VIEWS,
    size: tuple[int, int] = SIZE,
    splats: int = SPLATS,
    points: int = POINTS,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write ``images/*.jpg`` and ``sparse/0/*.txt``; the model is written last, so that it marks a complete capture."""
    scene, painted = room_splats(splats, seed)
    cameras = room_cameras(views, size)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    rng, found = np.random.default_rng(seed + 1), np.random.default_rng(seed + 2)
    chosen = found.choice(splats, points, replace=False)
    places = scene.means.numpy()[chosen] + found.normal(scale=0.004, size=(points, 3))
    rows = []
    for number, camera in enumerate(cameras, start=1):
        with torch.no_grad():
            seen = rasterize(scene, camera, RasterSettings(sh_degree=0, with_distortion=False))
        color = seen.color.numpy()
        noisy = 255 * np.clip(color, 0, 1) + rng.normal(scale=2.0, size=color.shape)  # sensor noise
        name = f"room_{number:04d}.jpg"
        Image.fromarray(np.rint(np.clip(noisy, 0, 255)).astype(np.uint8)).save(
            folder / "images" / name, quality=QUALITY
        )
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = " ".join(f"{value:.12g}" for value in (w, x, y, z, *camera.T_cam_world[:3, 3]))
        shown, pixels = _shown(places, camera, seen.depth_median.numpy())
        kept = found.random(len(shown)) < FOUND
        marks = " ".join(f"{u:.2f} {v:.2f} {at + 1}" for at, (u, v) in zip(shown[kept], pixels[kept], strict=True))
        rows.append(f"{number} {pose} 1 {name}\n{marks}\n")
        on_progress(number, views)
    lines = [
        f"{number} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0.5\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(places, painted[chosen], strict=True), start=1)
    ]
    (model / "points3D.txt").write_text("".join(lines))
    first = cameras[0]
    intrinsics = f"{first.fx} {first.fy} {first.cx} {first.cy}"
    (model / "cameras.txt").write_text(f"1 PINHOLE {first.width} {first.height} {intrinsics}\n")
    (model / "images.txt").write_text("".join(rows))


def _shown(places: np.ndarray, camera: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of the points [P, 3] visible in an image with this depth [H, W], and their pixels [M, 2]."""
    pixels, z = camera.project(places)
    inside = (z > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    rows = np.flatnonzero(inside)
    column, row = np.floor(pixels[rows]).astype(np.int64).T
    there = depth[row, column]
    shown = (there > 0) & (z[rows] <= (1 + HIDDEN) * there)
    return rows[shown], pixels[rows[shown]]
