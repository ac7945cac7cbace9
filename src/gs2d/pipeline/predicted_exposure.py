"""The exposure that a view nobody photographed would have: what photographs taken nearby say.

A camera on automatic chooses by what it sees, so photographs of nearly the same view have nearly the same exposure. How
far that holds is asked of the training photographs themselves, each predicted from the others (leave one out): where
neighbours say nothing, the prediction is the mean exposure. No test photograph is looked at.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.data import Scene
from gs2d.pipeline.exposure import Transforms
from gs2d.render.exposure import identity

NEIGHBOURS = 5  # training photographs that a prediction is made of
CLOSE = 0.02  # added to distances, in extents: poses are never quite the same, and one photograph is no mean
GREY = 0.5


def with_predicted(transforms: Transforms, scene: Scene) -> Transforms:
    """Return the transforms of training photographs with predicted ones of the test views, by name.

    Parameters
    ----------
    transforms : mapping of name to Tensor [3, 4]
        Of the training photographs; empty where a run learns none, and then nothing is added.
    scene : Scene
    """
    if not transforms or not scene.test:
        return transforms
    cameras = [view.camera for view in scene.train]
    offsets = torch.stack([transforms[view.name] for view in scene.train]).double()
    offsets = offsets - identity(offsets)
    trust = _trust(cameras, offsets, scene.extent)
    predicted = dict(transforms)
    for view in scene.test:
        weights = _weights(view.camera, cameras, scene.extent)
        mean = (torch.from_numpy(weights)[:, None, None] * offsets).sum(dim=0)
        predicted[view.name] = (identity(mean) + trust * mean).to(transforms[scene.train[0].name])
    return predicted


def _trust(cameras: Sequence[Camera], offsets: torch.Tensor, extent: float) -> float:
    """How much of a prediction to believe, in [0, 1]: the least-squares factor over training views, each left out."""
    if len(cameras) < 3:
        return 0.0
    greys = (GREY * offsets[:, :, :3].sum(dim=2) + offsets[:, :, 3]).mean(dim=1).numpy()  # [V] what grey gains
    predicted = np.array(
        [_weights(camera, cameras, extent, without=index) @ greys for index, camera in enumerate(cameras)]
    )
    return float(np.clip((predicted @ greys) / max(predicted @ predicted, 1e-12), 0.0, 1.0))


def _weights(camera: Camera, cameras: Sequence[Camera], extent: float, *, without: int | None = None) -> np.ndarray:
    """Weights [V] of the training views in a prediction; they sum to 1."""
    centers = np.stack([other.center for other in cameras])
    forwards = np.stack([other.forward for other in cameras])
    distance = np.linalg.norm(centers - camera.center, axis=1) / extent + (1 - forwards @ camera.forward)
    if without is not None:
        distance[without] = np.inf
    near = np.argsort(distance, kind="stable")[: min(NEIGHBOURS, len(cameras) - (without is not None))]
    weights = np.zeros(len(cameras))
    weights[near] = 1 / (distance[near] + CLOSE) ** 2
    return np.asarray(weights / weights.sum())
