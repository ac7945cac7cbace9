"""The run folder: definition, log, checkpoints and results of a run.

::

    RUN/
      run.json       definition of the run (recipe, protocol, scene, backend, seed ...), versions, machine
      events.jsonl   one JSON object per line; after a resume it is the same as without an interruption
      checkpoints/   <stage number>-<stage>-<iteration>.pt (the last two), <stage number>-<stage>-end.pt (all)
      metrics.json  splats.ply  mesh.ply  mesh.glb (with --texture)  renders/  report.html
      scene.html     the splats as a web page (`gs2d export`)
      poses.json  learned.json  learned properties of images and cameras
      edits/         0001.ply ...: the splats before each edit (`gs2d edit`)
      subject.json   the subject that the cameras look at (data.subject_box)
      georeference.json  position of the run in the world, if it was surveyed
      .lock          held by the process that trains; the operating system releases it when that process ends

Every file is written to a temporary name and renamed, except the log, which is appended to: each checkpoint stores the
length of the log, and a resume truncates the log to it.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import importlib.metadata
import json
import os
import platform
import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gs2d import __version__
from gs2d.core.atomic_files import atomic_write, disk_error, is_temporary, sweep
from gs2d.core.growth import check_entries
from gs2d.core.json_files import read_json, write_json
from gs2d.core.locks import try_lock
from gs2d.core.missing import path_hint, suggestion
from gs2d.core.processes import available_cores
from gs2d.core.text import first_line
from gs2d.errors import DataError, DiskError, RunError
from gs2d.io.run_schema import DEFINITION_SHAPE, METRICS_SHAPE, check_shape

RUN_JSON, EVENTS, METRICS, LOCK = "run.json", "events.jsonl", "metrics.json", ".lock"
CHECKPOINTS, RENDERS, SURFACE, EDITS = "checkpoints", "renders", "surface", "edits"
TRANSIENTS, SHINE = "transients", "shine"  # maps of training
SPLATS, MESH, TEXTURED, REPORT, PAGE = "splats.ply", "mesh.ply", "mesh.glb", "report.html", "scene.html"
POSES, LEARNED, SUBJECT, VERDICT = "poses.json", "learned.json", "subject.json", "verdict.json"
GEOREFERENCE = "georeference.json"
FORMAT = 2
MAX_CHECKPOINTS = 2
_UNREADABLE = (
    *(OSError, RuntimeError, EOFError, LookupError, TypeError, ValueError, AttributeError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
_CHECKPOINT_NAME = re.compile(r"(\d+)-(.+)-(\d+|end)\.pt")


class EventLog:
    """Append-only file with one JSON object per line, flushed after each line."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, event: dict[str, Any]) -> None:
        """Write one event.

        Raises DiskError if it could not be written; the log then ends with its last complete line.
        """
        line = (json.dumps(event, allow_nan=False, sort_keys=True) + "\n").encode()
        self.append_text(line)

    def append_text(self, lines: bytes) -> None:
        """Write several lines (the log of a cached stage)."""
        start = self.size
        try:
            with open(self.path, "ab") as file:
                file.write(lines)
        except OSError as error:
            with contextlib.suppress(DiskError):
                self.cut(start)
            raise disk_error(self.path, error) from error

    @property
    def size(self) -> int:
        """Size of the log in bytes."""
        return self.path.stat().st_size if self.path.exists() else 0

    def cut(self, size: int) -> None:
        """Truncate the log to ``size`` bytes, and remove an incomplete last line."""
        if not self.path.exists():
            return
        try:
            with open(self.path, "r+b") as file:
                data = file.read(size)
                file.truncate(data.rfind(b"\n") + 1)
        except OSError as error:
            raise disk_error(self.path, error) from error

    def read_bytes(self, size: int) -> bytes:
        """Return the first ``size`` bytes, or all if there are fewer."""
        if not self.path.exists():
            return b""
        with open(self.path, "rb") as file:
            return file.read(size)

    def sync(self) -> None:
        """Flush the log to disk, before a checkpoint refers to its length."""
        if not self.path.exists():
            return
        try:
            with open(self.path, "rb") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise disk_error(self.path, error) from error

    def read(self) -> list[dict[str, Any]]:
        """Return all complete events.

        Raises RunError if a line is no JSON object.
        """
        if not self.path.exists():
            return []
        text = self.path.read_text(encoding="utf-8", errors="replace")
        events = []
        for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
            try:
                events.append(dict(json.loads(line)))
            except (ValueError, TypeError, RecursionError) as error:
                raise RunError(
                    f"{self.path} line {number} must be a JSON object, got {line[:40]!r}; "
                    "the log was damaged: remove that line"
                ) from error
        return events


@dataclass(frozen=True)
class CheckpointFile:
    """A checkpoint on disk."""

    path: Path
    stage_index: int
    stage: str
    iteration: int | None  # within the stage; None at its end

    @property
    def progress(self) -> tuple[int, float]:
        """Sort key: stage and iteration."""
        return self.stage_index, float("inf") if self.iteration is None else float(self.iteration)


