"""Depth range of the plane sweep, and the points that views share.

Both follow from the sparse points, if there are any. Otherwise they follow from a grid of points in the bounds of the
scene: those that two images show and, with an alpha channel, that lie in all silhouettes (the visual hull).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F

from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError

GRID = 48  # points along each side of the bounds
MAX_PLACES = 2000  # evenly chosen grid points that views may share
TRACK = 3  # track length of a grid point: ObservedPoints ignores shorter ones


@dataclass(frozen=True, eq=False)
class SweepRange:
    """Depth range of each view."""

    observed: ObservedPoints  # sparse points or grid points, and which views show them
    # Near and far, world units, by name of the view; empty if the sparse points define the range.
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def sweep_range(scene: Scene) -> SweepRange:
    """Return the depth range of the training views of a scene.

    Raises DataError if no two training views show a point in the bounds of the scene.
    """
    observed = scene.observed()
    return _range_of_bounds(scene) if observed is None else SweepRange(observed)


def _range_of_bounds(scene: Scene) -> SweepRange:
    bounds = np.asarray(scene.bounds, dtype=np.float64)
    sides = bounds[1] - bounds[0]
    if not (np.isfinite(bounds).all() and (sides > 0).all()):
        raise DataError(
            f"a plane sweep without sparse points needs the bounds of {scene.name}, got {bounds.tolist()}; "
            "train with --set dense_start=null"
        )
    cell = sides / GRID
    ticks = [bounds[0][k] + (np.arange(GRID) + 0.5) * cell[k] for k in range(3)]
    places = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    half = 0.5 * float(np.linalg.norm(cell))
    for view in scene.train:  # each view carves the remaining points
        places = places[~_shows(view, places, half)[1]]
    inside = np.stack([_shows(view, places, half)[0] for view in scene.train])
    shared = inside.sum(axis=0) >= 2
    if not shared.any():
        raise DataError(
            f"a plane sweep of {scene.name} needs points in its bounds that two images show, inside the "
            "silhouettes of those with an alpha channel, got none; train with --set dense_start=null"
        )
    places, inside = places[shared], inside[:, shared]
    limits = {}
    for index, view in enumerate(scene.train):
        z = view.camera.project(places[inside[index]])[1]
        if len(z):
            least = max(float(z.min()) - half, 0.02 * float(z.max()))  # a camera may stand in the box
            limits[view.name] = (least, float(z.max()) + half)
    step = max(1, len(places) // MAX_PLACES)
    chosen, inside = places[::step], inside[:, ::step]
    visible = {view.name: np.flatnonzero(inside[index]) for index, view in enumerate(scene.train)}
    track = np.full(len(chosen), TRACK)
    return SweepRange(ObservedPoints(chosen, np.zeros(len(chosen)), track, visible, "points in the bounds"), limits)


def _shows(view: View, places: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which points lie in an image and its silhouette, and which lie in the image outside the silhouette.

    The silhouette is widened by ``half``, half the diagonal of a grid cell.
    """
    camera = view.camera
    pixels, depth = camera.project(places)
    inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    alpha = view.alpha()
    if alpha is None or not inside.any():
        return inside, np.zeros(len(places), dtype=bool)
    reach = int(np.ceil(half * max(camera.fx, camera.fy) / float(np.median(depth[inside]))))
    solid = torch.from_numpy((alpha >= 0.5).astype(np.float32))[None]
    for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        solid = F.max_pool2d(solid, size, 1, (size[0] // 2, size[1] // 2))
    column, row = (np.clip(np.where(inside, pixels[:, k], 0), 0, None).astype(np.int64) for k in (0, 1))
    within = (solid[0].numpy() > 0)[row, column]
    return inside & within, inside & ~within
