"""Marching cubes over the blocks of a volume, and connected components of a mesh.

A cell consists of eight neighbouring voxels and creates surface only if all of them are known. Vertices are numbered by
the grid edge they lie on, so cells of neighbouring blocks share vertices exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gs2d.core.mesh import Mesh
from gs2d.meshing.tsdf_volume import BLOCK, VOXELS, Volume

# -- the cases of a cube -----------------------------------------------------------------------------------------------
# A cell has corners c = 0..7 at (c & 1, c >> 1 & 1, c >> 2 & 1); a corner is inside if the field is negative. On each
# face of the cell, the surface consists of segments that separate each run of inside corners from the rest. On a face
# with two diagonal inside corners, the inside is therefore split and the outside connected, for both adjacent cells.
# The segments of the six faces form closed loops. A loop is split into triangles without a diagonal in a face of the
# cell, because the adjacent cell could choose the same diagonal, and the edge would have four triangles. Meshes of
# neighbouring cells therefore match: every edge inside the known cells has exactly two triangles.
CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])  # [8, 3] x y z
EDGES = tuple((axis, c) for axis in range(3) for c in range(8) if not c >> axis & 1)  # axis, lower corner
_EDGE_OF = {frozenset((c, c | 1 << axis)): e for e, (axis, c) in enumerate(EDGES)}


@dataclass(frozen=True, eq=False)
class CaseTable:
    """Triangles of all cases; those of case i are ``edges[starts[i]:starts[i + 1]]``."""

    starts: np.ndarray  # [257] int64
    edges: np.ndarray  # [T, 3] int64, edge numbers of the cell


def _faces() -> list[tuple[int, int, int, int]]:
    """Return the corners of the six faces, counter-clockwise seen from outside the cell."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3  # u x v points along +axis
        high = 1 << axis
        faces.append((high, high | u, high | u | v, high | v))
        faces.append((0, v, u | v, u))
    return faces


def _loops(case: int) -> list[list[int]]:
    """Return closed loops of edges. An edge is left by one of its two faces and reached by the other."""
    follow: dict[int, int] = {}
    for face in _faces():
        inside = [bool(case >> c & 1) for c in face]
        crossed = [i for i in range(4) if inside[i] != inside[(i + 1) % 4]]  # around the face
        edges = [_EDGE_OF[frozenset((face[i], face[(i + 1) % 4]))] for i in crossed]
        for k, i in enumerate(crossed):
            if inside[i]:  # the run of inside corners that ends here started at the previous crossing
                follow[edges[k - 1]] = edges[k]
    loops = []
    while follow:
        start, at = follow.popitem()
        loop = [start]
        while at != start:
            loop.append(at)
            at = follow.pop(at)
        first = loop.index(min(loop))  # a canonical start, so that the table is unique
        loops.append(loop[first:] + loop[:first])
    return sorted(loops)


def _share_a_face(e: int, f: int) -> bool:
    def corners(edge: int) -> set[int]:
        axis, low = EDGES[edge]
        return {low, low | 1 << axis}

    return any(corners(e) | corners(f) <= set(face) for face in _faces())


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Split a loop into triangles whose diagonals avoid the faces of the cell; None if impossible."""
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
    """Return the table of cases, computed once per process (milliseconds)."""
    starts, edges = [0], []
    for case in range(256):
        for loop in _loops(case):
            triangles = _triangulate(loop)
            if triangles is None:
                raise AssertionError(f"case {case}: the loop {loop} has no triangles off the faces")
            edges += triangles
        starts.append(len(edges))
    return CaseTable(np.array(starts), np.array(edges, dtype=np.int64).reshape(-1, 3))


# -- the surface -------------------------------------------------------------------------------------------------------
_CHUNK = 512  # blocks at a time
EDGES_OF_BLOCK = 3 * VOXELS  # edges that start at its voxels
_EDGE_GUARD = np.float32(1e-3)  # of an edge: distance of vertices from its ends, against degenerate triangles


def cell_surface(
    volume: Volume, min_weight: float, blocks: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the topology of the zero level set of the first ``blocks`` blocks of a volume (default: all).

    Voxels with a weight below ``min_weight`` are unknown. A view adds 1 to voxels in front of its surface, and to those
    behind it up to ``FULL_WEIGHT_BEHIND`` of the truncation.

    Returns the P sorted grid edges with a vertex, int64: 3 * (512 * row + voxel) + axis, of the voxel at the lower end;
    faces [F, 3] of indices into them, counter-clockwise seen from the cameras' side; and the voxel at the upper end of
    each edge [P], as 512 * row + voxel, larger than that of the lower end.
    """
    count = len(volume.keys) if blocks is None else blocks
    shifted = _neighbours(volume)
    triangles = [
        _chunk_triangles(volume, shifted, np.arange(start, min(start + _CHUNK, count)), min_weight)
        for start in range(0, count, _CHUNK)
    ]
    corners = np.concatenate(triangles) if triangles else np.zeros((0, 3), np.int64)
    edges, faces = np.unique(corners, return_inverse=True)
    return edges, faces.reshape(-1, 3), _upper_ends(shifted, edges)


