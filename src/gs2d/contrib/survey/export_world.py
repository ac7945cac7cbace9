"""``gs2d survey --out``: splats or a mesh of a run in world coordinates.

Files are in local metres with z up. Their offset and coordinate system are written beside them::

    scene.ply.georeference.json   georeference of the run, with origin and EPSG code
    scene_offset.xyz              the origin, three numbers (as Pix4D writes it)
    scene.prj                     the coordinate system as WKT (if pyproj is installed)
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.survey.georeference import Georeference, required_georeference
from gs2d.contrib.survey.projection import wkt_of
from gs2d.core.atomic_files import atomic_write
from gs2d.core.json_files import write_json
from gs2d.core.splats import Splats
from gs2d.core.transforms import transform_splats
from gs2d.errors import RunError
from gs2d.io.formats.splat_formats import LAYOUTS, endings, layout_of, write_layout
from gs2d.io.meshes import read_mesh, read_textured, write_mesh
from gs2d.io.run_dir import MESH, TEXTURED, open_run
from gs2d.pipeline.prepare.loaded import checked_output, finished_splats

_TO_GLTF = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])  # z up to the y down that the writer of .glb expects


def export_world(path: Path, out: Path, part: str = "splats") -> dict[str, Any]:
    """Write splats or a mesh of a georeferenced run in local metres.

    ``part`` is "splats", in the layout of the ending of ``out``; "mesh", ``mesh.ply``; or "texture", the textured
    ``mesh.glb`` (.glb or .obj). Returns the file, its frame and offset, and the files beside it.
    """
    run, out = open_run(path), Path(out)
    place = required_georeference(run.path)
    notes: list[str] = []
    if out.resolve().parent == run.path.resolve():
        raise RunError(f"--out {out} is inside the run, whose files keep their coordinates; choose another folder")
    if part == "splats":
        layout = layout_of(out)
        if layout is None:
            raise RunError(f"splats are written as {', '.join(endings())} files, got --out {out}; choose such a name")
        checked_output(run.path, out, LAYOUTS.get(layout).ending, f"layout {layout} is")
        notes += write_layout(out, _splats_in_world(finished_splats(run), place, upright=layout == "gltf"), layout)
    elif part == "mesh":
        checked_output(run.path, out)
        mesh = read_mesh(_existing(run.file(MESH), f"gs2d mesh {path}"))
        write_mesh(out, replace(mesh, vertices=place.to_local(mesh.vertices).astype(mesh.vertices.dtype)))
    else:
        textured = read_textured(_existing(run.file(TEXTURED), f"gs2d mesh {path} --texture"))
        vertices = place.to_local(textured.vertices).astype(textured.vertices.dtype)
        normals = (np.asarray(textured.normals, np.float64) @ place.rotation.T).astype(textured.normals.dtype)
        write_mesh(out, replace(textured, vertices=vertices, normals=normals), up=np.array([0.0, 0.0, 1.0]))
    sidecars = _write_sidecars(out, place)
    return {
        "file": str(out),
        "frame": place.frame,
        "epsg": place.epsg,
        "offset": place.origin.tolist(),
        "beside": [file.name for file in sidecars],
        "notes": notes,
    }


def _existing(path: Path, command: str) -> Path:
    if not path.is_file():
        raise RunError(f"{path} does not exist; write it with `{command}`")
    return path


def _splats_in_world(splats: Splats, place: Georeference, *, upright: bool) -> Splats:
    turn = _TO_GLTF if upright else np.eye(3)
    return transform_splats(splats, place.scale, turn @ place.rotation, turn @ place.translation)


def _write_sidecars(path: Path, place: Georeference) -> list[Path]:
    """Write the files beside an exported file and return them."""
    names = path.with_name(path.name + ".georeference.json"), path.with_name(path.stem + "_offset.xyz")
    write_json(names[0], place.to_json())
    texts = {names[1]: " ".join(f"{value:.17g}" for value in place.origin)}
    if (wkt := wkt_of(place.epsg)) is not None:
        texts[path.with_suffix(".prj")] = wkt
    for name, text in texts.items():
        with atomic_write(name, "w") as file:
            file.write(text + "\n")
    return [names[0], *texts]
