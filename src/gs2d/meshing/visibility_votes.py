"""Votes of lines of sight for tetrahedra inside and outside the surface.

A line from a camera to a point that it sees crosses facets in free space: a surface there costs the weight of the line,
but little close to the point, whose depth is uncertain (soft visibility of Labatut et al. 2009). The tetrahedron one
sigma behind the point is inside, that of the camera outside. Lines to the sky vote for free space alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.kernels.library import Library
from gs2d.kernels.native_tetrahedra import votes_on_cpu
from gs2d.meshing.tetrahedra import Tetrahedra

UNIT = 128  # whole-number weight of a line with weight 1


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines from points to cameras.

    Attributes
    ----------
    ends : ndarray [L] int32
        Points, as rows of ``Tetrahedra.xyz``.
    starts : ndarray [L, 3] float64, world units
        Camera centres.
    sigma : ndarray [L] float64, world units
        Uncertainty of the points along the lines.
    weights : ndarray [L] float
    surfaces : int
        The first lines end on a surface, the others in free space.
    """

    ends: np.ndarray
    starts: np.ndarray
    sigma: np.ndarray
    weights: np.ndarray
    surfaces: int


def cast_votes(space: Tetrahedra, lines: Lines, library: Library) -> dict[str, np.ndarray]:
    """Return the votes of all lines, in units of 1 / ``UNIT``.

    Returns
    -------
    dict of str to ndarray
        ``facets`` [T, 4] int32: cost of a facet with its tetrahedron outside and the neighbour inside. ``full`` [T]
        int32: cost of a tetrahedron outside. ``cameras`` [T] uint8: 1 where a line starts.
    """
    count = len(space.corners)
    order = np.argsort(lines.ends[: lines.surfaces], kind="stable")  # neighbours walk through the same memory
    order = np.concatenate([order, np.arange(lines.surfaces, len(lines.ends))])
    votes = {
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
    votes_on_cpu(library, arrays | votes, lines.surfaces)
    return votes
