"""Where a surface is wrong: point clouds coloured by distance (PLY), and a picture of both (PNG)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from gs2d.core.images import write_image
from gs2d.io.ply_format import write_ply

GOOD, NEAR, FAR, OUT = (40, 150, 80), (235, 200, 60), (200, 40, 40), (150, 150, 160)
PRECISION, RECALL, IMAGE = "precision.ply", "recall.ply", "surface.png"
_SIDE = 320  # px of one panel
_FEW = 50_000  # points


@dataclass(frozen=True, eq=False)
class ScoredClouds:
    """Points of both sides with the distance to the other one, in one frame.

    Attributes
    ----------
    mesh, truth : ndarray [P, 3], [Q, 3]
    mesh_distances, truth_distances : ndarray [P], [Q]
    tau : float
        The distance that counts as right, in the same units.
    """

    mesh: np.ndarray
    mesh_distances: np.ndarray
    truth: np.ndarray
    truth_distances: np.ndarray
    tau: float


def distance_colors(distances: np.ndarray, tau: float) -> np.ndarray:
    """Colours [P, 3] uint8: green up to tau, then from yellow to red at 5 tau and beyond; grey where infinite."""
    t = np.clip((np.where(np.isfinite(distances), distances, 0) / tau - 1) / 4, 0, 1)[:, None]
    colors = (1 - t) * np.array(NEAR) + t * np.array(FAR)
    colors[distances < tau] = GOOD
    colors[~np.isfinite(distances)] = OUT
    return np.rint(colors).astype(np.uint8)


def write_clouds(folder: Path, clouds: ScoredClouds) -> dict[str, str]:
    """Write ``precision.ply`` (the reconstruction), ``recall.ply`` (the truth) and ``surface.png``; returns the names.

    Raises
    ------
    DiskError
    """
    for name, points, distances in (
        (PRECISION, clouds.mesh, clouds.mesh_distances),
        (RECALL, clouds.truth, clouds.truth_distances),
    ):
        rows = np.empty(len(points), [(c, "<f4") for c in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
        colors = distance_colors(distances, clouds.tau)
        for i in range(3):
            rows["xyz"[i]] = points[:, i]
            rows[("red", "green", "blue")[i]] = colors[:, i]
        write_ply(folder / name, {"vertex": rows})
    write_image(folder / IMAGE, draw_clouds(clouds))
    return {"precision_cloud": PRECISION, "recall_cloud": RECALL, "picture": IMAGE}


def draw_clouds(clouds: ScoredClouds) -> np.ndarray:
    """Both clouds seen along x, y and z, uint8 [2 side, 3 side, 3]: above the reconstruction, below the truth.

    The frame is the truth's, a little widened: what floats far away must not shrink the rest to a dot.
    """
    inside = clouds.truth if len(clouds.truth) else clouds.mesh
    low, high = (inside.min(axis=0), inside.max(axis=0)) if len(inside) else (np.zeros(3), np.ones(3))
    size = 1.1 * max(float((high - low).max()), 1e-12)
    low = (low + high - size) / 2
    rows = []
    for points, distances in ((clouds.mesh, clouds.mesh_distances), (clouds.truth, clouds.truth_distances)):
        colors = distance_colors(distances, clouds.tau)
        rows.append(np.concatenate([_panel(points, colors, axis, low, size) for axis in range(3)], axis=1))
    image = Image.fromarray(np.concatenate(rows))
    draw = ImageDraw.Draw(image)
    for row, (word, distances) in enumerate((("precision", clouds.mesh_distances), ("recall", clouds.truth_distances))):
        fraction = f"{(distances < clouds.tau).mean():.3f}" if len(distances) else "nothing"
        for column, axis in enumerate("xyz"):
            text = f"{word} {fraction} within {clouds.tau:g}" if column == 0 else ""
            draw.text((column * _SIDE + 6, row * _SIDE + 4), f"along {axis}  {text}", fill=(0, 0, 0))
    return np.asarray(image)


def _panel(points: np.ndarray, colors: np.ndarray, axis: int, low: np.ndarray, size: float) -> np.ndarray:
    """Points as pixels (few points: as 2x2), seen along an axis; where several fall on one pixel, their mean colour."""
    across, up = [i for i in range(3) if i != axis]
    column, row = (np.floor((points[:, i] - low[i]) / size * _SIDE).astype(np.int64) for i in (across, up))
    dots = [(0, 0), (1, 0), (0, 1), (1, 1)] if len(points) < _FEW else [(0, 0)]
    column, row = (np.concatenate([values + dot[i] for dot in dots]) for i, values in enumerate((column, row)))
    colors = np.tile(colors, (len(dots), 1))
    shown = (column >= 0) & (column < _SIDE) & (row >= 0) & (row < _SIDE)
    at, colors = ((_SIDE - 1 - row) * _SIDE + column)[shown], colors[shown]
    count = np.bincount(at, minlength=_SIDE * _SIDE)
    panel = np.full((_SIDE * _SIDE, 3), 255.0)
    hit = count > 0
    for i in range(3):
        panel[hit, i] = np.bincount(at, weights=colors[:, i], minlength=_SIDE * _SIDE)[hit] / count[hit]
    return np.rint(panel).astype(np.uint8).reshape(_SIDE, _SIDE, 3)
