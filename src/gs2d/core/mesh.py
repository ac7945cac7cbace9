"""Triangle meshes: with vertex colours, or with a texture."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from gs2d.core.checks import check_shapes


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, with optional vertex colours.

    Attributes
    ----------
    vertices : ndarray [P, 3] float32 or float64, world units
    faces : ndarray [F, 3] int32
        Vertex indices, counter-clockwise seen from outside.
    colors : ndarray [P, 3] uint8 or None
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None

    def __post_init__(self) -> None:
        colors = {} if self.colors is None else {"colors": (self.colors, "P 3")}
        check_shapes({"vertices": (self.vertices, "P 3"), "faces": (self.faces, "F 3"), **colors})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the mesh to a file: .ply or .glb.

        Parameters
        ----------
        path : path

        Raises
        ------
        DataError
            If the name has another suffix.
        DiskError
            If the file could not be written.

        Examples
        --------
        >>> gs2d.extract_mesh(trained).save("garden.ply")  # doctest: +SKIP
        """
        import gs2d  # the writers are in a higher layer

        gs2d.write_mesh(path, self)


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles with a texture. A vertex on a seam of the texture exists once for each side."""

    vertices: np.ndarray  # [P, 3] float, world units
    normals: np.ndarray  # [P, 3] float32, unit
    faces: np.ndarray  # [F, 3] int32, vertex indices, counter-clockwise seen from outside
    uv: np.ndarray  # [P, 2] float32, (0, 0) at the upper left and (1, 1) at the lower right corner, as in glTF
    texture: np.ndarray  # [S, S, 3] uint8, sRGB

    def __post_init__(self) -> None:
        check_shapes(
            {
                "vertices": (self.vertices, "P 3"),
                "normals": (self.normals, "P 3"),
                "faces": (self.faces, "F 3"),
                "uv": (self.uv, "P 2"),
                "texture": (self.texture, "S S 3"),
            }
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the mesh with its texture to a file: .glb, or .obj with .mtl and .png beside it.

        Raises DataError if the name has another suffix, DiskError if a file could not be written.
        """
        import gs2d  # the writers are in a higher layer

        gs2d.write_mesh(path, self)
