"""Read and write glTF 2.0 with ``KHR_gaussian_splatting`` (as ratified in 2026).

The only kernel is the projected ellipsoid, so a disk gets a negligible thickness. Attributes are float32 after
activation: unit quaternions, linear scales, linear opacities; spherical harmonics are those of 3DGS. glTF has y up. As
in SplatTransform (PlayCanvas, MIT), coordinates are rotated by 180 degrees about z, which only changes signs.
"""

from __future__ import annotations

import json
import os
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.formats.gltf_document import GltfDocument, node_matrices, read_document
from gs2d.contrib.formats.quantised import log_scales_of, to_byte
from gs2d.contrib.formats.turned import half_turned_about_z, placed
from gs2d.core.atomic_files import atomic_write
from gs2d.core.growth import check_growth
from gs2d.core.sh import C0
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import register_format, register_splat_reader
from gs2d.io.gaussians import Gaussians, Warn, drawn_bands, logit, sigmoid, unit_quats
from gs2d.io.meshes import LINEAR_U16

EXTENSION = "KHR_gaussian_splatting"
_FROM_GLTF = np.diag([-1.0, -1.0, 1.0, 1.0])
_FLOAT, _USHORT, _VERTICES = 5126, 5123, 34962
_SUPPORTED = {EXTENSION, "KHR_mesh_quantization"}


