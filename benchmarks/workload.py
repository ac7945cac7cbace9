"""Workloads of the benchmarks: the seeded synthetic room (two spheres, a floor and a wall), or trained splats."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.data import load_scene
from gs2d.io.splat_ply import read_splats

NEAR_PLANE_POLICIES = 0.003  # additional fraction of the splats, as in views of indoor captures
PLACES = ((0.3, -0.5, -4.0), (-0.9, -0.8, -3.8), (1.2, -0.3, -3.9), (0.0, -1.4, -4.2))


def room(n: int, seed: int = 0) -> Splats:
    """Return n splats on two spheres, a floor and a wall.

    Normals are jittered by 0.15, scales are 0.9 x the mean distance to 3 neighbours x exp(0.4 N(0, 1)), opacities are
    half U(0.1, 0.5), half U(0.5, 0.95).
    """
    rng = np.random.default_rng(seed)
    quarter = n // 4
    counts = (quarter, quarter, quarter, n - 3 * quarter)

    def sphere(count: int, center: tuple[float, float, float], radius: float) -> tuple[np.ndarray, np.ndarray]:
        direction = np.asarray(rng.normal(size=(count, 3)))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(center) + radius * direction, direction

    def plane(count: int, corner: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv = rng.random((count, 2))
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        return corner + uv[:, :1] * a + uv[:, 1:] * b, np.repeat(normal[None], count, axis=0)

    parts = [
        sphere(counts[0], (-1.1, -0.5, 0.0), 1.15),
        sphere(counts[1], (1.2, -0.3, -0.1), 0.95),
        plane(counts[2], np.array([-3.0, 0.8, -3.0]), np.array([6.0, 0, 0]), np.array([0, 0, 4.6])),
        plane(counts[3], np.array([-3.0, -2.6, 1.6]), np.array([6.0, 0, 0]), np.array([0, 3.4, 0])),
    ]
    points = np.concatenate([p for p, _ in parts])
    normals = np.concatenate([m for _, m in parts]) + 0.15 * np.asarray(rng.normal(size=(n, 3)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances, _ = cKDTree(points).query(points, k=4)
    spacing = np.asarray(distances)[:, 1:].mean(axis=1)
    scales = 0.9 * spacing[:, None] * np.exp(0.4 * np.asarray(rng.normal(size=(n, 2))))
    opacity = np.where(rng.random(n) < 0.5, rng.uniform(0.1, 0.5, n), rng.uniform(0.5, 0.95, n))
    order = rng.permutation(n)  # no spatial order

    def tensor(x: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(x[order], dtype=np.float32))

    return Splats(
        means=tensor(points),
        quats=tensor(_quats_of(normals, rng)),
        log_scales=tensor(np.log(scales)),
        opacity_logits=tensor(np.log(opacity / (1 - opacity))),
        sh0=tensor(rng.normal(size=(n, 1, 3)) * 0.6),
        shN=tensor(rng.normal(size=(n, 15, 3)) * 0.1),
    )


def underfoot(n: int, seed: int = 0) -> Splats:
    """Return n splats on the floor below the cameras that cross the camera planes of some views and are never visible.

    Such splats have no ellipse on the image. Indoor captures have hundreds per view, on nearby floors and walls.
    """
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-1.2, 1.2, n), np.full(n, 0.9), rng.uniform(-4.2, -3.4, n)], axis=1)
    normals = np.array([0.0, -1.0, 0.0]) + 0.05 * rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def tensor(x: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(x, dtype=np.float32))

    return Splats(
        means=tensor(points),
        quats=tensor(_quats_of(normals, rng)),
        log_scales=tensor(np.log(0.3) + 0.1 * rng.normal(size=(n, 2))),
        opacity_logits=tensor(rng.uniform(-1, 2, n)),
        sh0=tensor(0.6 * rng.normal(size=(n, 1, 3))),
        shN=tensor(0.1 * rng.normal(size=(n, 15, 3))),
    )


def _quats_of(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rotations (w, x, y, z) [N, 4] whose third column is the normal, randomly turned about it."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, normals)
    quats = np.concatenate([1 + normals @ z[:, None], axis], axis=1)  # half-way quaternion
    quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-9)
    half = rng.uniform(0, np.pi, len(normals))
    w, x, y, q = quats.T
    c, s = np.cos(half), np.sin(half)  # quats * (c, 0, 0, s)
    return np.stack([w * c - q * s, x * c + y * s, y * c - x * s, w * s + q * c], axis=1)


def camera(width: int, height: int | None = None, place: tuple[float, float, float] = (0.3, -0.5, -4.0)) -> Camera:
    """Return a view of the room, square if no height is passed; the focal length is 0.9 x the width."""
    return look_at(
        np.array(place),
        np.array([0.0, 0.0, 0.2]),
        np.array([0.0, -1.0, 0.0]),
        width=width,
        height=width if height is None else height,
        fx=0.9 * width,
    )


def places(width: int, height: int) -> tuple[Camera, ...]:
    """Return the four training views of the room."""
    return tuple(camera(width, height, place) for place in PLACES)


@dataclass(frozen=True, eq=False)
class Workload:
    """Splats and cameras; the rasterizer is timed on the first camera."""

    name: str
    splats: Splats
    cameras: tuple[Camera, ...]


FULL = (
    (20_000, 400, 400),
    (50_000, 400, 400),
    (100_000, 400, 400),
    (100_000, 800, 800),
    (300_000, 800, 800),
    (300_000, 1600, 1060),
    (1_000_000, 1600, 1060),
    (1_000_000, 3840, 2160),
    (5_000_000, 1600, 1060),
)
QUICK = ((2_000, 96, 96), (4_000, 160, 106))


def name_of(count: int, width: int, height: int) -> str:
    """Return the workload name, for instance "room-100k-800x800"."""
    size = f"{count // 1_000_000}M" if count % 1_000_000 == 0 else f"{count // 1000}k"
    return f"room-{size}-{width}x{height}"


def room_workload(count: int, width: int, height: int, *, crossing: bool = False) -> Workload:
    """Return the room with four views; ``near_plane_policy`` appends invisible splats across the camera plane."""
    splats, name = room(count), name_of(count, width, height)
    if crossing:
        more = underfoot(max(1, round(NEAR_PLANE_POLICIES * count)))
        splats = Splats(**{key: torch.cat([part, getattr(more, key)]) for key, part in splats.items()})
    return Workload(name + "-crossing" * crossing, splats, places(width, height))


def trained_workload(splats_file: Path, capture: Path, downscale: int) -> Workload:
    """Return trained splats (a PLY, or a run folder with splats.ply) with the cameras of their capture."""
    file = splats_file / "splats.ply" if splats_file.is_dir() else splats_file
    splats = read_splats(file)
    views = load_scene(capture, downscale=downscale).train
    cameras = tuple(view.camera for view in views[:: max(1, len(views) // 4)][:4])
    return Workload(f"{capture.resolve().name}-{len(splats)}-{cameras[0].width}x{cameras[0].height}", splats, cameras)


class AbsentError(Exception):
    """Raised if data of a workload is missing on this machine; the message names it."""


def run_workload(run: Path) -> Workload:
    """Return the splats of a finished run with the cameras of the capture that its ``run.json`` names.

    Raises
    ------
    AbsentError
        If the run, its splats or its capture is missing. The repository contains no third-party captures.
    """
    if not (run / "run.json").is_file() or not (run / "splats.ply").is_file():
        raise AbsentError(f"{run} is no finished run")
    definition = json.loads((run / "run.json").read_text())
    capture = Path(definition["scene"]["path"])
    if not capture.exists():
        raise AbsentError(f"the capture of {run} is not at {capture} any more")
    made = trained_workload(run, capture, definition["downscale"])
    title = definition.get("title") or definition["scene"]["name"]
    return replace(made, name=made.name.replace(capture.resolve().name, title, 1))