class RunFolder:
    """One run on disk. :func:`claim_run` creates or continues one, :func:`open_run` opens an existing one."""

    def __init__(self, path: Path, created: tuple[Path, ...] = ()) -> None:
        self.path = path
        self.created = created  # folders that were created for it
        self.events = EventLog(path / EVENTS)

    def file(self, name: str) -> Path:
        """Return the path of a file of the run."""
        return self.path / name

    # -- definition and results ----------------------------------------------------------------------------------------
    def write_definition(self, definition: dict[str, Any]) -> None:
        """Write ``run.json``: the definition, with versions, machine and time."""
        extra = {"format": FORMAT, "versions": versions(), "machine": machine(), "created": now()}
        write_json(self.file(RUN_JSON), {**extra, **definition})

    def definition(self) -> dict[str, Any]:
        """Read ``run.json``.

        Raises RunError if another version of gs2d wrote it, or it is damaged.
        """
        try:
            data = _object(self.file(RUN_JSON))
        except RecursionError as error:
            raise RunError(f"{self.file(RUN_JSON)} is nested too deeply and must be damaged; restore it") from error
        if data.get("format") != FORMAT:
            tools = data.get("versions")
            writer = f"gs2d {tools['2dgs-r']}" if isinstance(tools, dict) and "2dgs-r" in tools else "another version"
            raise RunError(
                f"{self.file(RUN_JSON)} has format {str(data.get('format'))[:40]}, expected {FORMAT}; use "
                f"{writer[:40]}, which wrote it, or train again with --overwrite"
            )
        check_shape(self.file(RUN_JSON), data, DEFINITION_SHAPE, "restore it, or train again with --overwrite")
        return data

    def metrics(self) -> dict[str, Any]:
        """Read ``metrics.json``; ``{"stages": []}`` before the first stage is finished.

        Raises RunError if it is damaged.
        """
        path = self.file(METRICS)
        if not path.exists():
            return {"stages": []}
        data = _object(path)
        check_shape(path, data, METRICS_SHAPE, "delete it and continue with --resume")
        return data

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Replace ``metrics.json``."""
        write_json(self.file(METRICS), metrics)

    # -- checkpoints ---------------------------------------------------------------------------------------------------
    def checkpoints(self) -> list[CheckpointFile]:
        """Return all checkpoints, oldest first."""
        checkpoints = []
        for path in self.file(CHECKPOINTS).glob("*.pt"):
            match = _CHECKPOINT_NAME.fullmatch(path.name)
            if match:
                iteration = None if match[3] == "end" else int(match[3])
                checkpoints.append(CheckpointFile(path, int(match[1]), match[2], iteration))
        return sorted(checkpoints, key=lambda checkpoint: checkpoint.progress)

    def save_checkpoint(self, stage_index: int, stage: str, iteration: int | None, payload: dict[str, Any]) -> Path:
        """Write a checkpoint (``iteration=None``: the end of the stage) and remove older ones.

        The last two checkpoints within a stage are kept until it ends.
        """
        folder = self.file(CHECKPOINTS)
        make_folder(folder)
        number = "end" if iteration is None else f"{iteration:07d}"
        path = folder / f"{stage_index}-{stage}-{number}.pt"
        self.events.sync()
        save_tensors(path, {**payload, "events_bytes": self.events.size})
        within = [c for c in self.checkpoints() if c.iteration is not None]
        for checkpoint in within if iteration is None else within[:-MAX_CHECKPOINTS]:
            checkpoint.path.unlink(missing_ok=True)
        return path

    # -- ownership -----------------------------------------------------------------------------------------------------
    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the run, and remove incomplete files of killed processes.

        Raises RunError if another process trains in this folder.
        """
        try:
            file = open(self.file(LOCK), "a+b")  # noqa: SIM115 - closed below; the lock lives as long as the file
        except OSError as error:
            raise disk_error(self.file(LOCK), error) from error
        try:
            if not try_lock(file.fileno()):
                raise RunError(f"{self.path} is being trained by another process; wait for it or choose another --out")
            self.sweep()
            yield
        finally:
            file.close()

    def sweep(self) -> None:
        """Remove files of killed processes: temporary files, and checkpoints within stages that have ended."""
        renders = (Path(folder) for folder, _, _ in os.walk(self.file(RENDERS)))
        for folder in (self.path, *map(self.file, (CHECKPOINTS, SURFACE, EDITS)), *renders):
            sweep(folder)
        ended = max((c.stage_index for c in self.checkpoints() if c.iteration is None), default=-1)
        for checkpoint in self.checkpoints():
            if checkpoint.iteration is not None and checkpoint.stage_index <= ended:
                with contextlib.suppress(OSError):
                    checkpoint.path.unlink()

    def clear(self) -> None:
        """Delete the files of the run only; ``run.json`` last, so that an interrupted call can be repeated."""
        for name in (CHECKPOINTS, RENDERS, SURFACE, EDITS, TRANSIENTS, SHINE):
            shutil.rmtree(self.file(name), ignore_errors=True)
        results = (SPLATS, SUBJECT, VERDICT, GEOREFERENCE, MESH, TEXTURED, REPORT, PAGE)
        for name in (EVENTS, METRICS, POSES, LEARNED, *results, RUN_JSON):
            self.file(name).unlink(missing_ok=True)

    def discard(self) -> None:
        """Remove a run that failed early: its files, and the folders that were created for it."""
        self.clear()
        self.file(LOCK).unlink(missing_ok=True)
        remove_created(self.created)


