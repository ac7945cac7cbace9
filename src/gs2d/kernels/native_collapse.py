"""Native edge collapse for ``meshing/simplify.py``."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from gs2d.kernels.library import load

_CANDIDATE_BYTES = 24  # of cpu/collapse.cpp


class CollapseRules(NamedTuple):
    """Where a collapse ends and what it costs; the weights are those of ``meshing/simplify.py``."""

    target: int  # stop at this number of faces
    limit: float  # largest cost, px^2
    length_weight: float  # square of ``LENGTH``
    tint_weight: float  # square of ``TINT``
    border_weight: float  # ``BORDER``
    turn: float  # ``TURN``
    pull: float  # ``PULL``


@dataclass(frozen=True, eq=False)
class CollapseArrays:
    """A mesh and the sums of its vertices, changed in place."""

    points: np.ndarray  # [P, 3] float64
    scale: np.ndarray  # [P] float64, pixels per unit of length
    colors: np.ndarray | None  # [P, 3] float64 in [0, 1]
    corners: np.ndarray  # [F, 3] int32; the first corner of a removed face becomes -1
    # [P, 12] float64: A (6), b (3), c of the sum of a s^2 (n.x + d)^2; then the sums of a and of a s^2.
    quadric: np.ndarray
    color: np.ndarray  # [P, 4] float64, sums of a times the colour (3) and of a times its square

    @classmethod
    def of(cls, points: np.ndarray, faces: np.ndarray, scale: np.ndarray, colors: np.ndarray | None) -> CollapseArrays:
        """Copy a mesh; the sums are zeros."""
        count = len(points)
        return cls(
            np.array(points, np.float64, order="C"),
            np.ascontiguousarray(scale, np.float64),
            None if colors is None else np.ascontiguousarray(colors, np.float64),
            np.array(faces, np.int32, order="C"),
            np.zeros((count, 12)),
            np.zeros((count if colors is not None else 0, 4)),
        )


def collapse(arrays: CollapseArrays, rules: CollapseRules) -> None:
    """Collapse edges in place, with 180 bytes per face of temporary memory."""
    count, faces = len(arrays.points), len(arrays.corners)
    capacity = 3 * faces  # edges of separate triangles
    work = {name: np.empty(count, np.int32) for name in ("head", "tail", "stamp", "mark")}
    work |= {"border": np.empty(count, np.uint8), "next": np.empty(3 * faces, np.int32)}
    work["heap"] = np.empty(capacity * _CANDIDATE_BYTES, np.uint8)
    inputs = {field.name: getattr(arrays, field.name) for field in fields(arrays)}
    sizes = {"vertices": count, "faces": faces, "capacity": capacity}
    load().call("gs2d_collapse", **sizes, **rules._asdict(), **inputs, **work)