def write_gltf(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a .glb file, atomically."""
    count = len(gaussians)
    attributes = _attributes(gaussians)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at = 0
    for name, (array, kind) in attributes.items():
        views.append({"buffer": 0, "byteOffset": at, "byteLength": array.nbytes, "target": _VERTICES})
        accessors.append({"bufferView": len(accessors), "count": count, **kind})
        if name == "POSITION":
            accessors[-1] |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()} if count else {}
        at += array.nbytes
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "gs2d"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
    }
    if count:  # glTF does not allow empty lists
        indices = {name: i for i, name in enumerate(attributes)}
        primitive = {"attributes": indices, "mode": 0, "extensions": {EXTENSION: splatting}}
        document |= {
            "meshes": [{"primitives": [primitive]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": at}],
        }
    else:
        document["nodes"] = [{"extras": {EXTENSION: "no splats"}}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + (8 + at if count else 0)
    with atomic_write(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text)
        if count:
            file.write(struct.pack("<I4s", at, b"BIN\0"))
        for array, _ in attributes.values() if count else ():
            file.write(array.data)


def _attributes(gaussians: Gaussians) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """Return the arrays to write, with rows aligned to 4 bytes, and the properties of their accessors."""
    g = half_turned_about_z(gaussians)
    color = np.full((len(g), 4), 65535, "<u2")  # for viewers that show points only
    color[:, :3] = LINEAR_U16[to_byte(255.0 * (0.5 + C0 * g.sh0.astype(np.float64)))]
    opacity = sigmoid(g.opacity_logits)
    color[:, 3] = np.rint(65535.0 * opacity)
    scales = np.exp(np.clip(g.log_scales.astype(np.float64), -80.0, 88.0))
    floats = {
        "ROTATION": (unit_quats(g.quats)[:, [1, 2, 3, 0]], "VEC4"),
        "SCALE": (scales, "VEC3"),
        "OPACITY": (opacity, "SCALAR"),
    }
    for i, (degree, place) in enumerate(_places(g.sh_degree)):
        floats[f"SH_DEGREE_{degree}_COEF_{place}"] = (g.sh0 if i == 0 else g.shN[:, i - 1], "VEC3")
    arrays: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
        "POSITION": (np.ascontiguousarray(g.means, "<f4"), {"componentType": _FLOAT, "type": "VEC3"}),
        "COLOR_0": (color, {"componentType": _USHORT, "type": "VEC4", "normalized": True}),
    }
    for name, (values, kind) in floats.items():
        array = np.ascontiguousarray(values, "<f4")
        arrays[f"{EXTENSION}:{name}"] = (array, {"componentType": _FLOAT, "type": kind})
    return arrays


def _places(degree: int) -> list[tuple[int, int]]:
    """Return (degree, index in it) of the harmonics up to a degree, in order."""
    return [(level, place) for level in range(degree + 1) for place in range(2 * level + 1)]


def read_gltf(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> tuple[Gaussians, str]:
    """Read all splats in the scene of a .glb or .gltf file; also returns the kind of file.

    ``warn`` receives a message if SH bands above degree 3 are dropped. Raises DataError if the file is no glTF, or
    contains no splats or unsupported ones.
    """
    document = read_document(path)
    required = document.json.get("extensionsRequired", [])
    beyond = set(map(str, required)) - _SUPPORTED if isinstance(required, list) else set()
    if beyond:
        raise DataError(f"{path}: expected glTF that needs {EXTENSION} only, it needs {', '.join(sorted(beyond))}")
    with document.reading():
        primitives = list(_primitives(document))
        total = sum(document.bytes_of(index) for _, attributes in primitives for index in attributes.values())
        check_growth(path, document.packed_bytes() if primitives else 0, total, "splats")
        parts = [_placed(path, _gaussians(document, a, warn), _FROM_GLTF @ matrix) for matrix, a in primitives]
    if not parts and "meshes" not in document.json and EXTENSION in document.json.get("extensionsUsed", ()):
        return _none(), "glTF"
    if not parts:
        mesh = gltf_mesh(path)
        content = "glTF without" if mesh is None else f"a mesh of {mesh['triangles']:,} triangles"
        raise DataError(
            f"{path}: expected Gaussian splats ({EXTENSION}), got {content}; use the splats.ply of a run or another "
            "splat file"
        )
    return Gaussians.joined(parts), "glTF"


def gltf_mesh(path: str | os.PathLike[str]) -> dict[str, int | str] | None:
    """Return the numbers of vertices and triangles of a .glb or .gltf file, and its colours; None without a mesh."""
    document = read_document(path)
    vertices = triangles = 0
    colors = "none"
    with document.reading():
        accessors = document.json.get("accessors", [])
        for _, mesh in node_matrices(document):
            for primitive in document.json["meshes"][mesh]["primitives"]:
                if primitive.get("mode", 4) != 4:  # points, lines and strips
                    continue
                attributes = primitive["attributes"]
                vertices += accessors[attributes["POSITION"]]["count"]
                triangles += accessors[primitive.get("indices", attributes["POSITION"])]["count"] // 3
                if "TEXCOORD_0" in attributes and document.json.get("textures"):
                    colors = "texture"
                elif "COLOR_0" in attributes and colors == "none":
                    colors = "of the vertices"
    return {"vertices": vertices, "triangles": triangles, "colours": colors} if triangles else None


def _none() -> Gaussians:
    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 3), (0, 0, 3))
    return Gaussians(*(np.zeros(shape, np.float32) for shape in shapes))


def _primitives(document: GltfDocument) -> Iterator[tuple[np.ndarray, dict[str, int]]]:
    """Yield the transform and the accessors (by name without the prefix) of every splat primitive in the scene."""
    for matrix, mesh in node_matrices(document):
        for primitive in document.json["meshes"][mesh]["primitives"]:
            splatting = primitive.get("extensions", {}).get(EXTENSION)
            if splatting is None:
                continue
            attributes = {str(n).removeprefix(f"{EXTENSION}:"): index for n, index in primitive["attributes"].items()}
            compressed = splatting.get("extensions")
            if not compressed and ("kernel" not in splatting or "ROTATION" not in attributes):
                raise DataError(
                    f"{document.path}: expected the release candidate of {EXTENSION}, got an early draft (no kernel or "
                    "no ROTATION); export the file again with a newer program, or as PLY"
                )
            if compressed or splatting["kernel"] != "ellipse":
                more = ", ".join(sorted(splatting.get("extensions", {}))) or repr(splatting["kernel"])
                raise DataError(
                    f"{document.path}: expected splats with the kernel 'ellipse' and no compression, got {more}; "
                    "convert the file to PLY"
                )
            yield matrix, attributes


def _gaussians(document: GltfDocument, attributes: dict[str, int], warn: Warn) -> Gaussians:
    """Read one primitive, in its own frame."""
    degree = max((int(name.split("_")[2]) for name in attributes if name.startswith("SH_DEGREE_")), default=0)
    if not 0 <= degree <= 8:
        raise DataError(f"{document.path}: expected SH degree 0 to 3, got {degree}; export it with three bands")
    means = document.array(attributes["POSITION"], "VEC3")
    quats = document.array(attributes["ROTATION"], "VEC4")
    scales = document.array(attributes["SCALE"], "VEC3")
    opacities = document.array(attributes["OPACITY"], "SCALAR")[:, 0]
    harmonics = [
        document.array(attributes[f"SH_DEGREE_{level}_COEF_{place}"], "VEC3") for level, place in _places(degree)
    ]
    if len({len(array) for array in (means, quats, scales, opacities, *harmonics)}) != 1:
        raise DataError(f"{document.path}: expected attributes of equal length; export it again")
    if (scales < 0).any() or (opacities < 0).any() or (opacities > 1).any():  # NaN is dropped later
        raise DataError(f"{document.path}: expected scales >= 0 and opacities from 0 to 1; export it again")
    return Gaussians(
        means,
        np.ascontiguousarray(quats[:, [3, 0, 1, 2]]),
        log_scales_of(scales),
        logit(opacities),
        harmonics[0],
        drawn_bands(document.path, np.stack([*harmonics[1:]], axis=1), warn)
        if degree
        else np.zeros((len(means), 0, 3), np.float32),
    )


def _placed(path: str | os.PathLike[str], g: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Transform splats to the coordinates of PLY files; a rotation by 180 degrees is exact."""
    if np.allclose(matrix, _FROM_GLTF, rtol=0, atol=1e-6):
        return half_turned_about_z(g)
    try:
        return placed(g, matrix)
    except ValueError as error:
        raise DataError(f"{Path(path)}: {error} of the nodes of splats; bake it into them") from error


register_format("gltf", ending=".glb")(lambda path, splats: write_gltf(path, Gaussians.of(splats)))


register_splat_reader("gltf", endings=(".glb", ".gltf"), mesh=gltf_mesh)(read_gltf)
