"""Read and write meshes: PLY; OBJ, STL and OFF (read by trimesh); glTF and OBJ with a texture."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import re
import struct
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gs2d.core.atomic_files import atomic_write
from gs2d.core.json_files import read_bytes
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.core.text import first_line
from gs2d.errors import DataError
from gs2d.io.ply_format import PlyElement, PlyList, read_ply, write_ply

COLORS = ("red", "green", "blue")
FOREIGN = (".obj", ".stl", ".off")  # read by trimesh
SUFFIXES = (".glb", ".obj")  # suffixes of textured meshes
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942  # "glTF", "JSON", "BIN\0"
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123  # component types
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view: ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER
_SRGB = np.arange(256) / 255
LINEAR_U16 = np.rint(65535 * np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)).astype("<u2")
_CLAMP, _LINEAR, _MIPMAPS = 33071, 9729, 9987  # CLAMP_TO_EDGE, LINEAR, LINEAR_MIPMAP_LINEAR


@dataclass(frozen=True, eq=False)
class Points:
    """A point cloud: ``points`` [P, 3] float64 world units, with optional ``colors`` and ``normals``."""

    points: np.ndarray
    colors: np.ndarray | None = None  # [P, 3] uint8
    normals: np.ndarray | None = None  # [P, 3] float64


def write_mesh(
    path: str | os.PathLike[str],
    mesh: Mesh | TexturedMesh,
    *,
    up: np.ndarray | None = None,
    coarser: Sequence[Mesh] = (),
) -> None:
    """Write a triangle mesh with vertex colours or a texture. The file is written completely or not at all.

    Parameters
    ----------
    path : path
        For a Mesh, ends in .ply (vertices float32 or float64) or .glb (glTF 2.0, vertices float32). For a
        TexturedMesh, ends in .glb or .obj, which gets an .mtl and a .png file of the same name.
    mesh : Mesh or TexturedMesh
    up : ndarray [3], optional
        Up direction of the mesh. The node of a .glb is rotated so that viewers, which expect y up, show it upright; the
        vertices do not change.
    coarser : sequence of Mesh
        Further levels of detail of a .glb, see ``glb_bytes``.

    Raises
    ------
    DataError
        If the name has another suffix.
    DiskError
        If the file could not be written.

    Examples
    --------
    >>> gs2d.write_mesh("garden.ply", gs2d.extract_mesh(trained))  # doctest: +SKIP
    """
    path = Path(path)
    if isinstance(mesh, TexturedMesh) and len(written_files(path)) > 1:
        _write_obj(path, mesh)
    elif path.suffix.lower() == ".glb":
        with atomic_write(path) as file:
            file.write(glb_bytes(mesh, up=up, coarser=coarser))
    elif path.suffix.lower() == ".ply" and isinstance(mesh, Mesh):
        _write_ply(path, mesh)
    else:
        raise DataError(f"a mesh is written as .ply or .glb, got {path}; choose such a name")


def _write_ply(path: Path, mesh: Mesh) -> None:
    real = "<f8" if mesh.vertices.dtype == np.float64 else "<f4"
    fields = [(name, real) for name in "xyz"]
    if mesh.colors is not None:
        fields += [(name, "u1") for name in COLORS]
    vertices = np.empty(len(mesh.vertices), dtype=fields)
    for i, name in enumerate("xyz"):
        vertices[name] = mesh.vertices[:, i]
    if mesh.colors is not None:
        for i, name in enumerate(COLORS):
            vertices[name] = mesh.colors[:, i]
    faces = np.empty(len(mesh.faces), dtype=[("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces  # the only property, because common readers understand no others
    write_ply(path, {"vertex": vertices, "face": faces})


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh from PLY, OBJ, STL or OFF. Polygons become triangles; other properties are ignored.

    Vertices are float32, or float64 if the file has doubles or is no PLY. Raises DataError if the file is broken, has
    vertices but no faces, or a face refers to a missing vertex.
    """
    if Path(path).suffix.lower() in FOREIGN:
        return _read_foreign(Path(path))
    file = read_ply(path)
    vertex, face = file.elements.get("vertex"), file.elements.get("face")
    positions = vertex.scalars("x", "y", "z") if vertex else None
    if vertex is None or positions is None:
        raise DataError(f"{path}: expected a mesh, got a PLY without vertex positions; use a triangle mesh")
    if face is None or (face.count == 0 and vertex.count > 0):  # without vertices, it is an empty mesh
        raise DataError(f"{path}: expected a mesh, got a PLY without faces (points or splats); use a mesh")
    lists = face.properties.get("vertex_indices", face.properties.get("vertex_index"))
    if not isinstance(lists, PlyList):
        raise DataError(f"{path}: expected faces with a list vertex_indices, got {sorted(face.properties)}")
    if lists.values.dtype.kind == "f":
        raise DataError(f"{path}: expected integers as vertex indices, got {lists.values.dtype}")
    faces = triangulate(lists.counts, lists.values)
    _check_indices(path, faces, vertex.count)
    dtype = np.float64 if vertex.scalar("x").dtype == np.float64 else np.float32
    return Mesh(positions.astype(dtype), faces.astype(np.int32), _colors(vertex))