def _neighbours(volume: Volume) -> np.ndarray:
    """Return the rows [M, 8] of the blocks shifted by each corner (0 or 1 along each axis), -1 if missing."""
    blocks = volume.blocks
    rows = np.full((len(blocks), 8), -1, dtype=np.int64)
    for corner, shift in enumerate(CORNERS):
        block = blocks + shift
        inside = (block < volume.dims).all(axis=1)
        key = (block[:, 0] * volume.dims[1] + block[:, 1]) * volume.dims[2] + block[:, 2]
        at = np.minimum(np.searchsorted(volume.keys, key), len(blocks) - 1)
        rows[:, corner] = np.where(inside & (volume.keys[at] == key), at, -1)
    return rows


def _padded(values: np.ndarray, shifted: np.ndarray) -> np.ndarray:
    """Return blocks with the first layer of their upper neighbours [n, 9, 9, 9], 0 for missing neighbours."""
    cubes = values.reshape(-1, BLOCK, BLOCK, BLOCK)
    out = np.zeros((len(shifted), BLOCK + 1, BLOCK + 1, BLOCK + 1), values.dtype)
    for corner, shift in enumerate(CORNERS):
        rows = shifted[:, corner]
        has = rows >= 0
        x, y, z = (slice(BLOCK, None) if s else slice(0, BLOCK) for s in shift)
        a, b, c = (slice(0, 1) if s else slice(0, BLOCK) for s in shift)
        out[has, x, y, z] = cubes[rows[has], a, b, c]
    return out


