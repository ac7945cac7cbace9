"""Hash the input of a training: photographs, masks, cameras, points, and depth and normal priors."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch

from gs2d.config.recipe import Recipe
from gs2d.core.text import name_bytes
from gs2d.data import Scene, View
from gs2d.data.masks import EMPTY
from gs2d.errors import DataError
from gs2d.losses.known_maps import DepthPlan, Priors, has_priors
from gs2d.losses.prior_formulas import NormalTarget
from gs2d.training.events import Notice, OnEvent, counted

DECODE_THREADS = 2


def scene_digest(scene: Scene, on_event: OnEvent, *, uses_masks: bool = False) -> str:
    """Decode every photograph and return a hash of the training input.

    Raises DataError if a photograph does not decode, or masks leave no pixel of any training view.
    """
    digest = hashlib.sha256()
    empty: list[View] = []
    train = set(map(id, scene.train))
    for view in counted(scene.preload(DECODE_THREADS), "reading photographs", len(scene.views), on_event):
        digest.update(name_bytes(f"{view.name} {'train' if id(view) in train else 'test'}"))
        mask = view.alpha() if scene.masks.masked == EMPTY else view.mask() if uses_masks else None
        empty += [view] if mask is not None and not mask.any() else []
        camera = view.camera
        arrays = [
            np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
            camera.T_cam_world,
            view.image(),
            *(mask for mask in (view.mask(), view.object_mask()) if mask is not None),
        ]
        for array in arrays:
            digest.update(f"{array.shape} {array.dtype}".encode())
            digest.update(np.ascontiguousarray(array).data)
    if empty:
        what = f"the masks of {len(empty)} of {len(scene.views)} views leave no pixel, first {empty[0].name}"
        if set(map(id, empty)) >= train:
            raise DataError(f"{scene.root}: {what}; white = keep: are the masks inverted?")
        on_event(Notice(f"{what}: these views are not used (white = keep)"))
    if scene.points is not None:
        digest.update(np.ascontiguousarray(scene.points.points).tobytes())
        if scene.points.colors is not None:
            digest.update(np.ascontiguousarray(scene.points.colors).tobytes())
    digest.update(np.float64(scene.extent).tobytes() + np.ascontiguousarray(scene.bounds, np.float64).tobytes())
    return digest.hexdigest()


def with_priors(digest: str, scene: Scene, recipe: Recipe, on_event: OnEvent) -> str:
    """Read the priors of the training views and add them to the digest of the capture, if the recipe uses any.

    Raises DataError if a map is broken, or no view has the priors of the recipe.
    """
    if not has_priors(recipe):
        return digest
    priors = Priors(scene, recipe, limit_bytes=0)
    extended = hashlib.sha256(digest.encode())
    depths = normals = 0
    views = counted(scene.train, "reading depths and normals", len(scene.train), on_event)
    for index, view in enumerate(views):
        depth, normal = priors.at(index, torch.float32)
        depths += depth is not None
        normals += normal is not None
        for array in _of_priors(view, priors.plan, normal):
            extended.update(name_bytes(f"{view.name} {array.shape} {array.dtype}"))
            extended.update(np.ascontiguousarray(array).data)
    if priors.plan is not None:
        if not depths:
            raise DataError(f"the depth maps of {scene.name} have no valid value in any training view; are they empty?")
        source = priors.plan.source
        on_event(Notice(f"depth prior ({source}): {depths} of {len(scene.train)} training views", detail=True))
    if priors.axes is not None:
        on_event(
            Notice(f"normal prior: {normals} of {len(scene.train)} training views, axes {priors.axes}", detail=True)
        )
    return extended.hexdigest()


def _of_priors(view: View, plan: DepthPlan | None, normal: NormalTarget | None) -> Sequence[np.ndarray]:
    """Return the arrays that determine the depth and normal priors of a view."""
    arrays = [] if normal is None else [normal.directions.numpy()]
    if plan is not None and plan.source != "sparse" and view.maps is not None and view.maps.files.depth is not None:
        arrays.append(view.maps.depth().values)
    if plan is not None and plan.observed is not None:
        seen = plan.observed.seen.get(view.name, np.zeros(0, dtype=np.int64))
        arrays += [values[seen] for values in (plan.observed.points, plan.observed.error, plan.observed.track)]
    return arrays
