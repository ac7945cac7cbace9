"""Move the depth of shiny surface outward, to the visual hull of the subject.

Reflections look alike in neighbouring photographs at a depth behind the surface, so training puts splats there.
Outlines do not depend on reflections: where a view shows what lies far behind the subject, there is no surface. Convex
shiny surface moves along the rays towards the cameras until views see past it, as in space carving (Kutulakos and Seitz
2000). Hollows have no outlines. Formulas: docs/math.md, "Visual hull".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.ndimage import uniform_filter

from gs2d.core.image_arrays import enlarged
from gs2d.meshing.depth_maps import DepthMap, RenderedView, Spool
from gs2d.meshing.fusion_bounds import backproject

WINDOW = 13  # cells, of the mean of a map: shiny things have spots that look matt
SHINY = 0.3  # mean from which a surface moves: 0.8 of bronze and copper have more, 0.06 of marble
PAST, FAR = 0.1, 0.13
"""Fractions of the depth. A view sees past a point if its depth is larger by PAST; less may be an error of its depth.
A point stops where enough views see past it; if they do not see FAR past it, it has only left its own flat surface, and
does not move at all."""
LEAST_PAST = 2  # views that see past a point: one may be wrong
STEP, STEPS = 0.0025, 16  # fraction of the depth; what would have to move farther is hollow, as a bowl is
HALVINGS = 2  # of the last step
REACH = 0.15  # of the depth: half the side of the window in which a surface must be convex; dents are smaller
MOST_VIEWS = 48  # that are compared, evenly chosen
COMPARED_SIDE = 800  # px: most on the shorter side of the depth maps that are compared: 4 MB each
MOVED_SIDE = 150  # px: least on the shorter side of the grid of pixels that move; those between move alike


def to_visual_hull(frames: Iterable[RenderedView], shine: Sequence[np.ndarray | None]) -> Iterator[RenderedView]:
    """Yield the frames with the depth of shiny, convex surface moved towards the cameras.

    ``shine`` has a map of each frame, [S, S] uint8 from 0 (matt) to 255; None: all is matt. Frames are stored in a
    temporary file, because each is compared with up to ``MOST_VIEWS`` others.
    """
    spool = Spool(frames)
    compared = [_compared(item) for row, item in enumerate(spool) if row % -(-len(spool) // MOST_VIEWS) == 0]
    for item, cells in zip(spool, shine, strict=True):
        depth = item.depth if cells is None else _outward(item, cells, compared)
        yield RenderedView(item.camera, depth, item.color, item.weight)


def _compared(item: DepthMap) -> DepthMap:
    """Return a depth map at a shorter side of at most ``COMPARED_SIDE``, without interpolation."""
    step = -(-min(item.depth.shape) // COMPARED_SIDE)
    camera, middle = item.camera.downscaled(step), step // 2
    depth = item.depth[middle::step, middle::step][: camera.height, : camera.width]
    return DepthMap(camera, np.ascontiguousarray(depth), None, None)


def _outward(item: DepthMap, shine: np.ndarray, views: Sequence[DepthMap]) -> np.ndarray:
    """Return the depth [H, W] of a frame with that of shiny, convex surface moved along the rays."""
    depth, camera = item.depth, item.camera
    moves = np.isfinite(depth) & (depth > 0)
    inverse = np.where(moves, 1 / np.where(moves, depth, 1), 0)  # linear in the pixels of a plane; 0: infinitely far
    size = 2 * round(REACH * camera.fx) + 1
    known = uniform_filter((depth > 0).astype(np.float32), size, mode="nearest")
    moves &= inverse * known > uniform_filter(inverse, size, mode="nearest")
    moves &= enlarged(uniform_filter(shine / 255.0, WINDOW, mode="nearest"), *depth.shape) > SHINY
    step = max(1, min(depth.shape) // MOVED_SIDE)
    rows, columns = (step * axis for axis in np.nonzero(moves[::step, ::step]))
    positions = backproject(camera, depth[rows, columns].astype(np.float64), rows, columns)
    steps = np.zeros(moves[::step, ::step].shape, np.float32)
    steps[rows // step, columns // step] = _steps(positions, STEP * (camera.center - positions), views)
    steps = steps.repeat(step, axis=0).repeat(step, axis=1)[: len(depth), : depth.shape[1]]
    return np.where(moves, depth * (1 - STEP * steps), depth)


def _steps(positions: np.ndarray, step: np.ndarray, views: Sequence[DepthMap]) -> np.ndarray:
    """Return the number of steps [M] that positions [M, 3] take before views see past them; 0 if none do."""
    steps, waiting = np.zeros(len(positions)), np.arange(len(positions))
    for taken in range(STEPS + 1):
        stops, far = _seen_past(positions[waiting] + taken * step[waiting], views)
        steps[waiting[far]] = taken
        waiting = waiting[~stops]
    rows = np.flatnonzero(steps)
    least, most = steps[rows] - 1, steps[rows]
    for _ in range(HALVINGS):
        middle = (least + most) / 2
        stops, _ = _seen_past(positions[rows] + middle[:, None] * step[rows], views)
        least, most = np.where(stops, least, middle), np.where(stops, middle, most)
    steps[rows] = least
    return steps


def _seen_past(positions: np.ndarray, views: Sequence[DepthMap]) -> tuple[np.ndarray, np.ndarray]:
    """Return where enough views see past positions [M, 3], and where they also see far past them, bool [M] each."""
    past, far = np.zeros((2, len(positions)), np.int64)
    for view in views:
        rows, z, at = _shown(view, positions)
        past[rows] += view.depth[at] > (1 + PAST) * z
        far[rows] += view.depth[at] > (1 + FAR) * z
    return past >= LEAST_PAST, far >= LEAST_PAST


def _shown(view: DepthMap, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return which positions [M, 3] are inside an image, their depths, and the rows and columns of their pixels."""
    pixels, z = view.camera.project(positions)
    inside = (z > 0) & (pixels >= 0).all(axis=1) & (pixels < (view.camera.width, view.camera.height)).all(axis=1)
    rows = np.flatnonzero(inside)
    column, row = pixels[rows].astype(np.int64).T
    return rows, z[rows], (row, column)
