"""Run COLMAP in a process of its own and follow what it does."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import queue
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from gs2d.core.extras import install
from gs2d.core.files import atomic_write
from gs2d.errors import BackendError, DataError

OnProgress = Callable[[str, int, int], None]  # name of the phase, steps done, steps in all
OnNote = Callable[[str], None]  # a line for people
MISSING = f"structure from motion needs pycolmap, which is not installed: {install('sfm')}"
POLL_SECONDS = 0.5
_LITTLE_SPACE = 64 << 20  # bytes; what SQLite could not write is given back when it gives up
# Modules are looked for where this process does: `-m` would first take a random.py of the folder one is in.
_WORKER = "import sys; sys.path[:] = sys.argv[2:]; from gs2d.sfm.colmap_worker import main; main(sys.argv[1])"
_PAIRS = "two_view_geometries"
_COUNTED = {"features": "keypoints", "matching": _PAIRS, "verifying": _PAIRS, "again": _PAIRS}  # a row a step
_PHASES = {
    "features": "finding features",
    "comparing": "finding similar photographs",
    "matching": "matching pairs",
    "verifying": "matching as fisheyes",
    "cameras": "placing cameras",
    "lenses": "comparing lenses",
    "again": "matching pairs once more",
    "cameras again": "placing cameras once more",
}


@dataclass(frozen=True)
class Group:
    """Photographs of one camera.

    Attributes
    ----------
    names : tuple of str
    camera_model : str
        COLMAP's.
    size : (int, int)
        Of its pictures, px.
    original : str
        A photograph with EXIF.
    hint : "circle", "name", "asked" or ""
        What tells of a fisheye (``as_fisheye``).
    circle : (float, float, float) or None
        Of a round picture (``fisheye.Circle``): its middle of width and height, its radius of the longer side.
    """

    names: tuple[str, ...]
    camera_model: str
    size: tuple[int, int]
    original: str
    hint: str = ""
    circle: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Request:
    """What the worker is asked to do; every path is absolute.

    Attributes
    ----------
    images : str
        Folder of the photographs.
    database, output : str
        COLMAP's database, and the folder for the models ``0``, ``1`` ...; neither exists.
    groups : tuple of Group
    in_order : tuple of str
        All names, in the order in which they were taken.
    ordered_by : "time" or "name"
        What tells the order.
    places : tuple of (x, y, z) or None
        Metres, of each name in ``in_order``; None for those without a position.
    matching : "exhaustive", "sequential", "similar" or "spatial"
    overlap, neighbours : int
        Next photographs, and similar ones, that each is matched with where not all pairs are; fewer near ones do.
    mapper : "incremental" or "global"
    rig : tuple of str
        Folders of cameras that are mounted together, the reference first; none: there is no rig.
    feature_size : int
        Longer side on which features are found, px.
    asked_lens : str or None
        The model that the user wants; None: lenses are compared.
    masks : str or None
        Folder of masks (``NAME.png``): no features are looked for in their black pixels.
    """

    images: str
    database: str
    output: str
    groups: tuple[Group, ...]
    in_order: tuple[str, ...]
    ordered_by: str
    places: tuple[tuple[float, float, float] | None, ...]
    matching: str
    overlap: int
    neighbours: int
    mapper: str
    rig: tuple[str, ...]
    feature_size: int
    threads: int
    seed: int
    asked_lens: str | None = None
    masks: str | None = None


def layers(request: Request) -> dict[str, Any]:
    """Return what features, pairs and mapping are made of, for :func:`gs2d.sfm.search.go_on`."""
    told = asdict(request)
    pairs = ("in_order", "ordered_by", "places", "matching", "overlap", "neighbours")
    features = ("groups", "feature_size", "seed", *(("masks",) if request.masks is not None else ()))
    return {
        "features": {name: told[name] for name in features},
        "pairs": {name: told[name] for name in pairs},
        "mapping": {name: told[name] for name in ("asked_lens", "mapper", "rig")},
    }


def check_installed() -> None:
    """Raise BackendError where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise BackendError(MISSING)


@dataclass(frozen=True)
class Solved:
    """What the worker did.

    Attributes
    ----------
    models : list of dict
        What was done to each model that was written, the largest first; none: there is no model.
    lens : dict
        What was decided about the lens (``lens.lens_line``); empty without a model.
    refused : dict of str to str
        Photographs that found a place and were taken out again, with the reason.
    """

    models: list[dict[str, Any]]
    lens: dict[str, Any]
    refused: dict[str, str]


