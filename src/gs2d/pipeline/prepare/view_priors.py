"""What is known beforehand of the views of a run, read once and said before anything is trained."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch

from gs2d.config.recipe import Recipe
from gs2d.core.text import name_bytes
from gs2d.data import Scene, View
from gs2d.errors import DataError
from gs2d.losses.priors import Depths, MetricDepth, NormalTarget, PointDepths
from gs2d.training.events import Notice, OnEvent, Phase, Step
from gs2d.training.priors import DepthPlan, Priors, has_priors


def with_priors(digest: str, scene: Scene, recipe: Recipe, on_event: OnEvent) -> str:
    """Read all that is known of the training views, say what it is, and add it to the digest of the capture.

    The digest as it is for a recipe that asks for nothing.

    Raises
    ------
    DataError
        A map that is none, or nothing of what the recipe asks for.
    """
    if not has_priors(recipe):
        return digest
    priors = Priors(scene, recipe, limit_bytes=0)
    whole = hashlib.sha256(digest.encode())
    on_event(Phase("reading what is known beforehand", len(scene.train)))
    depths: list[Depths] = []
    normals = 0
    for done, view in enumerate(scene.train, start=1):
        depth, normal = priors.at(done - 1, torch.float32)
        depths += [] if depth is None else [depth]
        normals += normal is not None
        for array in _arrays(view, priors.plan, normal):
            whole.update(name_bytes(f"{view.name} {array.shape} {array.dtype}"))
            whole.update(np.ascontiguousarray(array).data)
        on_event(Step(done))
    if priors.plan is not None:
        if not depths:
            raise DataError(f"the depth maps of {scene.name} leave nothing known in any training view; are they empty?")
        on_event(Notice(depth_text(priors.plan, depths, len(scene.train)), detail=True))
    if priors.axes is not None:
        line = f"known normals: {normals} of {len(scene.train)} training views, axes {priors.axes}"
        on_event(Notice(line, detail=True))
    return whole.hexdigest()


def _arrays(view: View, plan: DepthPlan | None, normal: NormalTarget | None) -> Sequence[np.ndarray]:
    """Return what decides the known depths and normals of a view."""
    arrays = [] if normal is None else [normal.directions.numpy()]
    if plan is not None and plan.source != "sparse" and view.maps is not None and view.maps.files.depth is not None:
        arrays.append(view.maps.depth().values)
    if plan is not None and plan.observed is not None:
        seen = plan.observed.seen.get(view.name, np.zeros(0, dtype=np.int64))
        arrays += [values[seen] for values in (plan.observed.points, plan.observed.error, plan.observed.track)]
    return arrays


def depth_text(plan: DepthPlan, depths: Sequence[Depths], views: int) -> str:
    """Return what is known, in words."""
    of_views = f"{len(depths)} of {views} training views"
    points = [len(depth.depth) for depth in depths if isinstance(depth, PointDepths)]
    if points:
        return f"known depths: {int(np.median(points)):,} sparse points in the middle one of {of_views}"
    fractions = [float(depth.valid.float().mean()) for depth in depths if not isinstance(depth, PointDepths)]
    pixels = f"{of_views}, {np.mean(fractions):.0%} of their pixels"
    if plan.source == "sensor":
        unit = "" if plan.unit is None else f"; a value of 1 is {plan.unit:.4g} units of the capture"
        return f"known depths: maps of a sensor in {pixels}{unit}"
    fitted = sum(isinstance(depth, MetricDepth) for depth in depths)
    rest = len(depths) - fitted
    to = [f"sparse points in {fitted} views"] * (fitted > 0) + [f"what is rendered in {rest}"] * (rest > 0)
    return f"known depths: relative maps ({plan.space}) in {pixels}; scale and shift by {', by '.join(to)}"
