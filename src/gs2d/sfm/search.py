"""What an interrupted search for cameras leaves, and how much of it the next one goes on with.

A search is made of layers: photographs, features, pairs, mapping. ``search.json`` in its folder says what each was made
of. What the next search would make alike is kept; from the first layer on that would differ all is made anew.
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
_PAIRS = ("pairs.txt", "pairs_again.txt", "pairs_anew.txt", "alike.json")
DAMAGED = (sqlite3.Error, UnicodeDecodeError)  # of a database, whose words need not be text
HINTED = "hinted"  # step of the mapping, before a camera is placed: which of them could be fisheyes
CALIBRATED_ANEW = "calibrated anew"  # step of the mapping: from here on pairs are verified with other cameras
_AGAIN = ("pairs again.json", f"{CALIBRATED_ANEW}.json")  # likewise, or compared by looser rules


def is_of(work: Path, layer: str, wanted: Any) -> bool:
    """Whether a layer of the search that was left here was made of ``wanted``."""
    return bool(_read(work).get(layer) == _plain(wanted))


def go_on(work: Path, wanted: Mapping[str, Any], *, ours: Sequence[str]) -> str:
    """Keep of an earlier search what ``wanted`` would make alike, and remember what is made now.

    Parameters
    ----------
    wanted : mapping
        What each of ``LAYERS`` is made of.
    ours : sequence of str
        Names in the folder that are the caller's, made of the photographs.

    Returns
    -------
    str
        One line about what is kept; empty without an earlier search.
    """
    before, wanted = _read(work), _plain(wanted)
    first = next((i for i, layer in enumerate(LAYERS) if before.get(layer) != wanted[layer]), len(LAYERS))
    if first < len(LAYERS) and any((work / MAPPING / name).exists() for name in _AGAIN):
        first = min(first, LAYERS.index("pairs"))
    kept = _kept(work, first) if before and first else ""
    for layer in reversed(LAYERS[first:]):  # the last first: what is left is always whole
        _remove(work, layer, ours)
    write_json(work / SEARCH, {layer: wanted[layer] for layer in LAYERS})
    return kept


def forget(work: Path) -> None:
    """Say that nothing of a search is worth keeping."""
    (work / SEARCH).unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """Return a value as JSON gives it back."""
    return json.loads(json.dumps(value))


def _read(work: Path) -> dict[str, Any]:
    if not (work / SEARCH).exists():
        return {}
    try:
        return dict(read_json(work / SEARCH))
    except (DataError, TypeError, ValueError):  # a disk that lost its power
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
    """Remove all matches from a database; a database that cannot be opened is removed with the features."""
    if not database.exists():
        return
    try:
        with contextlib.closing(sqlite3.connect(database, timeout=60.0)) as connection, connection:
            for table in ("matches", "two_view_geometries"):
                connection.execute(f"DELETE FROM {table}")
    except DAMAGED:
        for path in database.parent.glob(f"{database.name}*"):
            path.unlink()


def _kept(work: Path, layers: int) -> str:
    """Return what of the first ``layers`` layers is there, for people."""
    said = []
    with contextlib.suppress(*DAMAGED), contextlib.closing(_open(work / DATABASE)) as connection:
        if layers > LAYERS.index("features"):
            said.append(f"features of {_count(connection, 'keypoints'):,} photographs")
        if layers > LAYERS.index("pairs"):
            said.append(f"{_count(connection, 'two_view_geometries'):,} pairs")
    if layers > LAYERS.index("mapping") and (work / MAPPING).is_dir():
        steps = {path.stem for path in (work / MAPPING).iterdir()} - {HINTED, CALIBRATED_ANEW}
        said += ["cameras that were placed"] if steps else []
    return f"going on with the search that was interrupted: {', '.join(said) or 'copies of photographs'}"


def _open(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=1.0)


def _count(connection: sqlite3.Connection, table: str) -> int:
    return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
