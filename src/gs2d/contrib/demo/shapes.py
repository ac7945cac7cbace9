"""Closed surfaces for the demo scene, each built from rectangular grids of points with texture coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

_SAME_POINT = 1e-7  # world units, vertices closer than this are merged


@dataclass(frozen=True, eq=False)
class Patch:
    """Triangles with shading normals and texture coordinates; vertices on a texture seam are repeated."""

    vertices: np.ndarray  # [P, 3] world units
    normals: np.ndarray  # [P, 3] unit, outwards
    uvs: np.ndarray  # [P, 2]
    faces: np.ndarray  # [F, 3] int64, counter-clockwise from outside

    def moved(self, *, offset: Sequence[float] | np.ndarray = (0, 0, 0), turn: float = 0.0) -> Patch:
        """Return the patch rotated about z by ``turn`` radians, then translated by ``offset`` world units."""
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        return Patch(self.vertices @ R.T + np.asarray(offset), self.normals @ R.T, self.uvs, self.faces)


def merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge coincident vertices; faces keep order and number."""
    keys = np.round(vertices / _SAME_POINT).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return vertices[first], inverse.reshape(-1)[faces]


def join(patches: Sequence[Patch]) -> Patch:
    """Join patches to one; normals are kept, so that edges between patches stay sharp."""
    starts = np.cumsum([0, *(len(p.vertices) for p in patches)])
    return Patch(
        np.concatenate([p.vertices for p in patches]),
        np.concatenate([p.normals for p in patches]),
        np.concatenate([p.uvs for p in patches]),
        np.concatenate([p.faces + start for p, start in zip(patches, starts[:-1], strict=True)]),
    )


def grid(points: np.ndarray, uvs: np.ndarray) -> Patch:
    """Triangulate a grid of points [m, n, 3] with uvs [m, n, 2]; degenerate quads give one triangle.

    The outside is the direction (first index) x (second index).
    """
    m, n = points.shape[:2]
    index = np.arange(m * n).reshape(m, n)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2).reshape(-1, 3)
    vertices = np.ascontiguousarray(points.reshape(-1, 3), dtype=np.float64)
    cross = _face_crosses(vertices, faces)
    faces = faces[np.linalg.norm(cross, axis=1) > 1e-12]
    return Patch(vertices, _smooth_normals(vertices, faces), uvs.reshape(-1, 2).astype(np.float64), faces)