def _object(path: Path) -> dict[str, Any]:
    """Read a JSON file that contains an object."""
    data = read_json(path)
    if not isinstance(data, dict):
        raise RunError(f"{path} must hold a JSON object, got {type(data).__name__}; restore it")
    return data


def is_run(path: Path) -> bool:
    """Return whether a folder contains a run."""
    return (path / RUN_JSON).is_file()


def open_run(path: str | Path) -> RunFolder:
    """Open an existing run.

    Raises RunError if the folder does not exist or contains no run.
    """
    path = Path(path)
    if not is_run(path):
        actual = "a folder without run.json" if path.is_dir() else "a file" if path.exists() else "nothing"
        remedy = suggestion(path, "run") if path.exists() else path_hint(path)
        raise RunError(f"expected a run folder at {path}, got {actual}{remedy}")
    return RunFolder(path)


def check_claim(path: str | Path, *, resume: bool, overwrite: bool, allowed: tuple[str, ...] = ()) -> None:
    """Check early that :func:`claim_run` will succeed; writes nothing.

    Raises RunError if ``path`` is a file, contains a run (without ``resume`` or ``overwrite``), or other files.
    """
    path = Path(path)
    if resume and overwrite:
        raise RunError("--resume and --overwrite exclude each other; use one of them")
    try:
        path.stat()
    except FileNotFoundError:
        return
    except OSError as error:  # for example a name that is too long
        raise disk_error(path, error) from error
    if not path.is_dir():
        raise RunError(f"--out must be a folder, {path} is a file")
    if is_run(path):
        if not (resume or overwrite):
            raise RunError(f"{path} already holds a run; continue it with --resume, replace it with --overwrite")
        return
    names = {entry.name for entry in path.iterdir()} - {LOCK, *allowed}
    unfinished = {name for name in names if name.startswith(f".{RUN_JSON}.") and is_temporary(name)}  # of a killed run
    others = sorted(names - unfinished)
    if others:
        raise RunError(
            f"--out must be new, empty or a run; {path} holds other files ({others[0]}); choose another folder"
        )


def claim_run(path: str | Path, *, resume: bool, overwrite: bool, allowed: tuple[str, ...] = ()) -> RunFolder:
    """Create a run folder, or take over an existing run.

    ``resume`` and ``overwrite``: continue or replace an existing run; ``overwrite`` deletes the files of the run only.
    ``allowed``: names of files that may exist in a folder without a run.
    """
    check_claim(path, resume=resume, overwrite=overwrite, allowed=allowed)
    path = Path(path)
    created = make_folder(path)
    run = RunFolder(path, created)
    if overwrite:
        with run.locked():
            run.clear()
    return run


def make_folder(path: Path) -> tuple[Path, ...]:
    """Create a folder and its parents; returns the created folders, innermost first."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(path, error) from error
    return tuple(missing)


def remove_created(folders: tuple[Path, ...]) -> None:
    """Remove the folders that ``make_folder`` created, if they are empty."""
    for folder in folders:
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()


def save_tensors(path: Path, payload: dict[str, Any]) -> None:
    """Write with ``torch.save`` to a temporary name, then rename."""
    import torch

    with atomic_write(path) as file:
        torch.save(payload, file)


def load_tensors(path: Path) -> dict[str, Any]:
    """Read a file of :func:`save_tensors`: tensors and plain values only, no code is executed.

    torch does not verify the checksums in its files, so they are verified here. Raises RunError if the file is missing
    or damaged.
    """
    import pickle

    import torch

    try:
        with zipfile.ZipFile(path) as archive:
            packed = [e.filename for e in check_entries(path, archive.infolist()) if e.compress_size < e.file_size]
            if packed:  # torch does not compress
                raise ValueError(f"{packed[0]} is compressed")
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"the checksum of {damaged} is wrong")
        with warnings.catch_warnings():  # torch warns about a damaged header
            warnings.simplefilter("ignore")
            return dict(torch.load(path, map_location="cpu", weights_only=True))
    except (*_UNREADABLE, DataError, pickle.UnpicklingError) as error:
        reason = first_line(error)
        raise RunError(f"{path} is not a readable checkpoint ({reason}); delete it") from error


def versions() -> dict[str, str]:
    """Return the versions that the result depends on."""
    own = {"python": platform.python_version(), "2dgs-r": __version__}
    return own | {name: _installed_version(name) for name in ("torch", "numpy", "scipy", "pillow")}


@functools.cache  # every checkpoint needs it, and reading the metadata takes 10 ms
def _installed_version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def machine() -> dict[str, Any]:
    """Describe the machine: system, processor and cores."""
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    return {"system": f"{platform.system()} {platform.release()}", "processor": model, "cores": available_cores()}


def now() -> str:
    """Return the UTC time, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
