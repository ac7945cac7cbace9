"""Native Delaunay tetrahedra, votes of lines of sight, and minimum cut."""

from __future__ import annotations

import numpy as np

from gs2d.errors import ProtocolError
from gs2d.kernels.c_structures import arguments_of
from gs2d.kernels.library import Library

ROWS_A_POINT = 9  # tetrahedra; samples of a surface have six to seven


def tetrahedra_on_cpu(library: Library, grid: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners and neighbours, [T, 4] int32, of the tetrahedra of grid points [P + 8, 3] int32.

    The last eight points are the corners of a cube around the others, x fastest; ``order`` [P] int32 is that of
    insertion.
    """
    count = ROWS_A_POINT
    while True:
        capacity = count * len(grid) + 1000
        corners, neighbours = np.empty((capacity, 4), np.int32), np.empty((capacity, 4), np.int32)
        inserted = np.zeros(len(grid), np.uint8)
        arrays = {"xyz": grid, "order": order, "corners": corners, "neighbours": neighbours, "inserted": inserted}
        arguments = arguments_of("gs2d_tetrahedra", **arrays, points=len(grid), capacity=capacity)
        library.call("gs2d_tetrahedra", arguments)
        if arguments.count >= 0:
            break
        count *= 2
    corners, neighbours = corners[: arguments.count], neighbours[: arguments.count]
    used = corners[:, 0] >= 0
    number = np.cumsum(used, dtype=np.int32) - 1
    neighbours = neighbours[used]
    return corners[used], np.where(neighbours >= 0, number[neighbours], -1).astype(np.int32)


def votes_on_cpu(library: Library, arrays: dict[str, np.ndarray], surfaces: int) -> None:
    """Add the votes of lines of sight, of which the first ``surfaces`` end on a surface.

    ``arrays`` has the names and types of the fields of ``VoteArguments``; ``facets``, ``full`` and ``cameras`` change
    in place.
    """
    library.call("gs2d_votes", lines=len(arrays["ends"]), surfaces=surfaces, **arrays)


def minimum_cut_on_cpu(
    library: Library, neighbours: np.ndarray, mirror: np.ndarray, capacity: np.ndarray, terminal: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the source side [N] bool and the flow; ``capacity`` and ``terminal`` become what is left."""
    side = np.zeros(len(neighbours), np.uint8)
    arrays = {"neighbours": neighbours, "mirror": mirror, "capacity": capacity, "terminal": terminal}
    arguments = arguments_of("gs2d_minimum_cut", **arrays, source_side=side, nodes=len(neighbours))
    library.call("gs2d_minimum_cut", arguments)
    if arguments.flow < 0:
        raise ProtocolError("the minimum cut needs more memory than there is; a lower --memory makes fewer points")
    return side.astype(bool), int(arguments.flow)
