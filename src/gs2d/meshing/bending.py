"""Curvature of a mesh as a linear function of vertex displacements, sparse solves, and splitting of long edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array

_TINY = 1e-300
PASSES = 40  # of splitting: each halves the longest edges


def split_edges(
    vertices: np.ndarray, faces: np.ndarray, limit: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Halve edges that are longer than the mean limit [P] of their ends, the longest edge of each face first.

    An edge is split if it is the longest of all its faces, until no edge is too long, so that thin faces do not get
    thinner. New vertices come last and have the mean ``values`` [P, C] of their edge. Lengths are world units.
    """
    rows = np.concatenate([vertices, limit[:, None], values], axis=1)
    for _ in range(PASSES):
        ends, sides = _sides(faces)
        a, b = ends.T
        length = np.linalg.norm(rows[a, :3] - rows[b, :3], axis=1)
        too_long = length > 0.5 * (rows[a, 3] + rows[b, 3])
        rank = np.empty(len(ends), np.int64)
        rank[np.argsort(np.where(too_long, length, 0.0), kind="stable")] = np.arange(len(ends))
        longest = np.argmax(rank[sides], axis=1)  # of each face
        own = sides[np.arange(len(faces)), longest]
        chosen = too_long & (np.bincount(own, minlength=len(ends)) == np.bincount(sides.ravel(), minlength=len(ends)))
        if not chosen.any():
            break
        number = len(rows) + np.cumsum(chosen) - 1
        rows = np.concatenate([rows, 0.5 * (rows[a[chosen]] + rows[b[chosen]])])
        cut = chosen[own]
        turn = (longest[cut, None] + np.arange(3)) % 3  # the split edge becomes the first
        p, q, r = np.take_along_axis(faces[cut], turn, axis=1).T
        middle = number[own[cut]]
        halves = (np.stack([p, middle, r], axis=1), np.stack([middle, q, r], axis=1))
        faces = np.concatenate([faces[~cut], *halves]).astype(np.int32)
    return rows[:, :3], faces, rows[:, 4:]


def _sides(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges [E, 2], and those of each face [F, 3]: side k joins corners k and k + 1."""
    every = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2).astype(np.int64)
    every.sort(axis=1)
    count = np.int64(faces.max()) + 1
    keys, inverse = np.unique(every[:, 0] * count + every[:, 1], return_inverse=True)
    return np.stack([keys // count, keys % count], axis=1), inverse.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Curvature:
    """Mean curvature of the vertices of a mesh, and its change with displacements along the normals."""

    # [P], 1 / world unit: kappa_k = 2 sum_j w_kj n_k . (x_j - x_k) / sum_j w_kj |x_j - x_k|^2 over neighbours j, w = 1
    # / |x_j - x_k|. Exact on a sphere; 0 at open borders.
    values: np.ndarray
    # [P, P], 1 / world unit^2: derivative of ``values`` by the displacements, with constant normals and weights;
    # neighbours move in parallel.
    change: csr_array
    areas: np.ndarray  # [P] a third of the areas of the faces of each vertex, world units^2
    graph: csr_array  # [P, P] Laplacian of the edges: x . graph x is the sum of (x_i - x_j)^2 over the edges

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> Curvature:
        """Return the curvature of vertices [P, 3] with unit normals [P, 3], float64."""
        count = len(vertices)
        ends, sides = _sides(faces)
        a, b = ends.T
        arm = vertices[b] - vertices[a]
        length = np.maximum(np.linalg.norm(arm, axis=1), _TINY)

        def at_vertices(of_a: np.ndarray, of_b: np.ndarray) -> np.ndarray:
            return np.bincount(a, of_a, count) + np.bincount(b, of_b, count)

        def symmetric(values: np.ndarray) -> csr_array:
            where = (np.concatenate([a, b]), np.concatenate([b, a]))
            return coo_array((np.concatenate([values, values]), where), (count, count)).tocsr()

        border = np.zeros(count, bool)
        border[ends[np.bincount(sides.ravel(), minlength=len(ends)) == 1]] = True
        total = at_vertices(length, length)
        scale = np.where(border | (total == 0), 0.0, 2 / np.where(total == 0, 1.0, total))
        heights = ((arm * normals[a]).sum(axis=1) / length, -(arm * normals[b]).sum(axis=1) / length)
        change = diags_array(scale) @ (symmetric(1 / length) - diags_array(at_vertices(1 / length, 1 / length)))
        one = np.ones(len(ends))
        graph = diags_array(at_vertices(one, one)) - symmetric(one)
        p, q, r = (vertices[faces[:, k]] for k in range(3))
        third = np.linalg.norm(np.cross(q - p, r - p), axis=1) / 6
        areas = np.bincount(faces.ravel(), np.repeat(third, 3), count)
        return cls(scale * at_vertices(*heights), csr_array(change), areas, csr_array(graph))

    def smooth(self, rounds: int) -> np.ndarray:
        """Return the values averaged over ``rounds`` rings of neighbours, weighted by area: the total stays."""
        total, areas = self.spread(self.values * self.areas, rounds), self.spread(self.areas, rounds)
        return np.where(self.graph.diagonal() > 0, total / np.maximum(areas, _TINY), 0.0)

    def spread(self, amounts: np.ndarray, rounds: int) -> np.ndarray:
        """Return amounts [P] after each vertex has given half of its own to its neighbours, in equal parts, in turn."""
        degree = np.maximum(self.graph.diagonal(), 1.0)
        for _ in range(rounds):
            amounts = amounts - 0.5 * (self.graph @ (amounts / degree))
        return amounts


def solve(matrix: csr_array, right: np.ndarray, *, steps: int, tolerance: float) -> np.ndarray:
    """Solve a symmetric positive definite system by conjugate gradients with a diagonal preconditioner.

    It stops at the relative residual ``tolerance`` or after ``steps``. The sums do not depend on the number of threads.
    """
    diagonal = matrix.diagonal()
    inverse = 1 / np.where(diagonal > 0, diagonal, 1.0)
    x, rest = np.zeros_like(right), right.copy()
    direction = inverse * rest
    size = start = float((rest * direction).sum())
    for _ in range(steps):
        if size <= tolerance**2 * start:
            break
        image = matrix @ direction
        length = size / float((direction * image).sum())
        x += length * direction
        rest -= length * image
        scaled = inverse * rest
        size, before = float((rest * scaled).sum()), size
        direction = scaled + (size / before) * direction
    return x