def _check_indices(path: str | os.PathLike[str], faces: np.ndarray, count: int) -> None:
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise DataError(f"{path}: expected vertex indices from 0 to {count - 1}, got {faces.min()} to {faces.max()}")


@contextlib.contextmanager
def _quiet_trimesh() -> Iterator[None]:
    """Suppress numpy's warnings, and tracebacks that trimesh logs before it continues."""
    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


def _read_foreign(path: Path) -> Mesh:
    """Read a mesh with trimesh, keeping the order of the vertices."""
    import trimesh  # slow to import (0.6 s)

    data = read_bytes(path)
    kind = path.suffix.lower().lstrip(".")
    if kind == "obj":  # trimesh reads a comment behind a face as one of its corners
        data = re.sub(rb"#[^\n]*", b"", data)
    try:
        with _quiet_trimesh():
            loaded = trimesh.load_mesh(
                io.BytesIO(data), file_type=kind, process=False, maintain_order=True, skip_materials=True
            )
        vertices, faces = np.array(loaded.vertices, np.float64), np.array(loaded.faces, np.int64)
        visual: Any = loaded.visual
        colors = np.array(visual.vertex_colors, np.uint8)[:, :3] if visual.kind == "vertex" else None
    except Exception as error:  # its parsers raise many kinds
        reason = first_line(error)
        raise DataError(f"{path}: expected a mesh, but trimesh cannot read it ({reason}); export it again") from error
    if not len(faces):
        raise DataError(f"{path}: expected a mesh, got a file without faces; use a triangle mesh")
    _check_indices(path, faces, len(vertices))
    return Mesh(vertices, faces.astype(np.int32), colors)


