"""Simplify meshes by quadric edge collapse: fewer faces where the surface is flat, within an error in image pixels.

The two vertices of an edge move to one point x. A vertex that stands for the faces f, with areas a_f, planes
n_f.x + d_f = 0 and image resolutions s_f (pixels per world unit), is then wrong by

    e^2 = sum a_f s_f^2 (n_f.x + d_f)^2 / sum a_f        [px^2]

(Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997). The cost of an edge is the
larger e^2 of its two vertices, so that a large flat region does not average a small detail away, plus a part for the
length of the edge and one for the change of colour. Edges collapse in the order of their costs, up to the square of the
allowed error. Edges of borders add planes perpendicular to the surface, which keep outlines in place.

This module has the algorithm in Python; ``kernels/cpu/collapse.cpp`` computes the same bits.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.kernels.native_collapse import CollapseArrays, CollapseRules, collapse_natively

POINTS_AT_ONCE = 1 << 16  # temporaries of this many vertices fit in the cache of a core
ACROSS = 1000.0  # px: size of a mesh without cameras
LENGTH = 1e-3  # px of error per px of edge length: limits faces to a thousand times the error, and orders flat ones
TINT = 5.0  # px of error per unit of colour: fine drawings on a flat wall keep some of their vertices
BORDER = 10.0  # weight of the plane of a border edge, times its squared length
TURN = 0.2  # cosine between a face before and after a collapse from which it counts as turned over
PULL = 1e-3  # of the trace of A, towards the middle of the edge: places x where planes do not determine it

Vector = tuple[float, float, float]


def simplify(mesh: Mesh, *, error: float = math.inf, cameras: Sequence[Camera] = (), faces: int = 0) -> Mesh:
    """Simplify a mesh to an error in pixels, or to a number of faces, whichever is reached first.

    Parameters
    ----------
    mesh : Mesh
        Vertices get the mean colour of the surface that they replace.
    error : float
        Root mean square distance from the surface, px of the nearest image, that collapses may cause.
    cameras : sequence of Camera
        Of the images. Without any, the longest side of the mesh has 1000 px.
    faces : int
        Stop at this number of faces.
    """
    if len(mesh.faces) <= max(faces, 4) or error <= 0:
        return mesh
    vertices = mesh.vertices.astype(np.float64)
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    scale = pixel_scale(vertices, cameras) * size if cameras else np.full(len(vertices), ACROSS)
    colors = None if mesh.colors is None else mesh.colors / 255.0
    arrays = CollapseArrays.of((vertices - middle) / size, mesh.faces, scale, colors)
    del vertices, scale, colors
    rules = CollapseRules(max(faces, 4), error**2, LENGTH**2, TINT**2, BORDER, TURN, PULL)
    if not collapse_natively(arrays, rules):
        _Collapse(arrays, rules).run()
    left = arrays.corners[arrays.corners[:, 0] >= 0]
    used = np.zeros(len(mesh.vertices), bool)
    used[left] = True
    points = arrays.points[used] * size + middle
    painted = None
    if mesh.colors is not None:
        area = np.maximum(arrays.quadric[used, 10:11], np.finfo(np.float64).tiny)
        mean = np.where(area > np.finfo(np.float64).tiny, arrays.color[used, :3] / area, mesh.colors[used] / 255.0)
        painted = np.rint(np.clip(255.0 * mean, 0, 255)).astype(np.uint8)
    return Mesh(points.astype(mesh.vertices.dtype), (np.cumsum(used) - 1)[left].astype(np.int32), painted)


def pixel_scale(vertices: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return how many pixels a world unit has at each vertex [P], in the nearest image that it is inside of.

    Occlusion is ignored, which errs towards more pixels. Vertices outside of all images get the median of the others,
    or 1 if there are none.
    """
    found = np.zeros(len(vertices))
    for start in range(0, len(vertices), POINTS_AT_ONCE):
        points, part = vertices[start : start + POINTS_AT_ONCE].T, found[start : start + POINTS_AT_ONCE]
        for camera in cameras:
            x, y, z = camera.rotation @ points + camera.T_cam_world[:3, 3:]
            z[~(z > 0)] = np.nan
            column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            np.maximum(part, np.where(inside, math.sqrt(camera.fx * camera.fy) / z, 0), out=part)
    seen = found > 0
    return np.where(seen, found, np.median(found[seen]) if seen.any() else 1.0)


