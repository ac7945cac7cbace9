"""Split a mesh into convex pieces for collision tests, with CoACD (Wei et al., SIGGRAPH 2022)."""

from __future__ import annotations

from typing import Any

import numpy as np

from gs2d.core import extras
from gs2d.core.mesh import Mesh
from gs2d.errors import ProtocolError
from gs2d.meshing.simplify import simplify

CONCAVITY = 0.05  # largest depth of a dent that a piece fills, of the size of the mesh: the default of CoACD
FACES = 20_000  # of the mesh that is split; the pieces are coarser


def required() -> Any:
    """Import the package of the extra ``collision``, or raise BackendError."""
    return extras.required("collision", "coacd", "--collision", "leave --collision out")


def convex_pieces(mesh: Mesh) -> list[Mesh]:
    """Return convex meshes that together fill the volume of a mesh. Open meshes are closed first."""
    coacd = required()
    if not len(mesh.faces):
        raise ProtocolError("--collision needs a mesh with faces, got an empty mesh; extract it with other limits")
    small = simplify(Mesh(mesh.vertices, mesh.faces), faces=FACES)
    vertices = small.vertices.astype(np.float64)
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh((vertices - middle) / size, small.faces), threshold=CONCAVITY)
    return [Mesh(np.asarray(points) * size + middle, np.asarray(faces, np.int32)) for points, faces in pieces]
