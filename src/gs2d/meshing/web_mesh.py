"""Meshes for browsers: simplified, quantised and in one block of bytes, for the viewer and the report."""

from __future__ import annotations

import io
import json

import numpy as np
from PIL import Image

from gs2d.core.mesh import Mesh, TexturedMesh

QUANTIZATION_STEPS = 65535  # of a coordinate, and of a texture coordinate
JPEG_QUALITY = 88


def web_mesh(mesh: Mesh | TexturedMesh, *, max_texture: int | None = None) -> bytes:
    """Return a mesh with at least one vertex as the pages of gs2d read it.

    The block holds, in this order and without gaps: the length of the header (uint32), the header (JSON, padded with
    spaces to a multiple of 4 bytes), faces [F, 3] uint32, vertices [P, 3] uint16, then colours [P, 3] uint8, or texture
    coordinates [P, 2] uint16 and a JPEG file. The header has the counts ``faces`` and ``vertices``, the bounding box as
    ``low`` and ``size``, and ``paint``: "color", "texture" or "none". Textures with a longer side than ``max_texture``
    (px) are reduced.
    """
    low = mesh.vertices.min(axis=0).astype(np.float64)
    size = np.maximum(mesh.vertices.max(axis=0) - low, 1e-30)
    paint, painted = _paint(mesh, max_texture)
    header = {
        "faces": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "low": low.tolist(),
        "size": size.tolist(),
        "paint": paint,
    }
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    vertices = np.round((mesh.vertices - low) / size * QUANTIZATION_STEPS).astype("<u2")
    length = np.array([len(text)], "<u4")
    return b"".join([length.tobytes(), text, mesh.faces.astype("<u4").tobytes(), vertices.tobytes(), painted])


def _paint(mesh: Mesh | TexturedMesh, max_texture: int | None) -> tuple[str, bytes]:
    """Return what colours the mesh, and its bytes."""
    if isinstance(mesh, TexturedMesh):
        texture = Image.fromarray(mesh.texture)
        if max_texture is not None:
            texture.thumbnail((max_texture, max_texture), Image.Resampling.BOX)
        file = io.BytesIO()
        texture.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        uv = np.round(np.clip(mesh.uv, 0, 1) * QUANTIZATION_STEPS).astype("<u2")
        return "texture", uv.tobytes() + file.getvalue()
    if mesh.colors is None:
        return "none", b""
    return "color", np.ascontiguousarray(mesh.colors, np.uint8).tobytes()
