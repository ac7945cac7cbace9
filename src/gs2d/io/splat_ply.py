"""Splats as PLY files, before activation.

The official 2DGS layout has two scales. Common viewers only read the 3DGS layout, whose third scale is a negligible
thickness. The normal of the disk is the third axis in both.
"""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path

import numpy as np
import torch

from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.io.gaussians import Gaussians, Warn, drawn_bands, with_thickness
from gs2d.io.ply_format import PlyElement, PlyFile, read_ply, write_ply

DISKS_COMMENT = "SplatRenderMode: 2dgs"  # marks splats with a third scale as disks: Brush, SplatTransform 3.2
_ROT = ("rot_0", "rot_1", "rot_2", "rot_3")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_FIXED = ("x", "y", "z", *_DC, "opacity", "scale_0", "scale_1", *_ROT)


def splat_fields(n_rest: int, *, layout: str) -> list[str]:
    """Return the property names of a splat file, with ``n_rest`` = 3 (K - 1) higher SH coefficients."""
    if layout not in ("2dgs", "3dgs"):
        raise ValueError(f"layout must be '2dgs' or '3dgs', got {layout!r}")
    scales = ["scale_0", "scale_1"] + (["scale_2"] if layout == "3dgs" else [])
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    return names + [f"f_rest_{i}" for i in range(n_rest)] + ["opacity", *scales] + [f"rot_{i}" for i in range(4)]


def write_splats(path: str | os.PathLike[str], splats: Splats, *, layout: str = "2dgs") -> None:
    """Write splats as float32, atomically.

    ``splats``: on any device; float32 values are stored exactly (``layout="2dgs"``). ``layout`` ("2dgs" or "3dgs"): the
    official 2DGS layout, or the one for common viewers (with ``scale_2``, the thickness, after ``scale_1``, and a
    comment that the splats are disks). Raises DiskError if the file could not be written.
    """
    n, n_rest = len(splats), 3 * splats.shN.shape[1]
    columns = {name: tensor.detach().to("cpu", torch.float32).numpy() for name, tensor in splats.items()}
    rows = np.zeros(n, dtype=[(name, "<f4") for name in splat_fields(n_rest, layout=layout)])  # nx ny nz stay 0
    _fill(rows, ("x", "y", "z"), columns["means"])
    _fill(rows, [f"f_dc_{i}" for i in range(3)], columns["sh0"].reshape(n, 3))
    _fill(rows, [f"f_rest_{i}" for i in range(n_rest)], columns["shN"].transpose(0, 2, 1).reshape(n, n_rest))
    rows["opacity"] = columns["opacity_logits"]
    _fill(rows, ("scale_0", "scale_1"), columns["log_scales"])
    if layout == "3dgs":
        rows["scale_2"] = with_thickness(columns["log_scales"])[:, 2]
    _fill(rows, [f"rot_{i}" for i in range(4)], columns["quats"])
    write_ply(path, {"vertex": rows}, comments=(DISKS_COMMENT,) if layout == "3dgs" else ())


def _fill(rows: np.ndarray, names: list[str] | tuple[str, ...], columns: np.ndarray) -> None:
    for i, name in enumerate(names):
        rows[name] = columns[:, i]


