"""Georeferences on disk: that of a run, and what files in local metres say of where they are.

A file in local metres says its origin and its EPSG code wherever its format has room (comments of a PLY or an OBJ,
``asset.extras`` of a .glb, ``customLayerData`` of OpenUSD), and always in files beside it, as other tools read them::

    scene.ply                        scene.ply.georeference.json   all of it, read back by gs2d
    scene_offset.xyz                 the origin, three numbers (as Pix4D writes it)
    scene.prj                        the coordinate system as WKT (where pyproj is installed)
"""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from gs2d.core.files import atomic_write
from gs2d.core.georeference import Georeference
from gs2d.core.json_files import read_json, write_json
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import LAYOUTS, layout_of, reader_of
from gs2d.io.ply_format import read_ply_comments
from gs2d.io.run_dir import GEOREFERENCE

_COMMENT = "georeference "  # before the JSON, in a PLY or an OBJ
_KEY = "georeference"  # in the extras of glTF
_SIDECAR = ".georeference.json"
_HEAD = 1 << 20  # bytes of a text file in which its comments stand
_GLB = struct.Struct("<IIIII")  # magic, version, bytes; bytes of the first chunk, its kind: JSON


def read_georeference(run: Path) -> Georeference | None:
    """Return that of a run folder; None where it has none.

    Raises
    ------
    DataError
        ``georeference.json`` is damaged.
    """
    path = Path(run) / GEOREFERENCE
    if not path.exists():
        return None
    try:
        return Georeference.from_json(read_json(path))
    except DataError as error:
        raise DataError(
            f"{path} was damaged ({error}); remove it with `gs2d georeference {run} --remove`, then find it again"
        ) from error


def write_georeference(run: Path, georeference: Georeference) -> Path:
    """Write that of a run folder."""
    path = Path(run) / GEOREFERENCE
    write_json(path, georeference.to_json())
    return path


def stamp(path: Path, georeference: Georeference) -> bool:
    """Write a georeference into a file in local metres; False where its format has no room for that."""
    path = Path(path)
    kind = path.suffix.lower()
    layout = layout_of(path)
    own = None if layout is None else LAYOUTS.get(layout).stamp
    if own is not None:
        own(path, georeference)
        return True
    if kind == ".glb":
        stamp_glb(path, georeference)
        return True
    if kind not in (".ply", ".obj"):
        return False
    with open(path, "rb") as old, atomic_write(path) as new:
        if kind == ".ply":
            new.write(old.readline() + old.readline())  # "ply", "format ..."
            new.writelines(f"comment {line}\n".encode() for line in _comments(georeference))
        else:
            new.writelines(f"# {line}\n".encode() for line in _comments(georeference))
        shutil.copyfileobj(old, new, 1 << 20)
    return True


def stamp_glb(
    path: Path, georeference: Georeference, change: Callable[[dict[str, Any]], None] = lambda document: None
) -> None:
    """Write a georeference into the extras of a .glb file's asset; ``change`` edits its JSON document too."""
    with open(path, "rb") as old, atomic_write(path) as new:
        new.write(_stamped_glb_head(old, georeference, change))
        shutil.copyfileobj(old, new, 1 << 20)


def _comments(georeference: Georeference) -> list[str]:
    """Return what a file says in its comments: for people, then for gs2d."""
    x, y, z = georeference.origin
    epsg = [] if georeference.epsg is None else [f"epsg {georeference.epsg}"]
    frame = f"frame {georeference.frame}, metres"
    return [*epsg, f"offset {x:.17g} {y:.17g} {z:.17g}", frame, _COMMENT + georeference_text(georeference)]


def _stamped_glb_head(old: IO[bytes], georeference: Georeference, change: Callable[[dict[str, Any]], None]) -> bytes:
    """Return the header and the JSON of a .glb file, with a georeference in the extras of its asset."""
    magic, version, length, size, kind = _GLB.unpack(old.read(_GLB.size))
    document = json.loads(old.read(size))
    change(document)
    document["asset"]["extras"] = {**(document["asset"].get("extras") or {}), _KEY: _short(georeference)}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return _GLB.pack(magic, version, length + len(text) - size, len(text), kind) + text


def georeference_text(georeference: Georeference) -> str:
    """Return the JSON in which a file in local metres says where it is."""
    return json.dumps(_short(georeference), separators=(",", ":"), allow_nan=False)


def _short(georeference: Georeference) -> dict[str, Any]:
    data = georeference.of_local_files().to_json()
    return {name: value for name, value in data.items() if name not in ("residuals", "rms", "doubts", "facts")}


def sidecars(path: Path, georeference: Georeference, wkt: str | None) -> tuple[tuple[Path, str], ...]:
    """Return the files beside a file in local metres, and what they hold."""
    path = Path(path)
    told = json.dumps(_short(georeference), indent=2, allow_nan=False) + "\n"
    x, y, z = georeference.origin
    files = [
        (path.with_name(path.name + _SIDECAR), told),
        (path.with_name(path.stem + "_offset.xyz"), f"{x:.17g} {y:.17g} {z:.17g}\n"),
    ]
    return tuple(files if wkt is None else [*files, (path.with_suffix(".prj"), wkt + "\n")])


def write_sidecars(path: Path, georeference: Georeference, wkt: str | None) -> tuple[Path, ...]:
    """Write the files beside a file in local metres; returns them."""
    found = sidecars(path, georeference, wkt)
    for name, text in found:
        with atomic_write(name, "w") as file:
            file.write(text)
    return tuple(name for name, _ in found)


def georeference_of_file(path: Path) -> Georeference | None:
    """Return what a file says of where it is: itself, else the file beside it; None where neither does.

    Raises
    ------
    DataError
        It says something that is no georeference.
    """
    path = Path(path)
    told = _told(path)
    if told is None:
        beside = path.with_name(path.name + _SIDECAR)
        return _parsed(beside, read_json(beside)) if beside.is_file() else None
    try:
        return _parsed(path, json.loads(told) if isinstance(told, str) else told)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: its georeference must be JSON, got: {error}; export it again") from error


def _parsed(path: Path, data: Any) -> Georeference:
    try:
        return Georeference.from_json(data)
    except DataError as error:
        raise DataError(f"{path}: {error}; export it again") from error


def _told(path: Path) -> Any:
    """Return what stands in the file itself: JSON as text, an object, or None."""
    kind = path.suffix.lower()
    if kind == ".ply":
        return _after_mark(read_ply_comments(path))
    if kind == ".obj":
        with open(path, "rb") as file:
            lines = file.read(_HEAD).decode("utf-8", "replace").splitlines()
        return _after_mark([line[1:].strip() for line in lines if line.startswith("#")])
    if kind == ".glb":
        return _of_glb(path)
    reader = reader_of(path)
    return None if reader is None or reader.georeference is None else reader.georeference(path)


def _after_mark(lines: Sequence[str]) -> str | None:
    return next((line[len(_COMMENT) :] for line in lines if line.startswith(_COMMENT + "{")), None)


def _of_glb(path: Path) -> Any:
    try:
        with open(path, "rb") as file:
            length = _GLB.unpack(file.read(_GLB.size))[3]
            extras = json.loads(file.read(length))["asset"].get("extras")
        return extras.get(_KEY) if isinstance(extras, dict) else None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, struct.error):
        return None  # whoever reads the mesh says what is wrong with it
