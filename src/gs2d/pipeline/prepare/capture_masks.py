"""What the masks of a capture change before training: the protocol, and the points that it starts from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gs2d.config.protocols import Protocol
from gs2d.data import Scene
from gs2d.data.masks import EMPTY
from gs2d.data.scene import PointCloud, View
from gs2d.pipeline.events import Notice, OnEvent


def with_masks(protocol: Protocol, scene: Scene, on_event: OnEvent) -> Protocol:
    """Return the protocol under which the scene's masks are what the user says; one that passes them over is told."""
    masks = scene.masks
    if not masks.found or masks.masked == EMPTY or protocol.use_mask_in_training:
        return protocol
    if masks.asked_for:
        return replace(protocol, use_mask_in_training=True, use_mask_in_fusion=True)
    on_event(Notice(f"the protocol {protocol.name} trains on masked pixels too (--masked ignore leaves them out)"))
    return protocol


def without_masked_points(scene: Scene, protocol: Protocol, on_event: OnEvent) -> Scene:
    """Return the scene without the sparse points that training photographs show in masked pixels alone.

    Nothing would ever move or prune splats there.
    """
    points, masks = scene.points, scene.masks
    if not masks.found or points is None:
        return scene
    if masks.masked != EMPTY and not protocol.use_mask_in_training:
        return scene
    observed = scene.observed()
    if observed is None or len(observed.points) != len(points):
        return scene
    masked, kept = np.zeros((2, len(points)), dtype=np.int64)
    for view in scene.train:
        rows = observed.seen.get(view.name)
        if rows is None or not len(rows):
            continue
        shown = _kept_pixels(view)
        pixels, depth = view.camera.project(observed.points[rows])
        with np.errstate(invalid="ignore"):
            column, row = (
                np.floor(pixels[:, k]).clip(0, size - 1) for k, size in ((0, shown.shape[1]), (1, len(shown)))
            )
        there = (depth > 0) & np.isfinite(pixels).all(axis=1)
        keeps = shown[row[there].astype(np.int64), column[there].astype(np.int64)]
        np.add.at(kept, rows[there][keeps], 1)
        np.add.at(masked, rows[there][~keeps], 1)
    out = (masked > 0) & (kept == 0)
    if not out.any() or out.all():
        return scene
    line = f"{int(out.sum()):,} of {len(points):,} sparse points lie in masked pixels alone: left out"
    on_event(Notice(line, detail=True))
    return replace(scene, points=_rows(points, ~out))


def _kept_pixels(view: View) -> np.ndarray:
    """Return where a mask keeps a photograph, [H, W] bool; the rim that undistortion leaves counts as kept."""
    kept = np.ones((view.camera.height, view.camera.width), dtype=bool)
    mask, valid, alpha = view.mask(), view.valid(), view.alpha()
    if mask is not None:
        kept &= mask if valid is None else mask | ~valid
    return kept if alpha is None else kept & (alpha >= 0.5)


def _rows(points: PointCloud, rows: np.ndarray) -> PointCloud:
    colors, normals, sizes = (None if a is None else a[rows] for a in (points.colors, points.normals, points.sizes))
    return PointCloud(points.points[rows], colors, normals, sizes)
