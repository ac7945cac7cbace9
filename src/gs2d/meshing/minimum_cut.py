"""Label tetrahedra as inside or outside: lines of sight vote, and a minimum cut decides.

A line from a camera to a point that it sees crosses facets in free space: a surface there costs the weight of the line,
but little close to the point, whose depth is uncertain (soft visibility of Labatut et al. 2009). The tetrahedron one
sigma behind the point is inside, that of the camera outside. Lines to the sky vote for free space alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gs2d.errors import ProtocolError
from gs2d.kernels.c_structures import arguments_of
from gs2d.kernels.library import Library
from gs2d.meshing.tetrahedra import FACES, Tetrahedra

UNIT = 128  # whole-number weight of a line with weight 1
MOST = 1 << 28  # of a vote or a shape: two arcs with both and their flows fit into 32 bits
QUALITY = 2.0  # cost of a facet between two flat tetrahedra, in lines; 1 to 5 give the same Chamfer distance
AREA = 0.05  # cost of the area of a point, in lines: closes what no view shows with little area
ROWS_AT_ONCE = 1 << 17


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines from points to cameras."""

    ends: np.ndarray  # [L] int32 points, as rows of ``Tetrahedra.xyz``
    starts: np.ndarray  # [L, 3] float64 camera centres, world units
    sigma: np.ndarray  # [L] float64 uncertainty of the points along the lines, world units
    weights: np.ndarray  # [L]
    surfaces: int  # the first lines end on a surface, the others in free space


def cast_votes(space: Tetrahedra, lines: Lines, library: Library) -> dict[str, np.ndarray]:
    """Return the votes of all lines, in units of 1 / ``UNIT``.

    They are ``facets`` [T, 4] int32, the cost of a facet with its tetrahedron outside and the neighbour inside;
    ``full`` [T] int32, the cost of a tetrahedron outside; and ``cameras`` [T] uint8, 1 where a line starts.
    """
    count = len(space.corners)
    order = np.argsort(lines.ends[: lines.surfaces], kind="stable")  # neighbours walk through the same memory
    order = np.concatenate([order, np.arange(lines.surfaces, len(lines.ends))])
    votes: dict[str, np.ndarray] = {
        "facets": np.zeros((count, 4), np.int32),
        "full": np.zeros(count, np.int32),
        "cameras": np.zeros(count, np.uint8),
    }
    arrays = {
        "xyz": space.xyz,
        "corners": space.corners,
        "neighbours": space.neighbours,
        "mirror": space.mirror,
        "first": space.first(),
        "ends": np.ascontiguousarray(lines.ends[order], np.int32),
        "starts": np.ascontiguousarray(lines.starts[order]),
        "sigma": lines.sigma[order].astype(np.float64),
        "weight": np.rint(UNIT * lines.weights[order]).astype(np.int32),
    }
    library.call("gs2d_votes", lines=len(order), surfaces=lines.surfaces, **arrays, **votes)
    return votes


def outside(
    space: Tetrahedra, votes: Mapping[str, np.ndarray], library: Library, *, spacing: np.ndarray, closed: bool = False
) -> np.ndarray:
    """Return which tetrahedra are outside, [T] bool, by the votes of ``cast_votes``.

    ``spacing`` [P] is the distance from each point on the surface to the next, world units; the other corners have the
    median. If ``closed``, the corners of the cube are outside, so the surface is closed.
    """
    cost = QUALITY / 2 * _badness(space) + AREA * _areas(space, spacing)
    shape = np.rint(np.minimum(UNIT * cost, MOST)).astype(np.int32)
    # of the arcs to the neighbours, and from the source or, if negative, to the sink
    capacity = np.where(space.neighbours >= 0, np.minimum(votes["facets"], MOST) + shape, 0).astype(np.int32)
    terminal = -np.minimum(votes["full"], MOST)
    terminal[votes["cameras"] > 0] = MOST
    if closed:
        terminal[(space.corners >= len(space.xyz) - 8).any(axis=1)] = MOST
    return minimum_cut_on_cpu(library, space.neighbours, space.mirror, capacity, terminal)[0]


def minimum_cut_on_cpu(
    library: Library, neighbours: np.ndarray, mirror: np.ndarray, capacity: np.ndarray, terminal: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the source side [N] bool and the flow; ``capacity`` and ``terminal`` become the residual capacities."""
    side = np.zeros(len(neighbours), np.uint8)
    arrays = {"neighbours": neighbours, "mirror": mirror, "capacity": capacity, "terminal": terminal}
    arguments = arguments_of("gs2d_minimum_cut", **arrays, source_side=side, nodes=len(neighbours))
    library.call("gs2d_minimum_cut", arguments)
    if arguments.flow < 0:
        raise ProtocolError("the minimum cut needs more memory than there is; a lower --memory makes fewer points")
    return side.astype(bool), int(arguments.flow)


def _areas(space: Tetrahedra, spacing: np.ndarray) -> np.ndarray:
    """Return the areas of the facets, in squares of the largest spacing of their corners, [T, 4] float32."""
    spacings = np.full(len(space.xyz), np.median(spacing))
    spacings[: len(spacing)] = spacing
    areas = np.empty(space.corners.shape, np.float32)
    for k in range(4):
        rows = space.corners[:, FACES[k]]
        p, q, r = (space.xyz[rows[:, i]] for i in range(3))
        areas[:, k] = 0.5 * np.linalg.norm(np.cross(q - p, r - p), axis=1) / spacings[rows].max(axis=1) ** 2
    return areas


def _badness(space: Tetrahedra) -> np.ndarray:
    """Return 1 - min cos of the angles at which the circumspheres on both sides meet each facet, [T, 4] in [0, 2].

    It is small for facets of a densely sampled smooth surface (Labatut et al. 2009).
    """
    cosine = np.empty(space.corners.shape, np.float32)
    for start in range(0, len(cosine), ROWS_AT_ONCE):
        corners = space.xyz[space.corners[start : start + ROWS_AT_ONCE]]
        arms = corners[:, 1:] - corners[:, :1]
        squares = (arms**2).sum(axis=2)
        crosses = [np.cross(arms[:, 1], arms[:, 2]), np.cross(arms[:, 2], arms[:, 0]), np.cross(arms[:, 0], arms[:, 1])]
        volume = np.maximum((arms[:, 0] * crosses[0]).sum(axis=1), 1e-300)
        center = sum(squares[:, k : k + 1] * crosses[k] for k in range(3)) / (2 * volume[:, None])
        radius = np.maximum(np.linalg.norm(center, axis=1), 1e-300)
        center = center + corners[:, 0]
        for k in range(4):
            p, q, r = (corners[:, i] for i in FACES[k])
            normal = np.cross(q - p, r - p)
            height = ((center - p) * normal).sum(axis=1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
            cosine[start : start + ROWS_AT_ONCE, k] = height / radius
    beyond = np.where(space.neighbours >= 0, cosine[space.neighbours, space.mirror], 1)
    return np.asarray(np.clip(1 - np.minimum(cosine, beyond), 0, 2))
