"""Predict the exposure of views without a photograph, from neighbouring photographs.

Automatic cameras give similar views similar exposures. The prediction is weighted by how well each training photograph
is predicted by the others (leave one out); without any gain it is the mean exposure. Test photographs are not used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.data import Scene
from gs2d.render.exposure_transform import identity

NEIGHBOURS = 5  # training photographs used by a prediction
CLOSE = 0.02  # added to distances, in extents
GREY = 0.5


def with_predicted(scene: Scene) -> Scene:
    """Return a scene with predicted exposures of test views; unchanged if training views have none."""
    if not scene.test or any("exposure" not in view.appearance for view in scene.train):
        return scene
    cameras = [view.camera for view in scene.train]
    offsets = torch.from_numpy(np.stack([view.appearance["exposure"] for view in scene.train]))
    offsets = offsets - identity(offsets)
    greys = (GREY * offsets[:, :, :3].sum(dim=2) + offsets[:, :, 3]).mean(dim=1).numpy()  # [V] offset of grey
    around = np.stack([_weights(camera, cameras, scene.extent, without=i) for i, camera in enumerate(cameras)])
    trust = _trust(around @ greys, greys)
    predicted = {}
    for view in scene.test:
        weights = _weights(view.camera, cameras, scene.extent)
        mean = (torch.from_numpy(weights)[:, None, None] * offsets).sum(dim=0)
        predicted[view.name] = {"exposure": (identity(mean) + trust * mean).numpy()}
    return scene.with_appearance(predicted)


def _trust(predicted: np.ndarray, found: np.ndarray) -> float:
    """Return the least-squares factor of a prediction over training views, each left out, clipped to [0, 1]."""
    if len(found) < 3:
        return 0.0
    return float(np.clip((predicted @ found) / max(predicted @ predicted, 1e-12), 0.0, 1.0))


def _weights(camera: Camera, cameras: Sequence[Camera], extent: float, *, without: int | None = None) -> np.ndarray:
    """Return the weights [V] of the training views in a prediction; they sum to 1."""
    if len(cameras) == 1 and without is not None:
        return np.zeros(1)
    centers = np.stack([other.center for other in cameras])
    forwards = np.stack([other.forward for other in cameras])
    distance = np.linalg.norm(centers - camera.center, axis=1) / extent + (1 - forwards @ camera.forward)
    if without is not None:
        distance[without] = np.inf
    near = np.argsort(distance, kind="stable")[: min(NEIGHBOURS, len(cameras) - (without is not None))]
    weights = np.zeros(len(cameras))
    weights[near] = 1 / (distance[near] + CLOSE) ** 2
    return np.asarray(weights / weights.sum())
