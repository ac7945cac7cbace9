"""Continue an interrupted search for cameras.

A search consists of four layers: photographs, features, pairs, mapping. ``search.json`` in its folder stores the inputs
of each. The next search keeps the layers whose inputs are equal, and repeats everything from the first difference on.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json, write_json
from gs2d.errors import DataError

SEARCH = "search.json"
LAYERS = ("photographs", "features", "pairs", "mapping")
DATABASE, MAPPING = "database.db", "mapping"
_PAIRS = ("pairs.txt", "pairs_anew.txt", "alike.json")
DAMAGED = (sqlite3.Error, UnicodeDecodeError)  # errors of a damaged database
FISHEYES = "fisheyes"  # step of the mapping, before images are placed
CALIBRATED_ANEW = "calibrated anew"  # step of the mapping: pairs are verified again with other cameras


def is_of(work: Path, layer: str, inputs: Any) -> bool:
    """Whether a layer of the interrupted search has these inputs."""
    return bool(_read(work).get(layer) == _plain(inputs))


def go_on(work: Path, inputs: Mapping[str, Any], *, ours: Sequence[str]) -> str:
    """Keep the layers of an earlier search whose inputs are equal, remove the others, and store the new inputs.

    Returns one line about the layers kept; empty without an earlier search. ``inputs``: inputs of each of ``LAYERS``.
    ``ours``: folders of the caller that belong to the layer "photographs".
    """
    before, inputs = _read(work), _plain(inputs)
    first = next((i for i, layer in enumerate(LAYERS) if before.get(layer) != inputs[layer]), len(LAYERS))
    if first < len(LAYERS) and (work / MAPPING / f"{CALIBRATED_ANEW}.json").exists():
        first = min(first, LAYERS.index("pairs"))
    note = _retained_note(work, first) if before and first else ""
    for layer in reversed(LAYERS[first:]):  # the last layer first, so that an interruption leaves complete layers
        _remove(work, layer, ours)
    write_json(work / SEARCH, {layer: inputs[layer] for layer in LAYERS})
    return note


def forget(work: Path) -> None:
    """End a search and discard its layers."""
    (work / SEARCH).unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """Return a value as it is after a round trip through JSON."""
    return json.loads(json.dumps(value))


def _read(work: Path) -> dict[str, Any]:
    if not (work / SEARCH).exists():
        return {}
    try:
        return dict(read_json(work / SEARCH))
    except (DataError, TypeError, ValueError):  # damaged, for example by a power failure
        return {}


def _remove(work: Path, layer: str, ours: Sequence[str]) -> None:
    if layer == "mapping":
        shutil.rmtree(work / MAPPING, ignore_errors=True)
    elif layer == "pairs":
        for name in _PAIRS:
            (work / name).unlink(missing_ok=True)
        _clear(work / DATABASE)
    elif layer == "features":
        for path in work.glob(f"{DATABASE}*"):
            path.unlink()
    else:
        for name in ours:
            shutil.rmtree(work / name, ignore_errors=True)


def _clear(database: Path) -> None:
    """Remove all matches from a database; an unreadable database is removed, with its features."""
    if not database.exists():
        return
    try:
        with contextlib.closing(sqlite3.connect(database, timeout=60.0)) as connection, connection:
            for table in ("matches", "two_view_geometries"):
                connection.execute(f"DELETE FROM {table}")
    except DAMAGED:
        for path in database.parent.glob(f"{database.name}*"):
            path.unlink()


def _retained_note(work: Path, layers: int) -> str:
    """Describe what exists of the first ``layers`` layers."""
    parts = []
    with contextlib.suppress(*DAMAGED), contextlib.closing(read_only(work / DATABASE)) as connection:
        if layers > LAYERS.index("features"):
            parts.append(f"features of {count(connection, 'keypoints'):,} photographs")
        if layers > LAYERS.index("pairs"):
            parts.append(f"{count(connection, 'two_view_geometries'):,} pairs")
    if layers > LAYERS.index("mapping") and (work / MAPPING).is_dir():
        steps = {path.stem for path in (work / MAPPING).iterdir()} - {FISHEYES, CALIBRATED_ANEW}
        parts += ["placed cameras"] if steps else []
    return f"continuing the interrupted search: {', '.join(parts) or 'copies of photographs'}"


def read_only(database: Path) -> sqlite3.Connection:
    """Open a database; in WAL mode, readers do not block the process that writes it."""
    return sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=1.0)


def count(connection: sqlite3.Connection, table: str) -> int:
    """Count the rows of a table."""
    return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
