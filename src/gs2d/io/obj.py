"""Wavefront OBJ meshes: positions and faces, nothing else."""

from __future__ import annotations

import os
from itertools import pairwise

import numpy as np

from gs2d.core.mesh import Mesh
from gs2d.errors import DataError


def read_obj(path: str | os.PathLike[str]) -> Mesh:
    """Read the ``v`` and ``f`` lines of an OBJ file; polygons become triangle fans.

    Vertices [P, 3] are float64 and stay as the file splits them (a texture seam splits no ``v``). Negative indices
    count back from the last vertex read, as the format says.

    Raises
    ------
    DataError
        If the file is missing, a line is malformed, or there are no faces.
    """
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, 1):
                words = line.split("#", 1)[0].split()
                if not words or words[0] not in ("v", "f"):
                    continue
                try:
                    if words[0] == "v":
                        vertices.append((float(words[1]), float(words[2]), float(words[3])))
                    else:
                        corners = [_index(word, len(vertices)) for word in words[1:]]
                        faces += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
                except (ValueError, IndexError) as error:
                    raise DataError(
                        f"{path}: line {number} is no vertex or face ({line.strip()[:60]!r}); export the mesh again"
                    ) from error
    except OSError as error:
        raise DataError(f"{path}: an OBJ file was expected, it cannot be read: {error.strerror}") from error
    if not faces:
        raise DataError(f"{path}: a mesh was expected, the file has no faces; give a triangle mesh")
    triangles = np.array(faces, dtype=np.int64)
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise DataError(f"{path}: vertex indices up to {len(vertices)} were expected, got {triangles.max() + 1}")
    return Mesh(np.array(vertices, dtype=np.float64), triangles.astype(np.int32))


def _index(word: str, n_vertices: int) -> int:
    """0-based vertex index of a face corner such as ``7``, ``7/2`` or ``-1//3``."""
    index = int(word.split("/", 1)[0])
    return index - 1 if index > 0 else n_vertices + index
