"""Neighbours of training views for the multi-view losses, their images, and the random choices of an iteration.

Nothing here is part of the state. Neighbours follow from the cameras; the choices of an iteration follow from the seed,
the stage and the iteration. So a resumed or repeated iteration makes the same choices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gs2d.config.multiview import MultiView
from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera
from gs2d.core.memory_limit import cache_bytes
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError
from gs2d.losses.view_pair import PatchImage, prepare_image
from gs2d.training.targets import Target

PATCH_BYTES = 1 << 29  # limit for prepared images
SAMPLES = 2000  # points that estimate the distance of the scene from a camera


def find_neighbours(scene: Scene, settings: MultiView) -> tuple[tuple[int, ...], ...]:
    """Return the indices of the neighbours of each training view, nearest first.

    Raises
    ------
    DataError
        If no view has a neighbour.
    """
    cameras = [view.camera for view in scene.train]
    points = _sample_points(scene)
    centers = np.stack([camera.center for camera in cameras])
    forwards = np.stack([camera.forward for camera in cameras])
    min_cosine = np.cos(np.radians(settings.max_angle))
    found = []
    for camera in cameras:
        reach = _distance_of(camera, points, scene.extent)
        baselines = np.linalg.norm(centers - camera.center, axis=1) / reach
        fits = (baselines >= settings.min_baseline) & (baselines <= settings.max_baseline) & (baselines > 0)
        fits &= forwards @ camera.forward >= min_cosine - 1e-9
        order = np.argsort(baselines, kind="stable")
        found.append(tuple(int(i) for i in order[fits[order]][: settings.neighbours]))
    if not any(found):
        raise DataError(
            f"no training view of {scene.name} has a neighbour within multiview.max_angle = {settings.max_angle:g} "
            f"degrees and baselines of {settings.min_baseline:g} to {settings.max_baseline:g} of the distance; "
            "take a recipe without multiview, or --set multiview.max_angle=..."
        )
    return tuple(found)


def _sample_points(scene: Scene) -> np.ndarray:
    """Return points [P, 3] of the scene: some of its sparse points, else random ones in its bounds."""
    if scene.points is not None and len(scene.points) > 0:
        points = np.asarray(scene.points.points, dtype=np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        return points[:: max(1, len(points) // SAMPLES)]
    unit = np.random.Generator(np.random.Philox(0)).random((SAMPLES, 3))
    return np.asarray(scene.bounds[0] + unit * (scene.bounds[1] - scene.bounds[0]))


def _distance_of(camera: Camera, points: np.ndarray, extent: float) -> float:
    """Return the median depth of the points in the image of a camera, or the extent if there are none."""
    pixels, depth = camera.project(points)
    inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= (camera.width, camera.height)).all(axis=1)
    return float(np.median(depth[inside])) if inside.any() else extent


@dataclass(frozen=True)
class NeighbourDraw:
    """Random choices of an iteration: the neighbour of its view, and a number in [0, 1) for each patch."""

    neighbour: int
    draws: torch.Tensor


def draw_turn(
    recipe: Recipe, stage: int, iteration: int, neighbours: tuple[int, ...], settings: MultiView
) -> NeighbourDraw | None:
    """Return the choices of an iteration (from 1) of a stage; None for a view without neighbours."""
    if not neighbours:
        return None
    generator = np.random.Generator(np.random.Philox(key=[recipe.seed, (stage << 40) + iteration]))
    neighbour = neighbours[int(generator.integers(len(neighbours)))]
    return NeighbourDraw(neighbour, torch.from_numpy(generator.random(settings.patches)))


class ImageFiles:
    """Training images prepared for patch comparison; the first that fit in ``limit_bytes`` are kept."""

    def __init__(self, views: tuple[View, ...], settings: MultiView, *, limit_bytes: int = PATCH_BYTES) -> None:
        self._views, self._settings, self._room = views, settings, cache_bytes(limit_bytes)
        self._kept: dict[int, PatchImage] = {}

    def of(self, index: int, target: Target) -> PatchImage:
        """Return the prepared image of view ``index`` with the given target."""
        kept = self._kept.get(index)
        if kept is not None:
            return kept
        alpha, usable = self._views[index].alpha(), target.mask
        if alpha is not None:
            opaque = torch.as_tensor(alpha >= 1).to(target.image.device, non_blocking=True)
            usable = opaque if usable is None else usable & opaque
        made = prepare_image(target.image, usable, self._settings)
        if made.nbytes <= self._room:
            self._kept[index] = made
            self._room -= made.nbytes
        return made
