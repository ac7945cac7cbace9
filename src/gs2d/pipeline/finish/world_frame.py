"""What a run holds, in metres of the world: made for a file that is asked for, never in the run itself."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.georeference import Georeference
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.core.projection import wkt_of
from gs2d.core.splats import Splats
from gs2d.core.transforms import transform_splats
from gs2d.errors import RunError
from gs2d.io.georeference import georeference_of_file, read_georeference, stamp, write_sidecars
from gs2d.io.run_dir import open_run

HOW = (
    "find them with `gs2d georeference {run} --gps` if the photographs have GPS positions, else with "
    "`gs2d georeference {run} --known-distance X0 Y0 Z0 X1 Y1 Z1 METRES`, from two points of the mesh"
)


def place_of(path: Path, *, asked: bool) -> Georeference | None:
    """Return where a run or a file is in the world, if what is made of it is to say so.

    What comes from a file that knows where it is keeps that, asked for or not; what comes from a run has the run's
    coordinates unless it is ``asked``.

    Raises
    ------
    RunError
        Asked for, and it is not known.
    DataError
    """
    path = Path(path)
    of_file = georeference_of_file(path) if path.is_file() else None
    place = read_georeference(open_run(path).path) if asked and not path.is_file() else of_file
    if asked and place is None:
        remedy = "export from a run folder" if path.is_file() else HOW.format(run=shlex.quote(str(path)))
        raise RunError(f"the scale and the position in the world of {path} are not known: {remedy}")
    return place


def placed_output(path: Path, out: Path | None, name: str) -> Georeference:
    """Return where a run is, if a georeferenced file may be written: not among those of the run."""
    if out is None or Path(out).resolve() == (Path(path) / name).resolve():
        raise RunError(f"--georeferenced needs --out FILE: {name} of the run keeps the coordinates of the run")
    place = place_of(path, asked=True)
    assert place is not None
    return place


def placed_splats(splats: Splats, place: Georeference) -> Splats:
    """Return splats in local metres; those that are there already, as they are."""
    if place.is_local:
        return splats
    return transform_splats(splats, place.scale, place.rotation, place.translation)


def placed_mesh(mesh: Mesh, place: Georeference) -> Mesh:
    """Return a mesh in local metres, in the type that its vertices have."""
    return replace(mesh, vertices=place.to_local(mesh.vertices).astype(mesh.vertices.dtype))


def placed_textured(mesh: TexturedMesh, place: Georeference) -> TexturedMesh:
    """Return a mesh with a texture in local metres."""
    normals = (np.asarray(mesh.normals, np.float64) @ place.rotation.T).astype(mesh.normals.dtype)
    return replace(mesh, vertices=place.to_local(mesh.vertices).astype(mesh.vertices.dtype), normals=normals)


def say_where(out: Path, place: Georeference) -> dict[str, Any]:
    """Let a file in local metres say where it is, in itself and beside it; returns what is said of that."""
    stamp(out, place)
    beside = write_sidecars(out, place, wkt_of(place.epsg))
    return {
        "frame": place.frame,
        "epsg": place.epsg,
        "offset": place.origin.tolist(),
        "beside": [path.name for path in beside],
    }