class _Collapse:
    """The algorithm; names, order of operations and results are those of ``kernels/cpu/collapse.cpp``."""

    def __init__(self, arrays: CollapseArrays, rules: CollapseRules) -> None:
        self._arrays, self._rules = arrays, rules
        self._points: list[Vector] = [tuple(p) for p in arrays.points.tolist()]
        self._corners: list[list[int]] = arrays.corners.tolist()
        self._quadric = [[0.0] * 12 for _ in self._points]
        self._color = [[0.0] * 4 for _ in self._points]
        self._faces: list[list[int]] = [[] for _ in self._points]  # of each vertex
        self._stamp, self._border = [0] * len(self._points), [0] * len(self._points)
        self._heap: list[tuple[float, int, int, int]] = []
        self._live = len(self._corners)

    def run(self) -> None:
        """Collapse, and write the results into the arrays."""
        self._start()
        while self._heap and self._live > self._rules.target:
            _, u, v, stamp = heapq.heappop(self._heap)
            if self._stamp[u] + self._stamp[v] != stamp:
                continue
            _, at = self._cost(u, v)
            if self._allowed(u, v, at):
                self._merge(u, v, at)
        self._arrays.points[:] = self._points
        self._arrays.corners[:] = self._corners
        self._arrays.quadric[:] = self._quadric
        if self._arrays.colors is not None:
            self._arrays.color[:] = self._color

    def _around(self, u: int) -> list[tuple[int, int, int]]:
        """Return the faces at a vertex, each with its two other corners."""
        found = []
        for f in self._faces[u]:
            a, b, c = self._corners[f]
            if a >= 0:
                found.append((f, b, c) if a == u else (f, c, a) if b == u else (f, a, b))
        return found

    def _add_plane(self, i: int, n: Vector, at: Vector, weight: float) -> None:
        x, y, z = n
        d = -_dot(n, at)
        terms = (x * x, x * y, x * z, y * y, y * z, z * z, x * d, y * d, z * d, d * d)
        for k, term in enumerate(terms):
            self._quadric[i][k] += weight * term

    def _start(self) -> None:
        scale = self._arrays.scale.tolist()
        for f, corners in enumerate(self._corners):
            for u in corners:
                self._faces[u].append(f)
            a, b, c = (self._points[u] for u in corners)
            n = _cross(_minus(b, a), _minus(c, a))
            length = math.sqrt(_dot(n, n))
            if not length > 0:
                continue
            area, s = 0.5 * length, (scale[corners[0]] + scale[corners[1]] + scale[corners[2]]) / 3
            for u in corners:
                self._add_plane(u, _times(1 / length, n), a, area * s * s)
                self._quadric[u][10] += area
                self._quadric[u][11] += area * s * s
        if self._arrays.colors is not None:
            for i, (r, g, b) in enumerate(self._arrays.colors.tolist()):
                area = self._quadric[i][10]
                self._color[i] = [area * r, area * g, area * b, area * (r * r + g * g + b * b)]
        for u in range(len(self._points)):
            self._mark_borders(u, scale)
        for u in range(len(self._points)):
            self._push_edges(u, higher=True)

    def _mark_borders(self, u: int, scale: Sequence[float]) -> None:
        """Add, for each edge on a border, the plane through it that is perpendicular to its face."""
        around = self._around(u)
        for _, p, q in around:
            for w in (p, q):
                faces = sum(w in (i, j) for _, i, j in around)
                if faces > 2:
                    self._border[u] = 2
                if faces != 1:
                    continue
                self._border[u] = max(self._border[u], 1)
                a = self._points[u]
                edge = _minus(self._points[w], a)
                n = _cross(_minus(self._points[p], a), _minus(self._points[q], a))
                across = _cross(edge, n)
                length, s = math.sqrt(_dot(across, across)), (scale[u] + scale[w]) / 2
                if length > 0:
                    weight = self._rules.border_weight * _dot(edge, edge) * s * s
                    self._add_plane(u, _times(1 / length, across), a, weight)

    def _cost(self, u: int, v: int) -> tuple[float, Vector]:
        """Return the cost in px^2 of moving two vertices to one point, and that point."""
        p, q = self._quadric[u], self._quadric[v]
        s = [one + other for one, other in zip(p, q, strict=True)]
        a, b = self._points[u], self._points[v]
        edge, best = _minus(b, a), _times(0.5, _plus(a, b))
        pull = self._rules.pull * (s[0] + s[3] + s[5])
        x, y, z = (s[0] + pull, s[1], s[2]), (s[1], s[3] + pull, s[4]), (s[2], s[4], s[5] + pull)
        right = (pull * best[0] - s[6], pull * best[1] - s[7], pull * best[2] - s[8])
        determinant = _dot(x, _cross(y, z))
        if determinant > 0:
            best = (
                _dot(right, _cross(y, z)) / determinant,
                _dot(right, _cross(z, x)) / determinant,
                _dot(right, _cross(x, y)) / determinant,
            )
        area = s[10]
        scale = s[11] / area if area > 0 else 0.0
        cost = max(_error(p, best), _error(q, best)) + self._rules.length_weight * scale * _dot(edge, edge)
        if self._arrays.colors is not None and area > 0:
            cost += self._rules.tint_weight * self._change(u, v, area)
        return cost, best

    def _change(self, u: int, v: int, area: float) -> float:
        """Return the mean squared change of colour at one of two vertices, if both get their mean colour."""
        p, q = self._color[u], self._color[v]
        mean = ((p[0] + q[0]) / area, (p[1] + q[1]) / area, (p[2] + q[2]) / area)
        worst = 0.0
        for i in (u, v):
            c, own = self._color[i], self._quadric[i][10]
            if own > 0:
                worst = max(worst, (c[3] - 2 * _dot(mean, (c[0], c[1], c[2]))) / own + _dot(mean, mean))
        return worst

    def _push_edges(self, u: int, *, higher: bool) -> None:
        """Push the edges of a vertex, each once; ``higher``: only those to vertices of a higher number."""
        for w in dict.fromkeys(w for _, p, q in self._around(u) for w in (p, q)):
            if (not higher or w > u) and self._border[u] < 2 and self._border[w] < 2:
                cost, _ = self._cost(u, w)
                if cost <= self._rules.limit:
                    heapq.heappush(self._heap, (cost, min(u, w), max(u, w), self._stamp[u] + self._stamp[w]))

    def _allowed(self, u: int, v: int, at: Vector) -> bool:
        """Return whether the surface stays a manifold, and no face turns over."""
        sides = self._around(u), self._around(v)
        of_u, of_v = ({w for _, p, q in side for w in (p, q)} for side in sides)
        shared, common = sum(v in (p, q) for _, p, q in sides[0]), of_u & of_v
        if any(len(self._around(w)) <= 3 and not self._border[w] for w in common):
            return False
        if len(common) != shared or not 1 <= shared <= 2 or (shared == 2 and self._border[u] and self._border[v]):
            return False
        for i, j, side in ((u, v, sides[0]), (v, u, sides[1])):
            for _, p, q in side:
                if j in (p, q):
                    continue
                a, b, c = self._points[i], self._points[p], self._points[q]
                old, now = _cross(_minus(b, a), _minus(c, a)), _cross(_minus(b, at), _minus(c, at))
                size = math.sqrt(_dot(old, old) * _dot(now, now))
                if not _dot(old, now) > self._rules.turn * size and _dot(old, old) > 0:
                    return False
        return True

    def _merge(self, u: int, v: int, at: Vector) -> None:
        for f, p, q in self._around(v):
            if u in (p, q):
                self._corners[f][0] = -1
                self._live -= 1
            else:
                self._corners[f][self._corners[f].index(v)] = u
        self._faces[u] = [f for f in self._faces[u] + self._faces[v] if self._corners[f][0] >= 0]
        self._faces[v] = []
        self._quadric[u] = [one + other for one, other in zip(self._quadric[u], self._quadric[v], strict=True)]
        self._color[u] = [one + other for one, other in zip(self._color[u], self._color[v], strict=True)]
        self._points[u], self._border[u] = at, max(self._border[u], self._border[v])
        self._stamp[u] += 1
        self._stamp[v] += 1
        self._push_edges(u, higher=False)


def _error(m: Sequence[float], at: Vector) -> float:
    """Return the mean squared error in px^2 of a vertex with this quadric at a point."""
    x, y, z = at
    value = m[0] * x * x + m[3] * y * y + m[5] * z * z
    value = value + 2 * (m[1] * x * y + m[2] * x * z + m[4] * y * z) + 2 * (m[6] * x + m[7] * y + m[8] * z) + m[9]
    return max(value, 0.0) / m[10] if m[10] > 0 else 0.0


def _plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _times(s: float, a: Vector) -> Vector:
    return s * a[0], s * a[1], s * a[2]


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
