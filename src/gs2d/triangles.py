"""The triangle mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.check import check_shapes


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, with optional vertex colours.

    Attributes
    ----------
    vertices : ndarray [P, 3] float32 or float64, wu
    faces : ndarray [F, 3] int32
        Vertex indices, counter-clockwise seen from outside.
    colors : ndarray [P, 3] uint8 or None
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_shapes({"vertices": (self.vertices, "P 3"), "faces": (self.faces, "F 3")})
        if self.colors is not None:
            check_shapes({"vertices": (self.vertices, "P 3"), "colors": (self.colors, "P 3")})
