"""Seeded scenes scored by ``scripts/oracle_open3d.py`` and the tests; NumPy only, so that both get the same bits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

TAU = 0.03  # m
OBSERVED_RESOLUTION = 2.0  # mm


def rotation(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """Rotation matrix [3, 3] about an axis (Rodrigues)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = math.radians(degrees)
    return np.eye(3) + math.sin(a) * K + (1 - math.cos(a)) * K @ K


def similarity(scale: float, R: np.ndarray, shift: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = scale * R, shift
    return T


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def hills(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return heights over [-1, 1]^2 without symmetry, with slopes up to about 1."""
    bump = np.exp(-8 * ((x - 0.3) ** 2 + (y + 0.2) ** 2))
    return 0.25 * np.sin(3 * x + 0.4) * np.cos(2 * y - 0.7) + 0.2 * bump + 0.1 * x * y


def grid_mesh(cells: int, half: float, height: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a height field over [-half, half]^2."""
    line = np.linspace(-half, half, cells + 1)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = i, i + 1, i + cells + 2, i + cells + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.stack([x, y, height(x, y)], 1), faces.astype(np.int32)


@dataclass(frozen=True)
class TntScene:
    """A capture, and the official files of its scene as arrays.

    ``vertices``, ``faces`` and ``centers`` are in the capture's frame; ``T_truth_capture`` is the expected alignment.
    """

    vertices: np.ndarray
    faces: np.ndarray
    centers: np.ndarray
    scan: np.ndarray
    crop: dict
    T_truth_log: np.ndarray
    log: np.ndarray
    T_truth_capture: np.ndarray
    T_log_capture: np.ndarray


def tnt_scene(seed: int = 0, *, T_log_capture: np.ndarray | None = None) -> TntScene:
    """Return hills scanned with 2 mm of noise, and their reconstruction with 60 mm waves and a hole.

    The log of the 60 cameras is 1 % too large, shifted by a few centimetres, and has 5 mm of noise.
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-1.1, 1.1, (12_000, 2))
    scan = np.column_stack([xy, hills(*xy.T)]) + rng.normal(0, 0.002, (12_000, 3))
    T_truth_log = similarity(1.7, rotation((1, 2, 3), 40), (0.3, -2, 0.7))
    if T_log_capture is None:
        T_log_capture = similarity(0.8, rotation((3, -1, 1), -65), (2, 1, -0.5))
    T = T_truth_log @ T_log_capture
    back = np.linalg.inv(T)

    def rough(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return hills(x, y) + 0.06 * np.sin(9 * x) * np.sin(7 * y)

    vertices, faces = grid_mesh(60, 1.05, rough)
    middle = vertices[faces].mean(1)
    used, faces = np.unique(faces[np.hypot(middle[:, 0] + 0.5, middle[:, 1] - 0.4) > 0.25], return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3).astype(np.int32)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    centers = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), 1.5 + 0.4 * np.sin(3 * angle)])
    log = np.tile(np.eye(4), (60, 1, 1))
    logged = 1.01 * centers + (0.02, 0, -0.03) + rng.normal(0, 0.005, centers.shape)
    log[:, :3, 3] = moved(np.linalg.inv(T_truth_log), logged)
    polygon = [[-0.95, -0.9, 0.0], [0.9, -0.95, 0.0], [0.95, 0.5, 0.0], [0.2, 0.9, 0.0], [-0.9, 0.85, 0.0]]
    crop = {
        "class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
        "orthogonal_axis": "Z", "axis_min": -0.4, "axis_max": 0.6, "bounding_polygon": polygon,
    }  # fmt: skip
    return TntScene(moved(back, vertices), faces, moved(back, centers), scan, crop, T_truth_log, log, T, T_log_capture)


@dataclass(frozen=True)
class DtuScene:
    """A mesh in mm, and the official files of its scan as arrays."""

    vertices: np.ndarray
    faces: np.ndarray
    scan: np.ndarray
    observed: np.ndarray
    bounds: np.ndarray
    plane: np.ndarray


def dtu_scene(seed: int = 0) -> DtuScene:
    """Return hills of 24 mm, scanned every 0.3 mm or so; a mesh 0.4 mm too high, with waves and a floating piece."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-12, 12, (7000, 2))
    scan = np.column_stack([xy, 12 * hills(*(xy / 12).T)])
    table = np.column_stack([rng.uniform(-12, 12, (500, 2)), np.full(500, -7.0)])  # below the plane
    vertices, faces = grid_mesh(30, 11, lambda x, y: 12 * hills(x / 12, y / 12) + 0.4 + 0.2 * np.sin(2 * x))
    piece, more = grid_mesh(2, 1.5, lambda x, y: np.full_like(x, 14.0))
    faces = np.concatenate([faces, more + len(vertices)]).astype(np.int32)
    bounds = np.array([[-14.0, -14, -10], [14, 14, 20]])
    observed = np.ones((15, 15, 16), np.uint8)
    observed[:3] = 0  # x below about -8.9 is not observed
    return DtuScene(
        np.concatenate([vertices, piece]), faces, np.concatenate([scan, table]), observed, bounds,
        np.array([0.0, 0, 1, 6]),
    )  # fmt: skip
