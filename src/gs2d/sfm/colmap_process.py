"""Run COLMAP in a separate process and report its progress."""

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from gs2d.core.atomic_files import atomic_write
from gs2d.core.extras import install
from gs2d.errors import BackendError, DataError
from gs2d.sfm.search import count, read_only

OnProgress = Callable[[str, int, int], None]  # name of the phase, finished steps, total steps
OnNote = Callable[[str], None]  # a message to show
Request = Mapping[str, Any]  # input of the worker, from ``pose_finding``; the worker reads it as JSON
MISSING = f"structure from motion needs pycolmap, which is not installed: {install('sfm')}"
POLL_SECONDS = 0.5
_LITTLE_SPACE = 64 << 20  # bytes; SQLite frees what it could not finish writing when it gives up
# The worker gets the module search path of this process: `-m` would find a random.py in the current folder first.
_WORKER = "import sys; sys.path[:] = sys.argv[2:]; from gs2d.sfm.colmap_worker import main; main(sys.argv[1])"
_PAIRS = "two_view_geometries"
_COUNTED = {"features": "keypoints", "matching": _PAIRS, "verifying": _PAIRS}  # tables with one row per step
_ON_GPU = ("", "features", "comparing", "matching")  # phases in which a failure may be the GPU's
_PHASES = {
    "features": "finding features",
    "comparing": "finding similar photographs",
    "matching": "matching pairs",
    "verifying": "matching as fisheyes",
    "cameras": "placing cameras",
    "lenses": "adjusting the lens",
    "extending": "placing more cameras",
}


def layers(request: Request) -> dict[str, Any]:
    """Return the inputs of features, pairs and mapping, for :func:`gs2d.sfm.search.go_on`."""
    pairs = ("in_order", "ordered_by", "places", "matching", "overlap", "neighbours")
    features = ("groups", "feature_size", "seed", *(("masks",) if request["masks"] is not None else ()))
    return {
        "features": {name: request[name] for name in features},
        "pairs": {name: request[name] for name in pairs},
        "mapping": {name: request[name] for name in ("asked_lens", "mapper")},
    }


def check_installed() -> None:
    """Raise BackendError where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise BackendError(MISSING)


def solve(
    request: Request, on_progress: OnProgress, on_note: OnNote = lambda _line: None, *, command: Sequence[str] = ()
) -> dict[str, Any]:
    """Estimate the cameras; return what ``colmap_worker.map_`` does.

    ``command``: command line of the worker, without the request (default: ``colmap_worker``). Raises DataError if the
    worker failed or crashed; with the phase and its last line. A worker that fails on the GPU, where a driver may be
    missing, is started again on the CPU and continues with what is in the database.
    """
    try:
        return _solve(request, on_progress, on_note, command)
    except _GpuError as error:
        on_note(f"{str(error).rpartition('; ')[0]} on the GPU; continuing on the CPU")
    return _solve({**request, "on_cpu": True}, on_progress, on_note, command)


class _GpuError(DataError):
    """The worker failed while it used the GPU."""


def _solve(request: Request, on_progress: OnProgress, on_note: OnNote, command: Sequence[str]) -> dict[str, Any]:
    work = Path(request["database"]).parent
    with atomic_write(work / "request.json", "w") as file:
        json.dump(request, file)
    words = [*(command or (sys.executable, "-c", _WORKER)), str(work / "request.json"), *sys.path]
    # Cores are often shared: with active waiting, idle threads of one library block those of another.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}
    with open(work / "worker.log", "wb") as log:
        process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment, encoding="utf-8"
        )
        try:
            solved, phase, on_gpu = _follow(process, Path(request["database"]), on_progress, on_note)
        finally:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
    if solved is None:
        failure = _GpuError if on_gpu and phase in _ON_GPU else DataError
        raise failure(_last_words(phase, process.returncode, work / "worker.log"))
    return solved


def _follow(
    process: subprocess.Popen[str], database: Path, on_progress: OnProgress, on_note: OnNote
) -> tuple[dict[str, Any] | None, str, bool]:
    """Report progress until the worker ends; returns its result, if any, its last phase, and if it uses the GPU."""
    lines: queue.Queue[str | None] = queue.Queue()
    assert process.stdout is not None
    reader = threading.Thread(target=_read_lines, args=(process.stdout, lines), daemon=True)
    reader.start()
    phase, total, before = "", 0, 0
    solved, on_gpu = None, False
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
            return solved, phase, on_gpu
        message = json.loads(line)
        if "models" in message:
            solved = message
        on_gpu |= "gpu" in message
        if "note" in message:
            on_note(message["note"])
        if "phase" in message:
            phase, total = message["phase"], message["total"]
            before = 0
            if phase == "verifying":  # do not count pairs that are already in the table
                before = _rows(database, _COUNTED[phase])
            on_progress(_PHASES[phase], message.get("done", 0), total)
        elif "done" in message:
            on_progress(_PHASES[phase], message["done"], total)


def _read_lines(pipe: IO[str], lines: queue.Queue[str | None]) -> None:
    with contextlib.suppress(ValueError):  # the pipe was closed because the command was interrupted
        for line in pipe:
            lines.put(line)
    lines.put(None)


def _rows(database: Path, table: str) -> int:
    """Count the rows of a table while COLMAP writes it; 0 if unreadable."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(read_only(database)) as connection:
        return count(connection, table)
    return 0


def _last_words(phase: str, code: int, log: Path) -> str:
    """Describe the failure of a worker in one line."""
    lines = [line.strip() for line in log.read_text("utf-8", "replace").splitlines() if line.strip()]
    how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
    output = lines[-1][:300] if lines else "no output"
    remedy = "use less memory: --threads 2, --set feature_size=1000" if code < 0 else "if the disk has room, report it"
    if (free := shutil.disk_usage(log.parent).free) < _LITTLE_SPACE:  # the log may be cut short too
        remedy = f"{free / 1e6:.0f} MB are free on the disk of --out: free some space or choose another folder"
    return f"COLMAP {how} while {_PHASES.get(phase, 'starting')}: {output}; {remedy}"


@dataclass(frozen=True)
class MatchCounts:
    """Number of features of each image, and of verified matches of each pair that has any."""

    features: dict[str, int]
    matches: dict[tuple[str, str], int]


def read_match_counts(database: Path) -> MatchCounts:
    """Read the database of a finished worker.

    A pair's number is 2147483647 * (smaller image id) + (larger one) (COLMAP's documentation, Database Format). Raises
    DataError if it cannot be read. SQLite needs free disk space to read a database that another process wrote.
    """
    try:
        with contextlib.closing(read_only(database)) as connection:
            names = dict(connection.execute("SELECT image_id, name FROM images"))
            features = dict.fromkeys(names.values(), 0)
            features |= {names[i]: rows for i, rows in connection.execute("SELECT image_id, rows FROM keypoints")}
            pairs = connection.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0")
            matches = {(names[pair // 2147483647], names[pair % 2147483647]): rows for pair, rows in pairs}
    except (sqlite3.Error, KeyError) as error:
        raise DataError(
            f"cannot read the COLMAP database {database}: {error}; free some disk space, or remove {database.parent} "
            "and start again"
        ) from error
    return MatchCounts(features, matches)
