"""Lighting of the demo scene: sky with occlusion, an area lamp with soft shadows, highlights and texture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from gs2d.contrib.demo.demo_scene import ToyScene
from gs2d.contrib.demo.shapes import Patch
from gs2d.meshing.raycast import Hits, pairs, same_sign

LAMP = np.array([-0.70, -0.55, 1.0]) / np.linalg.norm([-0.70, -0.55, 1.0])  # unit, towards the lamp
_LAMP_COLOR = np.array([1.80, 1.62, 1.36])
_LAMP_SPREAD = 0.16  # half-angle of the lamp, radians
_LIFT = 2e-3  # world units, offset of shadow rays from the surface


@dataclass(frozen=True, eq=False)
class BakedLight:
    """View-independent light at each vertex."""

    sky: np.ndarray  # [P, 3] irradiance from sky and ground, divided by pi; 1 is an open, white, upward-facing patch
    lamp: np.ndarray  # [P] visible fraction of the lamp, times the cosine of incidence


def bake(
    patch: Patch,
    *,
    occluders: Patch | None = None,
    sky_directions: int = 72,
    lamp_directions: int = 14,
    threads: int = 2,
) -> BakedLight:
    """Cast shadow rays from every vertex to points of the sky and of the lamp; ``occluders`` default to the patch."""
    solid = patch if occluders is None else occluders
    sky_rays = _sphere(sky_directions)
    lamp_rays = _cone(LAMP, _LAMP_SPREAD, lamp_directions)

    def unoccluded(direction: np.ndarray) -> np.ndarray:
        cosine = np.maximum(patch.normals @ direction, 0.0)
        facing = np.flatnonzero(cosine > 0)
        points = patch.vertices[facing] + _LIFT * patch.normals[facing]
        cosine[facing[occluded(solid.vertices, solid.faces, points, direction)]] = 0.0
        return cosine

    with ThreadPoolExecutor(threads) as pool:
        sky = _sum(
            pool.map(unoccluded, sky_rays),
            lambda k, c: c[:, None] * sky_radiance(sky_rays[k : k + 1]),
            (len(patch.vertices), 3),
        )
        lamp = _sum(pool.map(unoccluded, lamp_rays), lambda k, c: c, (len(patch.vertices),))
    return BakedLight(sky * 4 / sky_directions, lamp / lamp_directions)


def _sum(
    items: Iterable[np.ndarray], weigh: Callable[[int, np.ndarray], np.ndarray], shape: tuple[int, ...]
) -> np.ndarray:
    """Return a weighted sum in the order of the items, for determinism."""
    total = np.zeros(shape)
    for k, item in enumerate(items):
        total += weigh(k, item)
    return total


def sky_radiance(directions: np.ndarray) -> np.ndarray:
    """Return the radiance [n, 3] in unit directions [n, 3]: blue zenith, white horizon, warm ground."""
    z = directions[:, 2:]
    zenith, horizon, ground = np.array([0.66, 0.76, 0.92]), np.array([0.86, 0.84, 0.80]), np.array([0.42, 0.38, 0.34])
    above, below = horizon + (zenith - horizon) * z, horizon + (ground - horizon) * np.minimum(-3 * z, 1.0)
    return np.asarray(np.where(z > 0, above, below))


def _sphere(count: int) -> np.ndarray:
    """Return directions [count, 3] on the sphere, spread by the golden angle."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _cone(axis: np.ndarray, spread: float, count: int) -> np.ndarray:
    """Return directions [count, 3] within an angle of an axis, evenly spread."""
    k = np.arange(count) + 0.5
    r, angle = np.tan(spread) * np.sqrt(k / count), np.pi * (1 + np.sqrt(5)) * k
    across = np.cross([0.0, 0.0, 1.0], axis)
    across /= np.linalg.norm(across)
    d = axis + r[:, None] * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def shade(scene: ToyScene, light: BakedLight, hits: Hits, eye: np.ndarray) -> np.ndarray:
    """Return the linear colour [H, W, 3] of every ray of a camera at ``eye``; 0 for rays without hit.

    Diffuse: texture times the interpolated baked light. Highlight: Blinn-Phong, lamp only.
    """
    color = np.zeros((*hits.face.shape, 3), dtype=np.float32)
    mask = hits.face >= 0
    face, weights = hits.face[mask], hits.weights[mask]
    corner = scene.patch.faces[face]  # [hits, 3]

    def at_hit(attribute: np.ndarray) -> np.ndarray:
        values = attribute.astype(np.float32, copy=False)
        first, second, third = (values[corner[:, k]] for k in range(3))
        w = weights if values.ndim == 1 else weights[:, None, :]
        return np.asarray(first * w[..., 0] + second * w[..., 1] + third * w[..., 2])

    uv, part = at_hit(scene.patch.uvs), scene.part_of_face[face]
    lamp = at_hit(light.lamp)
    shaded = _albedo(scene, uv, part) * (
        at_hit(light.sky) * 0.56 + lamp[:, None] * _LAMP_COLOR.astype(np.float32) * 0.62
    )

    gloss = np.array([p.gloss for p in scene.parts], dtype=np.float32)[part]
    position, normal = at_hit(scene.patch.vertices), at_hit(scene.patch.normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    view = eye.astype(np.float32) - position
    half = view / np.linalg.norm(view, axis=1, keepdims=True) + LAMP.astype(np.float32)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    facing = np.maximum((normal * half).sum(axis=1), 0.0)
    cosine = np.maximum(normal @ LAMP.astype(np.float32), 0.05)
    visible = np.minimum(lamp / cosine, 1.0)
    shaded += (gloss * visible * facing**40)[:, None] * _LAMP_COLOR.astype(np.float32)
    color[mask] = shaded
    return color


def _albedo(scene: ToyScene, uv: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the colour [hits, 3] of the nearest texel at (u, v)."""
    albedo = np.empty((len(uv), 3), dtype=np.float32)
    for k, item in enumerate(scene.parts):
        chosen = np.flatnonzero(part == k)
        rows, columns = item.texture.shape[:2]
        column = np.clip((uv[chosen, 0] * columns).astype(np.int64), 0, columns - 1)
        row = np.clip((uv[chosen, 1] * rows).astype(np.int64), 0, rows - 1)
        albedo[chosen] = item.texture[row, column]
    return albedo


def occluded(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, direction: np.ndarray, *, cells: int = 256
) -> np.ndarray:
    """Return whether the ray from each point towards a distant light hits a triangle, bool [Q].

    Points [Q, 3] are origins moved off their surface; ``direction`` [3] is the unit vector towards the light. Projected
    along the light, a ray is a point and a triangle is a 2D triangle. Points and triangles are binned on a grid of
    ``cells`` x ``cells`` across the light, and a point is compared with the triangles that overlap its cell.
    """
    axes = _frame(direction)  # rows: across, across, towards the light
    corners = (vertices @ axes.T)[faces]  # [F, 3, 3]
    queries = points @ axes.T  # [Q, 3]
    blocked = np.zeros(len(points), dtype=bool)
    if not len(points) or not len(faces):
        return blocked
    origin = queries[:, :2].min(axis=0)
    cell_size = np.maximum((queries[:, :2].max(axis=0) - origin) / cells, 1e-9)

    cell_xy = np.clip(((queries[:, :2] - origin) / cell_size).astype(np.int64), 0, cells - 1)
    cell = cell_xy[:, 1] * cells + cell_xy[:, 0]
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=cells * cells)
    starts = np.cumsum(counts) - counts

    # One cell of margin, because points on the border of a cell may have been clipped or rounded into it.
    low = np.clip(np.floor((corners[:, :, :2].min(axis=1) - origin) / cell_size).astype(np.int64), 0, cells)
    high = np.clip(np.floor((corners[:, :, :2].max(axis=1) - origin) / cell_size).astype(np.int64) + 1, 0, cells)
    low = np.minimum(low, cells - 1)
    top = corners[:, :, 2].max(axis=1)
    for face, x, y in pairs(low, np.maximum(high, low + 1)):
        occupied = counts[y * cells + x]
        pair_face = np.repeat(face, occupied)
        first = np.repeat(starts[y * cells + x], occupied)
        within = np.arange(len(pair_face)) - np.repeat(np.cumsum(occupied) - occupied, occupied)
        query = order[first + within]
        above = top[pair_face] > queries[query, 2]
        pair_face, query = pair_face[above], query[above]
        blocked[query[_is_under(corners[pair_face], queries[query])]] = True
    return blocked


def _is_under(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return whether a ray from each point [n, 3] along +z hits its triangle [n, 3, 3]."""
    x, y = (triangles[:, :, axis] - points[:, axis, None] for axis in (0, 1))
    # e[k] belongs to the edge from corner k + 1 to corner k + 2, opposite to corner k.
    e = [x[:, i] * y[:, j] - y[:, i] * x[:, j] for i, j in ((1, 2), (2, 0), (0, 1))]
    total = e[0] + e[1] + e[2]
    z = (e[0] * triangles[:, 0, 2] + e[1] * triangles[:, 1, 2] + e[2] * triangles[:, 2, 2]) / np.where(
        total == 0, 1, total
    )
    return same_sign(*e) & (total != 0) & (z > points[:, 2])


def _frame(direction: np.ndarray) -> np.ndarray:
    """Return a right-handed frame [3, 3] whose last row is the unit ``direction``."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = np.cross(helper, direction)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(direction, across), direction])