def read_splats(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> Splats:
    """Read splats in the official 2DGS layout, float32 on the CPU; extra properties are ignored.

    Half floats stored as ``ushort`` are decoded. Colours ``red green blue`` may replace ``f_dc_*``. ``warn``: receives
    a message if SH bands above degree 3 are dropped. Raises DataError if the file is broken, no PLY, or of another
    kind: 3DGS (three scales), compressed, a mesh, points.
    """
    vertex = _splat_element(path, read_ply(path))
    return Splats(**_attributes(path, vertex, ("scale_0", "scale_1"), warn))


def read_gaussians(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> Gaussians:
    """Read 3DGS splats, with three scales; otherwise as ``read_splats``.

    Raises DataError if the file is broken, no PLY, or has fewer scales.
    """
    vertex = read_ply(path).elements.get("vertex")
    if vertex is None:
        raise DataError(f"{path}: expected 3DGS splats, got a PLY without vertices; use a splat file")
    _check_complete(f"{path}: expected 3DGS splats", vertex, (*_FIXED, "scale_2"))
    a = {name: t.numpy() for name, t in _attributes(path, vertex, ("scale_0", "scale_1", "scale_2"), warn).items()}
    return Gaussians(**{**a, "sh0": a["sh0"][:, 0]})


def _check_complete(expected: str, vertex: PlyElement, required: tuple[str, ...]) -> None:
    """Raise DataError if properties are missing; colours may replace ``f_dc_*``."""
    missing = [name for name in required if not isinstance(vertex.properties.get(name), np.ndarray)]
    if not set(missing) <= set(_DC) or (missing and vertex.colors() is None):
        raise DataError(
            f"{expected}, but the properties {', '.join(missing)} are missing; export the splats with SH coefficients"
        )


def _attributes(path: object, vertex: PlyElement, scales: tuple[str, ...], warn: Warn) -> dict[str, torch.Tensor]:
    """Return the fields of ``Splats`` from the rows of an element."""
    names = {name for name, values in vertex.properties.items() if isinstance(values, np.ndarray)}
    n_rest = sum(name.startswith("f_rest_") for name in names)
    rest = [f"f_rest_{i}" for i in range(n_rest)]
    per_channel = n_rest // 3
    if n_rest % 3 or math.isqrt(1 + per_channel) ** 2 != 1 + per_channel or not names.issuperset(rest):
        raise DataError(
            f"{path}: expected 0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3), got {n_rest}; export the splats "
            "again"
        )

    def columns(*keys: str) -> np.ndarray:
        table = np.empty((vertex.count, len(keys)), np.float32)
        with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
            for i, name in enumerate(keys):
                table[:, i] = vertex.reals(path, name)
        return table

    colors = None if names.issuperset(_DC) else vertex.colors()
    arrays = {
        "means": columns("x", "y", "z"),
        "quats": columns(*_ROT),
        "log_scales": columns(*scales),
        "opacity_logits": columns("opacity")[:, 0],
        "sh0": (columns(*_DC) if colors is None else ((colors - 0.5) / C0).astype(np.float32))[:, None],
        "shN": drawn_bands(str(path), columns(*rest).reshape(vertex.count, 3, per_channel).transpose(0, 2, 1), warn),
    }
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


def ply_kind(path: str | os.PathLike[str]) -> str:
    """Return the content of a PLY file: "2dgs", "3dgs" or "compressed" splats, a "mesh" (with faces), or "points".

    Raises DataError if the file is no PLY or is broken.
    """
    file = read_ply(path)
    vertex = file.elements.get("vertex")
    names = set(vertex.properties) if vertex else set()
    if "chunk" in file.elements or "packed_position" in names:
        return "compressed"
    if "scale_0" in names:
        return "3dgs" if "scale_2" in names else "2dgs"
    faces = file.elements.get("face")
    empty = vertex is not None and vertex.count == 0
    return "mesh" if faces is not None and (faces.count > 0 or empty) else "points"


def _splat_element(path: object, file: PlyFile) -> PlyElement:
    """Return the vertex element of a 2DGS file; DataError for other kinds of files."""
    vertex = file.elements.get("vertex")
    names = set(vertex.properties) if vertex else set()
    expected = f"{path}: expected 2DGS splats (scale_0 and scale_1 only)"
    if "chunk" in file.elements or "packed_position" in names:
        raise DataError(f"{expected}, got a compressed PLY; use the uncompressed splats.ply of a gs2d or 2DGS run")
    if "scale_2" in names:
        raise DataError(f"{expected}, got 3DGS splats with three scales; use the splats.ply of a gs2d or 2DGS run")
    if vertex is None or "scale_0" not in names:
        has_faces = "face" in file.elements and file.elements["face"].count > 0
        kind = "a mesh" if has_faces else "a point cloud" if {"x", "y", "z"} <= names else "a PLY without vertices"
        beside = Path(str(path)).with_name("splats.ply")
        raise DataError(f"{expected}, got {kind}; use {beside if beside.exists() else 'that of a gs2d or 2DGS run'}")
    _check_complete(expected, vertex, _FIXED)
    return vertex
