"""Cast rays of cameras at triangle meshes.

Used for the demo capture, textures, images of meshes and the visibility of surface scores. It shares no code with the
splat rasterizers, so it can verify them. Every hit is an exact ray-triangle intersection (signed volumes, as in
Pluecker tests). Candidate pairs are found on the image plane of the camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera

_PAIRS_PER_CHUNK = 60_000  # the temporaries of a chunk fit in the cache of a core
NEAR = 1e-3  # world units
_MARGIN = 1e-6  # samples around the box of a triangle, for rounding
JUMP = 3.0  # pixel footprints; a larger bend of the depth between pixels is an outline
_NO_HIT = np.uint64(0xFFFFFFFFFFFFFFFF)


@dataclass(frozen=True, eq=False)
class Hits:
    """The nearest triangle along each ray of a camera."""

    # int32 index of the triangle; -1 without a hit
    face: np.ndarray  # [H, W]
    # float32 along the optical axis (not along the ray); 0 without a hit
    depth: np.ndarray  # [H, W] world units
    # float32 barycentric coordinates of the hit; 0 without a hit
    weights: np.ndarray  # [H, W, 3]


def cast_camera(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, *, samples: int = 1, near: float = NEAR
) -> Hits:
    """Cast ``samples`` x ``samples`` rays through every pixel of a camera and keep the nearest triangle of each.

    A ray from the camera centre with direction d hits the triangle (a, b, c), in camera axes, if the three signed
    volumes d.(b x c), d.(c x a), d.(a x b) have the same sign. Divided by their sum they are the barycentric
    coordinates of the hit, and depth = a.(b x c) / sum if d has unit z (Cramer's rule). Triangles are two-sided.
    Adjacent triangles evaluate their common edge with exactly opposite values, so no ray passes between them.

    Rays are at the centres of equal sub-pixels; hits at a depth below ``near`` (world units) are ignored. The result
    has the size [height * samples, width * samples].
    """
    width, height = camera.width * samples, camera.height * samples
    local = vertices @ camera.rotation.T + camera.T_cam_world[:3, 3]  # [P, 3] in camera axes
    triangles, low, high = _sample_boxes(local, faces, camera, samples, near)
    a, b, c = (local[faces[triangles, k]] for k in range(3))
    edges = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)  # [F, 3, 3]
    volume = np.einsum("fi,fi->f", a, edges[:, 0])
    directions_x = ((np.arange(width) + 0.5) / samples - camera.cx) / camera.fx
    directions_y = ((np.arange(height) + 0.5) / samples - camera.cy) / camera.fy

    nearest = np.full(width * height, _NO_HIT, dtype=np.uint64)
    for pair_face, pair_x, pair_y in pairs(low, high):
        dx, dy = directions_x[pair_x], directions_y[pair_y]
        e = [edges[pair_face, k, 0] * dx + edges[pair_face, k, 1] * dy + edges[pair_face, k, 2] for k in range(3)]
        inside = same_sign(*e)
        total = e[0][inside] + e[1][inside] + e[2][inside]
        face = pair_face[inside]
        depth = volume[face] / np.where(total == 0, np.inf, total)
        hit = depth > near
        # Positive floats are ordered like their bits, so an integer minimum finds the nearest hit, and the lowest face
        # index of equal depths.
        key = (depth[hit].astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)) | face[hit].astype(
            np.uint64
        )
        ray = (pair_y[inside] * width + pair_x[inside])[hit]
        np.minimum.at(nearest, ray, key)
    hit = nearest != _NO_HIT
    face, depth = np.full(len(nearest), -1, np.int32), np.zeros(len(nearest), np.float32)
    weights = np.zeros((len(nearest), 3), np.float32)
    depth[hit] = (nearest[hit] >> np.uint64(32)).astype(np.uint32).view(np.float32)
    hit_rays, index = np.flatnonzero(hit), (nearest[hit] & np.uint64(0xFFFFFFFF)).astype(np.int32)
    face[hit] = triangles[index]
    for start in range(0, len(hit_rays), _PAIRS_PER_CHUNK):
        part = slice(start, start + _PAIRS_PER_CHUNK)
        rays = hit_rays[part]
        directions = np.stack([directions_x[rays % width], directions_y[rays // width], np.ones(len(rays))], axis=1)
        e = np.einsum("rki,ri->rk", edges[index[part]], directions)
        weights[rays] = e / e.sum(axis=1, keepdims=True)
    return Hits(face.reshape(height, width), depth.reshape(height, width), weights.reshape(height, width, 3))


def outlines(depth: np.ndarray, focal: float) -> np.ndarray:
    """Return the pixels at outlines, [H, W] bool: where 1 / depth, which is linear on a plane, bends.

    The depth [H, W] is 0 without a surface; ``focal`` in px.
    """
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
    bend = np.zeros_like(inverse)
    middle = inverse[:, 1:-1]
    bend[:, 1:-1] = np.abs(inverse[:, :-2] + inverse[:, 2:] - 2 * middle)
    middle = inverse[1:-1]
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(inverse[:-2] + inverse[2:] - 2 * middle))
    return np.asarray(bend * depth * focal > JUMP)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cross products [n, 3], column by column."""
    x, y, z = (a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1)))
    return np.stack([x, y, z], axis=1)


