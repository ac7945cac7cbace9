"""Describe a capture or a file: ``gs2d info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.core.missing import belongs_to_run, suggestion
from gs2d.data import detect_format, load_scene
from gs2d.data.known_captures import missing_lines
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import is_splat_file, read_splat_file, reader_of
from gs2d.io.meshes import FOREIGN, read_mesh, read_points
from gs2d.io.splat_ply import ply_kind

_OF_MODELS = (".ply", *FOREIGN)


def describe_capture(path: Path) -> dict[str, Any]:
    """Describe a capture, which is a folder."""
    scene = load_scene(path, format=detect_format(path))
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    details: dict[str, Any] = {
        "capture": str(path),
        "format": scene.format,
        "training views": len(scene.train),
        "test views": len(scene.test),
        "image sizes": ", ".join(f"{width}x{height}" for width, height in sizes[:4])
        + (" ..." if len(sizes) > 4 else ""),
        "points": 0 if scene.points is None else len(scene.points.points),
        "extent": scene.extent,
    }
    if scene.skipped:
        details["skipped"] = list(scene.skipped)
    if notes := scene.notes + scene.details:
        details["notes"] = list(notes)
    if missing := missing_lines(path):
        details["missing"] = list(missing)
    return details


def describe_file(path: Path) -> dict[str, Any]:
    """Describe a file of splats, a mesh or points. Raises DataError if the file is none of these, or is broken."""
    if path.suffix.lower() not in _OF_MODELS and not is_splat_file(path):
        remedy = suggestion(path, "run" if belongs_to_run(path) else "capture")
        raise DataError(f"{path} is not a file of splats, a mesh or points{remedy}")
    size = path.stat().st_size
    reader = reader_of(path)
    if reader is not None and reader.mesh is not None and (mesh := reader.mesh(path)) is not None:
        return {**mesh, "bytes": size}
    kind = "mesh" if path.suffix.lower() in FOREIGN else "splats" if is_splat_file(path) else ply_kind(path)
    if kind == "mesh":
        surface = read_mesh(path)
        return {"vertices": len(surface.vertices), "triangles": len(surface.faces), "bytes": size}
    if kind == "points":
        return {"points": len(read_points(path).points), "bytes": size}
    file = read_splat_file(path)
    shape = {} if kind == "2dgs" else {"shape": "flat" if file.surfels is not None else "3D, which gs2d does not draw"}
    gaussians = file.gaussians
    notes = {"notes": list(file.notes)} if file.notes else {}
    details = {"splats": len(gaussians), "layout": file.kind, **shape, "SH degree": gaussians.sh_degree, "bytes": size}
    return {**details, **notes}
