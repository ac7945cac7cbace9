"""The mesh of a run for the first screen of the report."""

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
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.core.transforms import up_direction
from gs2d.data.subject_box import read_subject
from gs2d.io.meshes import read_mesh, read_textured
from gs2d.io.run_dir import MESH, TEXTURED
from gs2d.meshing.simplify import simplify
from gs2d.meshing.web_mesh import web_mesh

MAX_FACES = 4_000_000  # larger meshes need gigabytes of memory to simplify
SHOWN_FACES = 60_000  # about 0.6 MB in the page
SHOWN_TEXTURE = 2048  # px, side of the texture in the page
ABOVE = (0.4, -0.8, 0.45)  # direction of the first view of a run without cameras; the third axis is up


@dataclass(frozen=True, eq=False)
class MeshView:
    """A mesh as the page reads it."""

    orbit: str  # JSON: centre, radius, up direction and first position of the eye
    data: str  # base64 of a gzip file of a ``meshing.web_mesh`` block
    faces: int  # faces of the whole mesh
    shown: int  # faces in ``data``
    is_textured: bool = False


def mesh_view(run: Path, cameras: Sequence[Camera]) -> MeshView | str:
    """Return the mesh of a run for the page, textured if there is a texture, or the reason why there is none.

    Raise DataError if the mesh file is broken. ``run``: run folder. ``cameras``: the orbit starts at the first camera.
    Empty: above the mesh, with the third axis up.
    """
    path = run / MESH
    if not path.is_file():
        return "There is no mesh.ply. `gs2d mesh RUN` writes it."
    if (run / TEXTURED).is_file():
        textured = read_textured(run / TEXTURED)
        if 0 < len(textured.faces) <= SHOWN_FACES:
            orbit, faces = json.dumps(_orbit(textured, run, cameras)), len(textured.faces)
            return MeshView(
                orbit, _packed(web_mesh(textured, max_texture=SHOWN_TEXTURE)), faces, faces, is_textured=True
            )
    mesh = read_mesh(path)
    if not len(mesh.faces):
        return "mesh.ply has no faces: no surface was visible in enough photographs."
    if len(mesh.faces) > MAX_FACES:
        return f"mesh.ply has {len(mesh.faces):,} faces; the report shows at most {MAX_FACES:,}. Use `gs2d view RUN`."
    small = simplify(mesh, faces=SHOWN_FACES)
    orbit = json.dumps(_orbit(mesh, run, cameras))
    return MeshView(orbit, _packed(web_mesh(small)), len(mesh.faces), len(small.faces))


def _packed(block: bytes) -> str:
    return base64.b64encode(gzip.compress(block, mtime=0)).decode()


def _orbit(mesh: Mesh | TexturedMesh, run: Path, cameras: Sequence[Camera]) -> dict[str, Any]:
    """Return centre, radius, up direction and first position of the eye."""
    low, high = np.percentile(mesh.vertices, [1, 99], axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    arm, up = 3 * radius * np.array(ABOVE), np.array([0.0, 0.0, 1.0])
    if cameras:
        subject = read_subject(run)
        arm, up = cameras[0].center - center, up_direction(cameras) if subject is None else subject.up
    length = max(float(np.linalg.norm(arm)), 1e-12)
    eye = center + arm / length * np.clip(length, 0.3 * radius, 4 * radius)
    return {"center": center.tolist(), "radius": radius, "up": up.tolist(), "eye": eye.tolist()}