def _sample_boxes(
    local: np.ndarray, faces: np.ndarray, camera: Camera, samples: int, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the triangles [n] that may cover a sample, and their bounding boxes: first and end (x, y) [n, 2].

    Most faces of a fine mesh are between two columns or rows of samples. Bounds are rounded once per vertex.
    """
    ahead = local[:, 2] > near
    safe = np.where(ahead, local[:, 2], 1.0)
    size = camera.width * samples, camera.height * samples
    focal, center = (camera.fx, camera.fy), (camera.cx, camera.cy)
    beyond, crossing = np.arange(len(faces)), np.zeros(0, np.int64)  # faces beyond the near plane, and across it
    if not ahead.all():
        corners = sum(ahead[faces[:, k]].astype(np.int8) for k in range(3))
        beyond, crossing = np.flatnonzero(corners == 3), np.flatnonzero((corners == 1) | (corners == 2))

    def rounded(low: np.ndarray, high: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = low * samples - 0.5, high * samples - 0.5
        first, end = np.ceil(low - _MARGIN), np.floor(high + _MARGIN) + 1
        return np.clip(first, 0, most).astype(np.int32), np.clip(end, 0, most).astype(np.int32)

    bounds: list[np.ndarray] = []
    for axis in range(2):
        pixels = local[:, axis] / safe * focal[axis] + center[axis]  # [P]
        first, end = rounded(pixels, pixels, size[axis])
        a, b, c = (faces[beyond, k] for k in range(3))
        cut_first, cut_end = rounded(*_reach(local[faces[crossing]], axis, focal[axis], center[axis], near), size[axis])
        low = np.concatenate([np.minimum(np.minimum(first[a], first[b]), first[c]), cut_first])
        high = np.concatenate([np.maximum(np.maximum(end[a], end[b]), end[c]), cut_end])
        some = high > low
        beyond, crossing = beyond[some[: len(beyond)]], crossing[some[len(beyond) :]]
        bounds = [*(bound[some] for bound in bounds), low[some], high[some]]
    every = np.concatenate([beyond, crossing])
    order = np.argsort(every, kind="stable")
    x0, x1, y0, y1 = (bound[order] for bound in bounds)
    return every[order], np.stack([x0, y0], axis=1), np.stack([x1, y1], axis=1)


def _reach(corners: np.ndarray, axis: int, focal: float, center: float, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel range [n], [n] along an axis of the part of triangles [n, 3, 3] beyond the near plane.

    Triangles that cross the near plane are cut there. In a room thousands cross it, nearly all outside the image.
    """
    z = corners[:, :, 2]
    ahead = z > near
    pixels = [np.where(ahead, corners[:, :, axis] / np.where(ahead, z, 1.0), np.nan)]  # [n, 3]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        cut = ahead[:, i] != ahead[:, j]
        fraction = (near - z[:, i]) / np.where(cut, z[:, j] - z[:, i], 1.0)
        at = corners[:, i, axis] + fraction * (corners[:, j, axis] - corners[:, i, axis])
        pixels.append(np.where(cut, at / near, np.nan)[:, None])
    every = np.concatenate(pixels, axis=1) * focal + center  # [n, 6], of which three or four are not NaN
    return np.fmin.reduce(every, axis=1), np.fmax.reduce(every, axis=1)


def pairs(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield all (box, x, y) of integer boxes [low, high), in chunks of bounded size."""
    extent = np.maximum(high - low, 0)
    area = extent[:, 0] * extent[:, 1]
    boxes = np.flatnonzero(area)
    ends = np.cumsum(area[boxes])
    start = 0
    while start < len(boxes):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _PAIRS_PER_CHUNK, side="right")))
        chosen = boxes[start:stop]
        box = np.repeat(chosen, area[chosen])
        within = np.arange(len(box)) - np.repeat(ends[start:stop] - area[chosen] - done, area[chosen])
        row, column = np.divmod(within, extent[box, 0])
        yield box, low[box, 0] + column, low[box, 1] + row
        start = stop


def same_sign(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Whether three numbers are all >= 0 or all <= 0, column by column (a reduction over an axis of 3 is slow)."""
    return np.asarray(((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0)))
