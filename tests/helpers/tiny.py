"""Tiny captures for end-to-end tests: a coloured ball in the NeRF-Synthetic layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from gs2d.core.camera import Camera, look_at

SIZE = 24
ANGLE = 0.7  # radians, field of view
RADIUS = 0.8  # ball radius, world units


def mottled(points: np.ndarray) -> np.ndarray:
    """Return colours [..., 3] of points: red, green and blue follow x, y, z, with mottling."""
    return np.asarray(0.5 + 0.4 * points / RADIUS + 0.1 * np.sin(9 * points))


def ball_image(camera: Camera, paint: Callable[[np.ndarray], np.ndarray] = mottled) -> np.ndarray:
    """Render the ball at the origin as RGBA uint8 [H, W, 4]; ``paint`` returns the colours of its points."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    rays = rays @ camera.rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    b = rays @ camera.center
    inside = b**2 - camera.center @ camera.center + RADIUS**2
    points = camera.center + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    color = np.clip(paint(points), 0, 1)
    rgba = np.concatenate([color, np.ones_like(inside)[..., None]], axis=-1) * (inside > 0)[..., None]
    return np.rint(255 * rgba).astype(np.uint8)


def ball_cameras(count: int, size: int = SIZE, phase: float = 0.0) -> list[Camera]:
    """Return cameras on a rising spiral around the ball."""
    focal = 0.5 * size / np.tan(ANGLE / 2)
    cameras = []
    for i in range(count):
        turn, rise = 2.4 * i + phase, -0.5 + 1.4 * (i + 0.5) / count
        eye = 3.0 * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        cameras.append(look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]), width=size, height=size, fx=focal))
    return cameras


def write_capture(folder: Path, *, train: int = 6, test: int = 2, size: int = SIZE) -> Path:
    """Write the ball as a NeRF-Synthetic capture."""
    for split, count, phase in (("train", train, 0.0), ("test", test, 1.1)):
        (folder / split).mkdir(parents=True)
        frames = []
        for i, camera in enumerate(ball_cameras(count, size, phase)):
            Image.fromarray(ball_image(camera)).save(folder / split / f"r_{i}.png")
            pose = np.linalg.inv(camera.T_cam_world) @ np.diag([1.0, -1.0, -1.0, 1.0])  # to OpenGL axes
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
    return folder


def write_ball_mesh(path: Path, rings: int = 24) -> None:
    """Write the ball's surface as a PLY mesh."""
    from gs2d.core.mesh import Mesh
    from gs2d.io.meshes import write_mesh

    theta, phi = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    vertices = RADIUS * np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = i * 2 * rings + j, i * 2 * rings + (j + 1) % (2 * rings)
    faces = np.concatenate([np.stack([a, a + 2 * rings, b], -1), np.stack([b, a + 2 * rings, b + 2 * rings], -1)])
    write_mesh(path, Mesh(vertices, faces.reshape(-1, 3).astype(np.int32)))