def solve(
    request: Request, on_progress: OnProgress, on_note: OnNote = lambda _line: None, *, command: Sequence[str] = ()
) -> Solved:
    """Find the cameras.

    Parameters
    ----------
    command : sequence of str
        The worker's command line, without the request; empty: our own.

    Raises
    ------
    DataError
        COLMAP gave up or died; says when, and its last words.
    """
    work = Path(request.database).parent
    with atomic_write(work / "request.json", "w") as file:
        json.dump(asdict(request), file)
    words = [*(command or (sys.executable, "-c", _WORKER)), str(work / "request.json"), *sys.path]
    # Passive waiting: cores are often shared, and spinning threads of one library then stop those of another.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}
    with open(work / "worker.log", "wb") as log:
        process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment, encoding="utf-8"
        )
        try:
            solved, phase = _follow(process, Path(request.database), on_progress, on_note)
        finally:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
    if solved is None:
        raise DataError(_last_words(phase, process.returncode, work / "worker.log"))
    return solved


def _follow(
    process: subprocess.Popen[str], database: Path, on_progress: OnProgress, on_note: OnNote
) -> tuple[Solved | None, str]:
    """Pass progress on until the worker has finished or died."""
    lines: queue.Queue[str | None] = queue.Queue()
    assert process.stdout is not None
    reader = threading.Thread(target=_read_lines, args=(process.stdout, lines), daemon=True)
    reader.start()
    phase, total, before = "", 0, 0
    solved = None
    while True:
        try:
            line = lines.get(timeout=POLL_SECONDS)
        except queue.Empty:
            if phase in _COUNTED:
                done = max(_rows(database, _COUNTED[phase]) - before, 0)
                on_progress(_PHASES[phase], min(done, total), total)
            continue
        if line is None:
            process.wait()
            reader.join()
            return solved, phase
        message = json.loads(line)
        if "models" in message:
            solved = Solved(message["models"], message.get("lens", {}), message.get("refused", {}))
        if "note" in message:
            on_note(message["note"])
        if "phase" in message:
            phase, total = message["phase"], message["total"]
            before = 0
            if phase in ("again", "verifying"):  # those of the first time do not count
                before = _rows(database, _COUNTED[phase]) - message.get("done", 0)
            on_progress(_PHASES[phase], message.get("done", 0), total)
        elif "done" in message:
            on_progress(_PHASES[phase], message["done"], total)


def _read_lines(pipe: IO[str], lines: queue.Queue[str | None]) -> None:
    with contextlib.suppress(ValueError):  # closed under our hands: the command was interrupted
        for line in pipe:
            lines.put(line)
    lines.put(None)


def _rows(database: Path, table: str) -> int:
    """Rows of a table that COLMAP is writing (in WAL mode, in which readers stop nobody); 0 where it cannot be read."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(_open(database)) as connection:
        return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    return 0


def _open(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=1.0)


def _last_words(phase: str, code: int, log: Path) -> str:
    """Return the one line about a worker that died."""
    lines = [line.strip() for line in log.read_text("utf-8", "replace").splitlines() if line.strip()]
    how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
    said = lines[-1][:300] if lines else "it said nothing"
    remedy = "give it less: --threads 2, --feature-size 1000" if code < 0 else "if the disk is not full, report it"
    if (free := shutil.disk_usage(log.parent).free) < _LITTLE_SPACE:  # its last words may not have fitted either
        remedy = f"{free / 1e6:.0f} MB are free on the disk of --out: free some space or choose another folder"
    return f"COLMAP {how} while {_PHASES.get(phase, 'it started')}: {said}; {remedy}"


@dataclass(frozen=True)
class MatchFacts:
    """What the database knows: features of each photograph, and verified matches of each pair that has some."""

    features: dict[str, int]
    matches: dict[tuple[str, str], int]


def read_facts(database: Path) -> MatchFacts:
    """Read the database of a finished worker.

    A pair's number is 2147483647 * (smaller image id) + (larger one) (COLMAP's documentation, Database Format).

    Raises
    ------
    DataError
        It cannot be read: SQLite needs room on the disk to read what another process wrote.
    """
    try:
        with contextlib.closing(_open(database)) as connection:
            names = dict(connection.execute("SELECT image_id, name FROM images"))
            features = dict.fromkeys(names.values(), 0)
            features |= {names[i]: rows for i, rows in connection.execute("SELECT image_id, rows FROM keypoints")}
            found = connection.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0")
            matches = {(names[pair // 2147483647], names[pair % 2147483647]): rows for pair, rows in found}
    except (sqlite3.Error, KeyError) as error:
        raise DataError(
            f"{database} must be the database that COLMAP wrote, it cannot be read: {error}; free some space, or "
            f"remove {database.parent} and begin anew"
        ) from error
    return MatchFacts(features, matches)