def triangulate(counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Split polygons, stored as ``counts`` [n] and flat ``indices``, into triangle fans [F, 3]."""
    counts = np.asarray(counts, dtype=np.int64)
    fans = np.maximum(counts - 2, 0)  # number of triangles of each polygon
    first = np.repeat(np.cumsum(counts) - counts, fans)  # flat position of the polygon's first index
    k = np.arange(len(first)) - np.repeat(np.cumsum(fans) - fans, fans)  # index of the triangle in its polygon
    return np.stack([indices[first], indices[first + k + 1], indices[first + k + 2]], axis=1).astype(np.int64)


def _colors(vertex: PlyElement) -> np.ndarray | None:
    """Return vertex colours as uint8."""
    colors = vertex.colors()
    return None if colors is None else np.rint(255.0 * colors).astype(np.uint8)


def read_points(path: str | os.PathLike[str]) -> Points:
    """Read the vertices of any PLY file as a point cloud.

    Raises DataError if the file is broken or has no vertex positions.
    """
    vertex = read_ply(path).elements.get("vertex")
    positions = vertex.scalars("x", "y", "z") if vertex else None
    if vertex is None or positions is None:
        raise DataError(f"{path}: expected points, got a PLY without vertex positions; use a point cloud")
    return Points(positions, _colors(vertex), vertex.scalars("nx", "ny", "nz"))


def written_files(path: Path) -> tuple[Path, ...]:
    """Return the files that ``write_mesh`` creates for a textured mesh.

    Raises DataError if the suffix is neither .glb nor .obj, or an OBJ file cannot refer to the name.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DataError(f"a textured mesh is written as .glb or .obj, got {path}; choose such a name")
    if suffix == ".glb":
        return (path,)
    if any(letter.isspace() for letter in path.name):
        raise DataError(f"the name of an OBJ file must not contain spaces, got {path.name!r}; rename it, or use .glb")
    return path, path.with_suffix(".mtl"), path.with_suffix(".png")


def glb_bytes(mesh: Mesh | TexturedMesh, *, up: np.ndarray | None = None, coarser: Sequence[Mesh] = ()) -> bytes:
    """Return a mesh with its texture (PNG) or vertex colours as the bytes of a binary glTF 2.0 file.

    The material is unlit (KHR_materials_unlit), because the colours contain the light of the photographs. Viewers
    without the extension show a rough, non-metallic surface. Vertex colours are linear in glTF (3.7.2.1), 16 bits here.
    ``coarser`` meshes without textures are levels of detail (MSFT_lod) of nodes beside the scene: viewers without the
    extension show ``mesh``. Each is shown where the last one covers less than a sixteenth of the area.
    """
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, Any] = {"pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}}
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "gs2d"}, "materials": [material]}
    turned = {} if up is None else {"rotation": _rotation_to_y(up)}
    blobs: list[tuple[bytes, dict[str, int]]] = []
    accessors: list[dict[str, Any]] = []
    meshes, nodes = [], []
    for number, level in enumerate((mesh, *coarser)):
        attributes = {}
        for name, blob, kind in _glb_attributes(level):
            attributes[name] = len(accessors)
            accessors.append({"bufferView": len(blobs), "count": len(level.vertices), **kind})
            blobs.append((blob, {"target": _VERTICES}))
        primitive = {"attributes": attributes, "indices": len(accessors), "material": 0}
        corners = {"componentType": _UINT, "count": level.faces.size, "type": "SCALAR"}
        accessors.append({"bufferView": len(blobs), **corners})
        blobs.append((np.ascontiguousarray(level.faces, "<u4").tobytes(), {"target": _INDICES}))
        meshes.append({"primitives": [primitive]})
        nodes.append({"mesh": number, **turned})
    used = ["KHR_materials_unlit"]
    if coarser:
        used.append("MSFT_lod")
        coverage = [16.0 ** -(number + 1) for number in range(len(coarser))]
        nodes[0] |= {
            "extensions": {"MSFT_lod": {"ids": list(range(1, len(nodes)))}},
            "extras": {"MSFT_screencoverage": [*coverage, 0.0]},
        }
    if isinstance(mesh, TexturedMesh):
        surface["baseColorTexture"] = {"index": 0}
        document["textures"] = [{"source": 0, "sampler": 0}]
        document["images"] = [{"bufferView": len(blobs), "mimeType": "image/png"}]
        document["samplers"] = [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}]
        blobs.append((_png_bytes(mesh.texture), {}))
    views, offset = [], 0
    for blob, target in blobs:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blob), **target})
        offset += len(blob) + -len(blob) % 4
    document |= {
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<IIIII", _MAGIC, 2, 12 + 8 + len(text) + 8 + offset, len(text), _JSON)
    body = b"".join(blob + b"\0" * (-len(blob) % 4) for blob, _ in blobs)
    return head + text + struct.pack("<II", offset, _BIN) + body


def _glb_attributes(mesh: Mesh | TexturedMesh) -> list[tuple[str, bytes, dict[str, Any]]]:
    """Return the vertex attributes of a mesh: name, bytes, and type of the accessor."""
    vertices = np.ascontiguousarray(mesh.vertices, "<f4")
    bounds = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()} if len(vertices) else {}
    parts: list[tuple[str, bytes, dict[str, Any]]] = [
        ("POSITION", vertices.tobytes(), {"componentType": _FLOAT, "type": "VEC3", **bounds})
    ]
    if isinstance(mesh, TexturedMesh):
        normals, uv = np.ascontiguousarray(mesh.normals, "<f4"), np.ascontiguousarray(mesh.uv, "<f4")
        parts.append(("NORMAL", normals.tobytes(), {"componentType": _FLOAT, "type": "VEC3"}))
        parts.append(("TEXCOORD_0", uv.tobytes(), {"componentType": _FLOAT, "type": "VEC2"}))
    elif mesh.colors is not None:
        linear = np.ones((len(vertices), 4), "<u2")  # four channels: glTF requires alignment to 4 bytes
        linear[:, :3], linear[:, 3] = LINEAR_U16[mesh.colors], 65535
        parts.append(("COLOR_0", linear.tobytes(), {"componentType": _USHORT, "type": "VEC4", "normalized": True}))
    return parts