def _face_crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return area-weighted vertex normals, shared by coincident vertices."""
    keys = np.round(vertices / _SAME_POINT).astype(np.int64)
    _, shared = np.unique(keys, axis=0, return_inverse=True)
    shared = shared.reshape(-1)
    total = np.zeros((int(shared.max()) + 1, 3))
    cross = _face_crosses(vertices, faces)
    for k in range(3):
        np.add.at(total, shared[faces[:, k]], cross)
    normals = total[shared]
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20))


def lathe(profile: np.ndarray, texture_v: np.ndarray, around: int) -> Patch:
    """Return a surface of revolution about z of a profile [m, 2] of (radius, height); u is around, ``texture_v`` along.

    The outside is on the right of the profile (an outer wall goes upwards).
    """
    angle = np.linspace(0, 2 * np.pi, around + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring[-1] = ring[0]
    points = np.empty((around + 1, len(profile), 3))
    points[:, :, :2] = ring[:, None, :] * profile[None, :, :1]
    points[:, :, 2] = profile[None, :, 1]
    u, v = np.meshgrid(angle / (2 * np.pi), texture_v, indexing="ij")
    return grid(points, np.stack([u, v], axis=-1))


def vase(outline: np.ndarray, *, wall: float, rows: int = 44, around: int = 72, painted: float = 0.8) -> Patch:
    """Make a hollow vase: a smooth outer wall through ``outline`` [k, 2] (radius, height), bottom first.

    Texture v runs from 0 at the foot to ``painted`` at the lip of the outer wall and from there to 1 inside.
    """
    height = np.linspace(outline[0, 1], outline[-1, 1], rows)
    outer = np.stack([PchipInterpolator(outline[:, 1], outline[:, 0])(height), height], axis=1)
    lip = outer[-1] + np.array([-wall / 2, wall / 2])
    inner = outer[::-1][: rows - 3] * [1, 1] - [wall, 0]
    inner[:, 0] = np.maximum(inner[:, 0], wall)
    foot, floor = [0.0, outer[0, 1]], [0.0, inner[-1, 1]]
    profile = np.array([foot, *outer, lip, *inner, floor])
    v_outer = painted * (outer[:, 1] - outer[0, 1]) / (outer[-1, 1] - outer[0, 1])
    v_inner = np.linspace(painted + 0.01, 0.999, len(inner) + 2)
    return lathe(profile, np.concatenate([[0.0], v_outer, v_inner]), around)


def plinth(radius: float, thickness: float, *, rings: int = 46, around: int = 128) -> tuple[Patch, Patch]:
    """Return a round plate with upper face z = 0, as two patches: the upper face and the bevelled rest."""
    bevel = thickness / 4
    r = np.linspace(0, radius - bevel, rings)
    upper = lathe(np.stack([r[::-1], np.zeros(rings)], axis=1), np.zeros(rings), around)
    flat_uv = upper.vertices[:, :2] / (2 * radius) + 0.5
    upper = Patch(upper.vertices, upper.normals, flat_uv, upper.faces)
    side_z = np.linspace(-thickness, -bevel, 4)
    under = np.linspace(0, radius - bevel, 8)
    profile = [[x, -thickness] for x in under[:-1]]
    profile += [[radius - bevel, -thickness], [radius, -thickness + bevel]]
    profile += [[radius, z] for z in side_z[2:]] + [[radius - bevel, 0.0]]
    v = np.concatenate([np.linspace(0, 0.5, len(under)), np.linspace(0.5, 1, len(profile) - len(under))])
    return upper, lathe(np.array(profile), v, around)


def tube(path: np.ndarray, radius: np.ndarray | float, *, around: int = 8, closed: bool = False) -> Patch:
    """Return a tube along a path [m, 3] with rounded ends unless closed; u is around, v along."""
    if closed:
        path = np.concatenate([path, path[:1]])
        tangent = np.roll(path[:-1], -1, axis=0) - np.roll(path[:-1], 1, axis=0)
        tangent = np.concatenate([tangent, tangent[:1]])
    else:
        tangent = np.gradient(path, axis=0)
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    normal, binormal = _transported_frames(tangent, closed)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    cosine, sine = np.cos(angle), np.sin(angle)
    cosine[-1], sine[-1] = 1.0, 0.0
    sizes = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(path),)).copy()
    if not closed:  # rounded ends
        path = np.concatenate([path[:1], path, path[-1:]])
        path[0] -= tangent[0] * sizes[0] * 0.7
        path[-1] += tangent[-1] * sizes[-1] * 0.7
        sizes = np.concatenate([[0.0], sizes, [0.0]])
        normal, binormal = (np.concatenate([x[:1], x, x[-1:]]) for x in (normal, binormal))
    around_path = cosine[None, :, None] * normal[:, None] + sine[None, :, None] * binormal[:, None]
    points = path[:, None] + sizes[:, None, None] * around_path  # [m, around + 1, 3]
    if closed:
        points[-1] = points[0]
    v, u = np.meshgrid(np.linspace(0, 1, len(path)), angle / (2 * np.pi), indexing="ij")
    flipped = points[:, ::-1]
    return grid(flipped, np.stack([u[:, ::-1], v], axis=-1))


def _transported_frames(tangent: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation-minimising normals and binormals [m, 3] along the tangents (continuous, if closed)."""
    normal = np.empty_like(tangent)
    helper = np.eye(3)[int(np.argmin(np.abs(tangent[0])))]
    normal[0] = np.cross(helper, tangent[0])
    normal[0] /= np.linalg.norm(normal[0])
    for k in range(1, len(tangent)):
        moved = normal[k - 1] - tangent[k] * (normal[k - 1] @ tangent[k])
        normal[k] = moved / np.linalg.norm(moved)
    binormal = np.cross(tangent, normal)
    if closed:  # distribute the angle between last and first frame
        twist = np.arctan2(normal[0] @ binormal[-1], normal[0] @ normal[-1]) * np.linspace(0, 1, len(tangent))
        c, s = np.cos(twist)[:, None], np.sin(twist)[:, None]
        normal = c * normal + s * binormal
        binormal = np.cross(tangent, normal)
    return normal, binormal


