"""Start points on the depth maps of a capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from gs2d.config.recipe import Recipe
from gs2d.data.scene import PointCloud, Scene
from gs2d.losses.prior_formulas import MetricDepth
from gs2d.losses.priors import Priors, rays


def with_prior_points(scene: Scene, recipe: Recipe) -> Scene:
    """Return the scene with points on its depth maps, if the recipe has a depth prior that adds them.

    They are the points of about ``init_points`` random pixels of all training views. Splats move only a few percent of
    the extent, so walls far from any sparse point need splats to start from. The normals are those of planes through
    neighbouring points of a map; randomly rotated splats would form a thick layer.
    """
    settings = recipe.depth_prior
    if settings is None or not settings.start:
        return scene
    priors = Priors(scene, replace(recipe, normal_prior=None), limit_bytes=0)
    rng = np.random.Generator(np.random.Philox(key=recipe.seed))
    points, colors, normals = [], [], []
    for index, view in enumerate(scene.train):
        depths = priors.at(index, torch.float64)[0]
        if not isinstance(depths, MetricDepth):
            continue
        mask, alpha = view.mask(), view.alpha()
        usable = depths.valid.numpy() & (True if mask is None else mask) & (True if alpha is None else alpha >= 0.5)
        pixels = np.flatnonzero(usable)
        fraction = recipe.init_points // len(scene.train) + 1
        pixels = np.sort(rng.choice(pixels, min(fraction, len(pixels)), replace=False))
        rows, columns = np.unravel_index(pixels, usable.shape)
        local = rays(view)[rows, columns] / depths.disparity.numpy()[rows, columns, None]
        points.append((local - view.camera.T_cam_world[:3, 3]) @ view.camera.rotation)
        colors.append(view.image()[rows, columns, :3])
        normals.append(plane_normals(points[-1]))  # within one map, because maps may contradict each other
    if not any(map(len, points)):
        return scene
    if scene.points is not None:
        grey = np.full((len(scene.points), 3), 128, dtype=np.uint8)
        points.append(scene.points.points)
        colors.append(grey if scene.points.colors is None else scene.points.colors)
        normals.append(np.zeros_like(scene.points.points))
    places = np.concatenate(points)
    sizes = np.zeros(len(places))
    if scene.points is not None and scene.points.sizes is not None:
        sizes[-len(scene.points) :] = scene.points.sizes
    return replace(scene, points=PointCloud(places, np.concatenate(colors), np.concatenate(normals), sizes))


def plane_normals(points: np.ndarray, neighbours: int = 16) -> np.ndarray:
    """Fit unit normals [P, 3] of planes through the nearest points of each point [P, 3]; 0 where too few."""
    if len(points) < neighbours:
        return np.zeros_like(points)
    near = points[cKDTree(points).query(points, k=neighbours)[1]]  # [P, k, 3]
    near = near - near.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(near.swapaxes(1, 2) @ near)[1][:, :, 0])
