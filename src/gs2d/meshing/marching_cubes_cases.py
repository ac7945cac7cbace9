"""The 256 cases of marching cubes, derived from one rule instead of typed in.

A cell has corners c = 0..7 at (c & 1, c >> 1 & 1, c >> 2 & 1), inside where the field is negative. The surface cuts
each face of the cell in segments that separate every run of inside corners from the rest; so on a face with inside
corners on one diagonal the inside is split and the outside joined, whichever cell looks at it. Segments of the six
faces close into loops. A loop is cut into triangles without a diagonal that lies in a face of the cell (the cell
behind that face could choose the same diagonal, and the edge would have four triangles). Hence meshes of neighbouring
cells fit: every edge away from the border of the known cells has exactly two triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])  # [8, 3] x y z
EDGES = tuple((axis, c) for axis in range(3) for c in range(8) if not c >> axis & 1)  # axis, lower corner
_EDGE_OF = {frozenset((c, c | 1 << axis)): e for e, (axis, c) in enumerate(EDGES)}


@dataclass(frozen=True, eq=False)
class CaseTable:
    """Triangles of every case: those of case i are ``edges[starts[i]:starts[i + 1]]``."""

    starts: np.ndarray  # [257] int64
    edges: np.ndarray  # [T, 3] int64, edge numbers of the cell


def _faces() -> list[tuple[int, int, int, int]]:
    """Corners of the six faces, counter-clockwise seen from outside the cell."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3  # u x v points along +axis
        high = 1 << axis
        faces.append((high, high | u, high | u | v, high | v))
        faces.append((0, v, u | v, u))
    return faces


def _face_segments(face: tuple[int, int, int, int], case: int) -> dict[int, int]:
    """Directed segments of one face, from edge to edge, one around each run of inside corners."""
    inside = [bool(case >> c & 1) for c in face]
    crossings = []  # (edge, leaves the inside), walking round the face
    for i in range(4):
        j = (i + 1) % 4
        if inside[i] != inside[j]:
            crossings.append((_EDGE_OF[frozenset((face[i], face[j]))], inside[i]))
    segments = {}
    for k, (edge, leaves) in enumerate(crossings):
        if leaves:  # the run that ends here began at the crossing before
            segments[crossings[k - 1][0]] = edge
    return segments


def _loops(case: int) -> list[list[int]]:
    """Return closed loops of edges. An edge is left by one of its two faces and reached by the other."""
    follow: dict[int, int] = {}
    for face in _faces():
        follow.update(_face_segments(face, case))
    loops = []
    while follow:
        start, at = follow.popitem()
        loop = [start]
        while at != start:
            loop.append(at)
            at = follow.pop(at)
        first = loop.index(min(loop))  # the same table whatever the order of the walk
        loops.append(loop[first:] + loop[:first])
    return sorted(loops)


def _share_a_face(e: int, f: int) -> bool:
    def corners(edge: int) -> set[int]:
        axis, low = EDGES[edge]
        return {low, low | 1 << axis}

    return any(corners(e) | corners(f) <= set(face) for face in _faces())


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a loop whose diagonals avoid the faces of the cell, or None where there are none."""
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    for k in range(2, len(loop)):  # the triangle on the side loop[0], loop[1]
        sides = [loop[1 : k + 1], [loop[0], *loop[k:]]]
        diagonals = [side for side in sides if len(side) > 2]
        if any(_share_a_face(side[0], side[-1] if side is sides[0] else side[1]) for side in diagonals):
            continue
        parts = [_triangulate(side) for side in diagonals]
        if all(part is not None for part in parts):
            return [(loop[0], loop[1], loop[k]), *(t for part in parts if part is not None for t in part)]
    return None


@cache
def case_table() -> CaseTable:
    """Return the table, computed once per process (milliseconds)."""
    starts, edges = [0], []
    for case in range(256):
        for loop in _loops(case):
            triangles = _triangulate(loop)
            if triangles is None:
                raise AssertionError(f"case {case}: the loop {loop} has no triangles off the faces")
            edges += triangles
        starts.append(len(edges))
    return CaseTable(np.array(starts), np.array(edges, dtype=np.int64).reshape(-1, 3))
