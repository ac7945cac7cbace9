"""What a capture or a PLY file holds, in a few facts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.data import detect_format, load_scene
from gs2d.errors import DataError
from gs2d.io.ply import read_mesh, read_points, read_splats


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
    return facts


def describe_ply(path: Path) -> dict[str, Any]:
    """Facts of a PLY file: splats, a mesh or points.

    Raises
    ------
    DataError
        None of these; the reason is that of the reader of splats.
    """
    try:
        splats = read_splats(path)
        return {"splats": len(splats), "SH degree": splats.sh_degree, "bytes": path.stat().st_size}
    except DataError as not_splats:
        try:
            mesh = read_mesh(path)
            return {"vertices": len(mesh.vertices), "triangles": len(mesh.faces), "bytes": path.stat().st_size}
        except DataError:
            try:
                return {"points": len(read_points(path).points), "bytes": path.stat().st_size}
            except DataError:
                raise not_splats from None
