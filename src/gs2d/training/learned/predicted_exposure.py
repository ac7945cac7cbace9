"""Predict the exposure of views without a photograph, from neighbouring photographs and the brightness of the view.

Automatic cameras give similar views similar exposures, and bright views shorter ones: the logarithm of the exposure
falls linearly with that of the brightness of the rendered scene. Both predictors are weighted by how well they predict
each training photograph from the others (leave one out); without any gain the prediction is the mean exposure. Test
photographs are not used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.data.scene import Scene, View
from gs2d.render.exposure_transform import identity

NEIGHBOURS = 5  # training photographs used by a prediction
CLOSE = 0.02  # added to distances, in extents
GREY = 0.5
MAX_VARIANCE = 0.9  # brightness is used if its residual variance is below this times that of neighbours
ENOUGH = 8  # training photographs to fit a line
DARK = 0.02  # added to a brightness before its logarithm
LEAST_GAIN = 0.05


def predicted_exposures(scene: Scene, brightness: Callable[[View], float] | None = None) -> dict[str, np.ndarray]:
    """Return predicted exposures [3, 4] of test views by name; none if a training view has none.

    The scene has the learned appearance of its training views. Without the ``brightness`` of views only neighbours are
    used.
    """
    if not scene.test or any("exposure" not in view.appearance for view in scene.train):
        return {}
    cameras = [view.camera for view in scene.train]
    offsets = torch.from_numpy(np.stack([view.appearance["exposure"] for view in scene.train]))
    offsets = offsets - identity(offsets)
    greys = (GREY * offsets[:, :, :3].sum(dim=2) + offsets[:, :, 3]).mean(dim=1).numpy()  # [V] offset of grey
    around = np.stack([_weights(camera, cameras, scene.extent, without=i) for i, camera in enumerate(cameras)])
    trust = _trust(around @ greys, greys)
    meter = None
    if brightness is not None and len(cameras) >= ENOUGH:
        measured = np.array([brightness(view) for view in scene.train])
        meter = _Meter.fitted(measured, 1 + greys / GREY, around, trust)
    exposures = {}
    for view in scene.test:
        weights = _weights(view.camera, cameras, scene.extent)
        mean = (torch.from_numpy(weights)[:, None, None] * offsets).sum(dim=0)
        transform = identity(mean) + trust * mean
        if meter is not None and brightness is not None:
            own = 1 + float((GREY * transform[:, :3].sum(dim=1) + transform[:, 3] - GREY).mean()) / GREY
            transform = transform * (meter.gain(brightness(view), weights) / max(own, LEAST_GAIN))
        exposures[view.name] = transform.numpy()
    return exposures


@dataclass(frozen=True)
class _Meter:
    """Automatic exposure: log gain = level + slope (log brightness - middle), plus residuals of neighbours."""

    level: float
    slope: float
    middle: float
    residuals: np.ndarray  # [V] log gains minus the line, of the training views
    trust: float  # in the residuals of neighbours

    def gain(self, brightness: float, weights: np.ndarray) -> float:
        """Return the gain of a view from its brightness and the weights [V] of its neighbours."""
        line = self.level + self.slope * (np.log(max(brightness, 0.0) + DARK) - self.middle)
        return float(np.exp(line + self.trust * (weights @ self.residuals)))

    @classmethod
    def fitted(cls, brightness: np.ndarray, gains: np.ndarray, around: np.ndarray, trust: float) -> _Meter | None:
        """Fit the line to training views; None if it predicts no better than neighbours alone.

        ``brightness`` and ``gains`` are [V]; ``around`` [V, V] are the weights of the others in a prediction of each;
        ``trust`` is that in neighbours alone.
        """
        x, y = np.log(np.maximum(brightness, 0.0) + DARK), np.log(np.maximum(gains, LEAST_GAIN))
        middle, level = float(x.mean()), float(y.mean())
        spread = float(((x - middle) ** 2).sum())
        if spread <= 1e-9:
            return None
        slope = min(0.0, float(((x - middle) * (y - level)).sum()) / spread)  # more light: a shorter exposure
        leverage = 1 / len(x) + (x - middle) ** 2 / spread
        residuals = y - level - slope * (x - middle)
        left_out = residuals / np.maximum(1 - leverage, 1e-6)  # from the line fitted to the other views
        own = _trust(around @ residuals, residuals)
        residual = np.mean((left_out - own * (around @ residuals)) ** 2)
        by_neighbours = np.mean((y - trust * (around @ y)) ** 2)
        return cls(level, slope, middle, residuals, own) if residual < MAX_VARIANCE * by_neighbours else None


def _trust(predicted: np.ndarray, actual: np.ndarray) -> float:
    """Return the least-squares factor of a prediction over training views, each left out, clipped to [0, 1]."""
    if len(actual) < 3:
        return 0.0
    return float(np.clip((predicted @ actual) / max(predicted @ predicted, 1e-12), 0.0, 1.0))


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