def _chunk_triangles(volume: Volume, shifted: np.ndarray, chunk: np.ndarray, min_weight: float) -> np.ndarray:
    """Return the triangles [T, 3] of some blocks, as global edge numbers."""
    inside = _padded(volume.tsdf, shifted[chunk]) < 0
    valid = _padded(volume.weight, shifted[chunk]) >= max(min_weight, 1e-12)
    case = np.zeros((len(chunk), BLOCK, BLOCK, BLOCK), np.uint8)
    full = np.ones_like(case, dtype=bool)
    for corner, (x, y, z) in enumerate(CORNERS):
        window = (slice(None), slice(x, x + BLOCK), slice(y, y + BLOCK), slice(z, z + BLOCK))
        case |= inside[window].astype(np.uint8) << np.uint8(corner)
        full &= valid[window]
    cells = np.flatnonzero(full.reshape(-1) & (case.reshape(-1) != 0) & (case.reshape(-1) != 255))
    table = case_table()
    cases = case.reshape(-1)[cells].astype(np.int64)
    counts = table.starts[cases + 1] - table.starts[cases]
    owner = np.repeat(np.arange(len(cells)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    edges = table.edges[table.starts[cases[owner]] + within]  # [T, 3] edge of the cell
    return _edge_numbers(shifted, chunk[cells // VOXELS][owner], (cells % VOXELS)[owner], edges)


def _edge_numbers(shifted: np.ndarray, row: np.ndarray, voxel: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the global numbers of cell edges: 3 * (512 * row + voxel) + axis, of the voxel at the lower end."""
    neighbour, number = _cell_edges()
    at = voxel[:, None] * len(EDGES) + edges
    return shifted[row[:, None], neighbour[at]] * EDGES_OF_BLOCK + number[at]


@cache
def _cell_edges() -> tuple[np.ndarray, np.ndarray]:
    """Return, for each of the 12 edges of the cell at each voxel [512 * 12], the neighbour block and edge number."""
    at = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1)[:, None, :]
    at = at + CORNERS[[corner for _, corner in EDGES]]  # [512, 12, 3] the lower end
    over = at >= BLOCK
    x, y, z = np.moveaxis(at - BLOCK * over, 2, 0)
    number = 3 * ((x * BLOCK + y) * BLOCK + z) + np.array([axis for axis, _ in EDGES])
    return (over @ np.array([1, 2, 4])).reshape(-1), number.reshape(-1)


def _upper_ends(shifted: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the voxel [P] at the upper end of each edge."""
    low, axis = edges // 3, edges % 3
    row, voxel = low // VOXELS, low % VOXELS
    up = np.stack(np.unravel_index(voxel, (BLOCK,) * 3), axis=1) + np.eye(3, dtype=np.int64)[axis]
    over = up >= BLOCK
    up_row = shifted[row, (over * np.array([1, 2, 4])).sum(axis=1)]
    up = up - BLOCK * over
    return np.asarray(up_row * VOXELS + (up[:, 0] * BLOCK + up[:, 1]) * BLOCK + up[:, 2])


def edge_vertices(volume: Volume, edges: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the positions [P, 3] of the zero crossings on edges, and their colours."""
    low = edges // 3
    row, voxel = low // VOXELS, low % VOXELS
    at = np.stack(np.unravel_index(voxel, (BLOCK,) * 3), axis=1)
    step = np.eye(3, dtype=np.int64)[edges % 3]
    tsdf = volume.tsdf.reshape(-1)
    a, b = tsdf[low], tsdf[high]
    t = zero_crossing(a, b)
    grid = volume.blocks[row] * BLOCK + at + t[:, None].astype(np.float64) * step
    vertices = (np.asarray(volume.limits.lower) + grid * volume.limits.voxel).astype(np.float32)
    if volume.color is None or volume.color_weight is None:
        return vertices, None
    colors, weights = volume.color.reshape(-1, 3), volume.color_weight.reshape(-1)
    return vertices, mixed_colors(t, colors[low], colors[high], weights[low] > 0, weights[high] > 0)


def zero_crossing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the position of the zero between values a (0) and b (1) of different sign, kept away from both ends."""
    t = a / np.where(a == b, 1, a - b)  # signs differ, so a != b
    return np.asarray(np.clip(t, _EDGE_GUARD, 1 - _EDGE_GUARD))


def mixed_colors(
    t: np.ndarray, low: np.ndarray, high: np.ndarray, low_has: np.ndarray, high_has: np.ndarray
) -> np.ndarray:
    """Interpolate colours, uint8 [P, 3], at t between two ends; an end without colour has no weight."""
    wa, wb = (1 - t) * low_has, t * high_has
    mixed = (wa[:, None] * low + wb[:, None] * high) / np.maximum(wa + wb, np.float32(1e-12))[:, None]
    return np.rint(np.clip(mixed, 0, 255)).astype(np.uint8)


def components(mesh: Mesh) -> np.ndarray:
    """Label the connected component of each face [F] by size: 0 is the largest. Components share no vertex.

    Of equal components, the one with the lowest face index comes first.
    """
    n, faces = len(mesh.vertices), mesh.faces
    if not len(faces):
        return np.zeros(0, dtype=np.int64)
    ends = (np.concatenate([faces[:, 0], faces[:, 1]]), np.concatenate([faces[:, 1], faces[:, 2]]))
    graph = coo_array((np.ones(len(ends[0]), bool), ends), shape=(n, n)).tocsr()
    del ends
    count, label = connected_components(graph, directed=False)
    del graph
    of_face = label[faces[:, 0]]
    sizes = np.bincount(of_face, minlength=count)
    first = np.full(count, len(faces))
    first[of_face[::-1]] = np.arange(len(faces))[::-1]  # the last assignment wins
    order = np.lexsort((first, -sizes))  # components without faces last
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    return rank[of_face]


def keep_components(mesh: Mesh, *, min_faces: int = 50, keep: int | None = None) -> Mesh:
    """Keep components of at least ``min_faces`` faces, and of those the ``keep`` largest.

    Faces and vertices keep their order; vertices without faces are removed. The mesh may become empty.
    """
    rank = components(mesh)
    sizes = np.bincount(rank) if len(rank) else np.zeros(0, np.int64)
    good = sizes >= min_faces
    if keep is not None:
        good[keep:] = False
    return select_faces(mesh, good[rank])


def select_faces(mesh: Mesh, mask: np.ndarray) -> Mesh:
    """Return the faces where ``mask`` [F] is true, with the vertices they use."""
    faces = mesh.faces[mask]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used) - 1
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32).reshape(-1, 3), colors)


def inside_box(mesh: Mesh, box: np.ndarray) -> Mesh:
    """Keep the faces with all corners in a box [2, 3]; volumes consist of whole blocks and extend beyond it."""
    low, high = np.asarray(box, np.float64)
    inside = ((mesh.vertices >= low) & (mesh.vertices <= high)).all(axis=1)
    return select_faces(mesh, inside[mesh.faces].all(axis=1))