def write_pieces(path: Path, pieces: Sequence[Mesh]) -> None:
    """Write meshes as the objects of one OBJ file, atomically."""
    first = 1
    with atomic_write(path, "w") as file:
        for number, piece in enumerate(pieces):
            np.savetxt(file, piece.vertices, "v %.9g %.9g %.9g", header=f"o piece_{number:03d}", comments="")
            np.savetxt(file, piece.faces + first, "f %d %d %d")
            first += len(piece.vertices)


def read_textured(path: str | Path) -> TexturedMesh:
    """Read a textured mesh from a .glb file of ``write_mesh``.

    Raises DataError if the file is damaged or was written by another program.
    """
    try:
        data = Path(path).read_bytes()
        magic, _, _, length, kind = struct.unpack("<IIIII", data[:20])
        if (magic, kind) != (_MAGIC, _JSON):
            raise ValueError("no binary glTF")
        document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
        views = [binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in document["bufferViews"]]
        vertices, normals, uv, faces, png = views
        return TexturedMesh(
            np.frombuffer(vertices, "<f4").reshape(-1, 3),
            np.frombuffer(normals, "<f4").reshape(-1, 3),
            np.frombuffer(faces, "<u4").astype(np.int32).reshape(-1, 3),
            np.frombuffer(uv, "<f4").reshape(-1, 2),
            np.asarray(Image.open(io.BytesIO(png)).convert("RGB")),
        )
    except (ValueError, KeyError, IndexError, TypeError, OSError, struct.error) as error:
        raise DataError(f"{path}: expected a .glb file of `gs2d mesh --texture`, got another ({error})") from error


def _rotation_to_y(up: np.ndarray) -> list[float]:
    """Return the smallest rotation that takes ``up`` [3] to +y, as a quaternion x, y, z, w (glTF's order)."""
    x, y, z = np.asarray(up, np.float64) / np.linalg.norm(up)
    if y < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]  # upside down: rotate by 180 degrees about x
    quaternion = np.array([-z, 0.0, x, 1 + y])  # up x (0, 1, 0), 1 + up . (0, 1, 0)
    return [float(q) for q in quaternion / np.linalg.norm(quaternion)]


def _write_obj(path: Path, mesh: TexturedMesh) -> None:
    """Write an OBJ file with its material and texture; vertices are not duplicated at seams.

    Either all three files are written or none. The OBJ file is renamed last, so an existing OBJ file is complete.
    """
    obj, mtl, png = written_files(path)
    positions, vertex = np.unique(mesh.vertices, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1)[mesh.faces] + 1  # [F, 3]; OBJ counts from 1
    corner = mesh.faces + 1
    with atomic_write(obj, "w") as file, atomic_write(mtl, "w") as material, atomic_write(png) as texture:
        texture.write(_png_bytes(mesh.texture))
        material.write(f"newmtl texture\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {png.name}\n")
        file.write(f"mtllib {mtl.name}\nusemtl texture\n")
        np.savetxt(file, positions, "v %.9g %.9g %.9g")
        np.savetxt(file, np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=1), "vt %.7g %.7g")  # origin at lower left
        np.savetxt(file, mesh.normals, "vn %.5g %.5g %.5g")
        np.savetxt(file, np.stack([vertex, corner, corner], axis=2).reshape(-1, 9), "f" + " %d/%d/%d" * 3)
        file.flush()  # a full disk must raise before any of the three files is renamed


def _png_bytes(image: np.ndarray) -> bytes:
    """Return an image [H, W, 3] uint8 as the bytes of a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="PNG")
    return buffer.getvalue()