def smooth_path(points: Sequence[Sequence[float]], count: int) -> np.ndarray:
    """Return a smooth curve [count, 3] through the points, at equal steps of chord length."""
    p = np.asarray(points, dtype=np.float64)
    knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    return np.asarray(CubicSpline(knots, p)(np.linspace(0, knots[-1], count)))


def torus_knot(major: float, minor: float, *, p: int = 2, q: int = 3, steps: int = 180) -> np.ndarray:
    """Return a closed (p, q) torus knot [steps, 3] about the z axis."""
    t = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    r = major + minor * np.cos(q * t)
    return np.stack([r * np.cos(p * t), r * np.sin(p * t), -minor * np.sin(q * t)], axis=1)


def ball(radius: float, *, stretch: float = 1.0, rows: int = 18, around: int = 32) -> Patch:
    """Return a sphere about the origin, stretched along z."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows)
    profile = radius * np.stack([np.cos(angle), stretch * np.sin(angle)], axis=1)
    profile[[0, -1], 0] = 0.0
    return lathe(profile, np.linspace(0, 1, rows), around)


def box(size: Sequence[float], *, cells: int = 12) -> Patch:
    """Return a box standing on z = 0. The texture is an atlas of six equal columns: +x, +y, -x, -y, top, bottom."""
    sx, sy, sz = (s / 2 for s in size)
    sides = [  # origin, along u, along v; outside is u x v
        ((sx, -sy, 0), (0, 2 * sy, 0), (0, 0, 2 * sz)),
        ((sx, sy, 0), (-2 * sx, 0, 0), (0, 0, 2 * sz)),
        ((-sx, sy, 0), (0, -2 * sy, 0), (0, 0, 2 * sz)),
        ((-sx, -sy, 0), (2 * sx, 0, 0), (0, 0, 2 * sz)),
        ((-sx, -sy, 2 * sz), (2 * sx, 0, 0), (0, 2 * sy, 0)),
        ((-sx, sy, 0), (2 * sx, 0, 0), (0, -2 * sy, 0)),
    ]
    t = np.linspace(0, 1, cells + 1)
    u, v = np.meshgrid(t, t, indexing="ij")
    patches = []
    for column, (origin, along_u, along_v) in enumerate(sides):
        points = np.asarray(origin) + u[..., None] * np.asarray(along_u) + v[..., None] * np.asarray(along_v)
        inset = 0.002  # keeps a lookup at the border of a side inside its column
        uv = np.stack([(column + inset + (1 - 2 * inset) * u) / 6, inset + (1 - 2 * inset) * v], axis=-1)
        patches.append(grid(points, uv))
    return join(patches)


def leaf(
    base: np.ndarray, along: np.ndarray, up: np.ndarray, *, length: float, width: float, thickness: float = 0.006
) -> Patch:
    """Make a thin pointed leaf from ``base`` along ``along``, its upper side towards ``up``, bent downwards."""
    along = along / np.linalg.norm(along)
    across = np.cross(up, along)
    across /= np.linalg.norm(across)
    upward = np.cross(along, across)
    s = np.linspace(0, 1, 9)
    t = np.linspace(-1, 1, 5)
    half = width / 2 * np.sin(np.pi * s) ** 0.8 * (1 - 0.25 * s)
    half[0] = half[-1] = 0.0
    S, T = np.meshgrid(s, t, indexing="ij")
    middle = (
        base
        + (length * S)[..., None] * along
        + (half[:, None] * T)[..., None] * across
        + (length * (0.10 * S - 0.32 * S**2) + 0.35 * half[:, None] * T**2)[..., None] * upward
    )
    rise = (thickness / 2 * (1 - T**2) * (half > 0)[:, None])[..., None] * upward
    uv = np.stack([S, (T + 1) / 2], axis=-1)
    return join([grid(middle + rise, uv), grid((middle - rise)[:, ::-1], uv[:, ::-1])])
