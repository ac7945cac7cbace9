"""Exposure differences between images, from the colours of sparse points, before training.

A point in images k and l has colours g_k c and g_l c with channel gains g. The logarithms of gains and colours are
fitted alternately. Robust weights suppress points whose colours change for other reasons (highlights, wrong matches).
"""

from __future__ import annotations

import numpy as np

from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.scene import Scene, View

HALF = 2  # px: colours are means of patches of 5x5
DARKEST, BRIGHTEST = 0.03, 0.97  # patches beyond are noisy or clipped
OUTLIER = 0.1  # residual of the logarithm that halves the weight
ROUNDS = 30
MIN_COLORS = 30  # an image with fewer colours has gains of 1
MIN_TRACK = 3


def point_gains(scene: Scene) -> np.ndarray | None:
    """Return the gains of the training images and channels [V, 3]; their geometric mean over photographs is 1.

    None if the capture does not say which points the images show.
    """
    observed = scene.observed(guessed=False)
    if observed is None:
        return None
    photographs = {view: index for index, view in enumerate(dict.fromkeys(view.whole or view for view in scene.train))}
    of_view = [photographs[view.whole or view] for view in scene.train]
    views, points, values = [], [], []
    for index, view in zip(of_view, scene.train, strict=True):
        rows, colors = _colors(view, observed)
        views.append(np.full(len(rows), index))
        points.append(rows)
        values.append(np.log(colors))
    logs = np.concatenate(values)
    return _fitted(np.concatenate(views), np.concatenate(points), logs, len(photographs))[of_view]


def _colors(view: View, observed: ObservedPoints) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows [M] of points that a view shows well, and their colours [M, 3] in (0, 1)."""
    camera = view.camera
    rows = observed.by_view.get(view.name, np.zeros(0, dtype=np.int64))
    rows = rows[(observed.track[rows] >= MIN_TRACK) & np.isfinite(observed.points[rows]).all(axis=1)]
    pixels, depth = camera.project(observed.points[rows])
    column, row = np.floor(pixels).astype(np.int64).T
    inside = (depth > 0) & (column >= HALF) & (row >= HALF)
    inside &= (column < camera.width - HALF) & (row < camera.height - HALF)
    image, mask = view.target((0.0, 0.0, 0.0)), view.mask()
    column, row, rows = column[inside], row[inside], rows[inside]
    offsets = range(-HALF, HALF + 1)
    patches = np.stack([image[row + i, column + j] for i in offsets for j in offsets])  # [25, M, 3]
    colors = patches.mean(axis=0)
    good = ((colors > DARKEST) & (colors < BRIGHTEST)).all(axis=1)
    if mask is not None:
        good &= mask[row, column]
    return rows[good], colors[good].astype(np.float64)


def _fitted(views: np.ndarray, points: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the gains of ``count`` views from the logarithms [M, 3] of point colours."""
    if len(values) == 0:
        return np.ones((count, 3))
    _, points = np.unique(points, return_inverse=True)
    logs, weights = np.zeros((count, 3)), np.ones(len(values))
    for _ in range(ROUNDS):
        colors = _means(points, values - logs[views], weights, int(points.max()) + 1)
        residual = values - colors[points]
        logs = _means(views, residual, weights, count)
        logs[np.bincount(views, minlength=count) < MIN_COLORS] = 0.0
        logs -= logs.mean(axis=0)
        error = np.abs(residual - logs[views]).mean(axis=1)
        weights = 1 / (1 + (error / OUTLIER) ** 2)
    return np.exp(logs)


def spread(gains: np.ndarray) -> float:
    """Return the standard deviation over images of the logarithm of the mean gain of the channels."""
    return float(np.log(gains).mean(axis=1).std())


def _means(groups: np.ndarray, values: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return weighted means [count, 3] of values [M, 3] by group; 0 for empty groups."""
    total = np.maximum(np.bincount(groups, weights, minlength=count), 1e-12)
    return np.stack([np.bincount(groups, weights * v, minlength=count) / total for v in values.T], axis=1)
