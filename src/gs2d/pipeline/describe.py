"""What a capture or a PLY file holds, in a few facts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.data import detect_format, load_scene
from gs2d.data.layouts import missing_lines
from gs2d.io.ply import ply_kind, read_mesh, read_points, read_splats
from gs2d.io.ply_format import read_ply


def describe_capture(path: Path) -> dict[str, Any]:
    """Facts of a capture folder.

    Raises
    ------
    DataError
    """
    scene = load_scene(path, format=detect_format(path))
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    facts: dict[str, Any] = {
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
        facts["skipped"] = list(scene.skipped)
    if scene.notes:
        facts["notes"] = list(scene.notes)
    if missing := missing_lines(path):
        facts["missing"] = list(missing)
    return facts


def describe_ply(path: Path) -> dict[str, Any]:
    """Facts of a PLY file: splats of either layout, a mesh or points.

    Raises
    ------
    DataError
        The file is no PLY, is broken, or holds compressed splats.
    """
    kind, size = ply_kind(path), path.stat().st_size
    if kind == "3dgs":
        count = read_ply(path).elements["vertex"].count
        return {"splats": count, "layout": "3dgs (three scales, for viewers)", "bytes": size}
    if kind == "mesh":
        mesh = read_mesh(path)
        return {"vertices": len(mesh.vertices), "triangles": len(mesh.faces), "bytes": size}
    if kind == "points":
        return {"points": len(read_points(path).points), "bytes": size}
    splats = read_splats(path)  # names a compressed file
    return {"splats": len(splats), "layout": "2dgs", "SH degree": splats.sh_degree, "bytes": size}
