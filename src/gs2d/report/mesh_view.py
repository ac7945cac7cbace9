"""The mesh of a run for the viewer of the report: simplified, quantised, compressed."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.core.transforms import up_direction
from gs2d.data.subject_box import read_subject
from gs2d.io.meshes import read_mesh, read_textured
from gs2d.io.run_dir import MESH, TEXTURED
from gs2d.meshing.simplify import collapse
from gs2d.report.mesh_images import mesh_images, orbit_cameras

MAX_FACES = 4_000_000  # larger meshes would take gigabytes to draw
SHOWN_FACES = 60_000  # about 0.6 MB in the page
_STEPS = 65535  # of a coordinate


@dataclass(frozen=True, eq=False)
class MeshView:
    """What the page needs to draw a mesh.

    Attributes
    ----------
    image : ndarray [H, W, 3] float32
        The mesh from the first camera, for browsers without WebGL.
    facts : str
        JSON: counts, box, centre, start of the orbit.
    data : str
        Base64 of gzip of: faces [F, 3] uint32, vertices [P, 3] uint16, colours [P, 3] uint8.
    faces : int
        Faces of the whole mesh.
    shown : int
        Faces in ``data``.
    """

    image: np.ndarray
    facts: str
    data: str
    faces: int
    shown: int


def mesh_view(run: Path, cameras: Sequence[Camera]) -> MeshView | str:
    """Return the mesh of a run for the page, or why there is none.

    Parameters
    ----------
    run : Path
        Run folder.
    cameras : sequence of Camera
        The orbit starts at the first camera. Empty: above the mesh, with the third axis up.

    Raises
    ------
    DataError
        If a mesh file is broken.
    """
    path = run / MESH
    if not path.is_file():
        return "There is no mesh.ply. `gs2d mesh RUN` writes it."
    mesh = read_mesh(path)
    if not len(mesh.faces):
        return "mesh.ply has no faces: no surface was covered well enough."
    if len(mesh.faces) > MAX_FACES:
        return f"mesh.ply has {len(mesh.faces):,} faces, too many to draw here (at most {MAX_FACES:,})."
    textured = read_textured(run / TEXTURED) if (run / TEXTURED).is_file() else None
    camera = cameras[0] if cameras else orbit_cameras(mesh)[0]
    drawn = mesh_images(mesh, [camera], textured, width=640)[0]
    small = _simplified(mesh)
    low, high = small.vertices.min(axis=0), small.vertices.max(axis=0)
    size = np.maximum(high - low, 1e-30)
    subject = read_subject(run)
    up = np.array([0.0, 0.0, 1.0]) if not cameras else subject.up if subject is not None else up_direction(cameras)
    facts = {
        "faces": len(small.faces),
        "vertices": len(small.vertices),
        "low": low.tolist(),
        "size": size.tolist(),
        **_orbit(mesh, camera, up),
    }
    colors = small.colors if small.colors is not None else np.full((len(small.vertices), 3), 220, np.uint8)
    parts = (
        small.faces.astype(np.uint32),
        np.round((small.vertices - low) / size * _STEPS).astype(np.uint16),
        colors,
    )
    packed = gzip.compress(b"".join(np.ascontiguousarray(part).tobytes() for part in parts), mtime=0)
    image = drawn.shape if drawn.color is None else drawn.color
    return MeshView(image, json.dumps(facts), base64.b64encode(packed).decode(), len(mesh.faces), len(small.faces))


def _orbit(mesh: Mesh, camera: Camera, up: np.ndarray) -> dict[str, Any]:
    """Return centre, radius, up direction and the first position of the eye."""
    low, high = np.percentile(mesh.vertices, [1, 99], axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    arm = camera.center - center
    distance = max(float(np.linalg.norm(arm)), 0.3 * radius)
    eye = center + arm / max(float(np.linalg.norm(arm)), 1e-12) * min(distance, 4 * radius)
    return {"center": center.tolist(), "radius": radius, "up": up.tolist(), "eye": eye.tolist()}


def _simplified(mesh: Mesh) -> Mesh:
    """Return the mesh with about ``SHOWN_FACES`` faces at most; a vertex takes the colour of the nearest one."""
    if len(mesh.faces) <= SHOWN_FACES:
        return mesh
    from scipy.spatial import cKDTree

    points, faces = collapse(mesh.vertices, mesh.faces, SHOWN_FACES)
    if not len(faces):
        return mesh
    colors = None if mesh.colors is None else mesh.colors[cKDTree(mesh.vertices).query(points)[1]]
    return Mesh(points, faces.astype(np.int32), colors)
