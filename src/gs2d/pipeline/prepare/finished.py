"""A finished run, opened again: its splats, and what defines it."""

from __future__ import annotations

from pathlib import Path

import torch

from gs2d.core.splats import Splats
from gs2d.errors import DataError, RunError
from gs2d.io import splat_ply
from gs2d.io.formats.registry import read_splats
from gs2d.io.georeference import georeference_of_file
from gs2d.io.run_dir import (
    SPLATS,
    RunFolder,
    open_run,
)
from gs2d.pipeline.events import Notice, OnEvent
from gs2d.pipeline.prepare.job import Job, reload_job
from gs2d.pipeline.prepare.threads import use_threads


def finished_splats(run: RunFolder) -> Splats:
    """Return the splats of a finished run.

    Raises
    ------
    RunError
        Not finished yet, or the file was damaged.
    """
    path = run.file(SPLATS)
    if not path.exists():
        raise RunError(f"{run.path} is not finished: no {SPLATS}; continue it with `gs2d train ... --resume`")
    splats = splat_ply.read_splats(path)
    whole = torch.stack([tensor.unsqueeze(-1).flatten(1).isfinite().all(dim=1) for _, tensor in splats.items()])
    broken = len(splats) - int(whole.all(dim=0).sum())
    if broken:
        raise RunError(
            f"{path} must hold finite numbers, got NaN or infinity in {broken} splats, which would not be drawn; "
            "it was damaged: delete it and continue with `gs2d train ... --resume`"
        )
    return splats


def open_job(
    path: Path, threads: int | None, on_event: OnEvent, *, splats_file: Path | None = None, out: Path | None = None
) -> tuple[RunFolder, Job, Splats]:
    """Return a run, what defines it, and its splats on the device of its backend.

    Parameters
    ----------
    splats_file : Path or None
        Take the splats of this file instead, of any format that is read, in the frame of the run.
    out : Path or None
        Where what is made of it goes, which must be said then: files of the run are of its own splats.
    """
    use_threads(threads)
    run = open_run(path)
    splats = finished_splats(run) if splats_file is None else _splats_of(Path(splats_file), out, on_event)
    job = reload_job(run, on_event)
    return run, job, splats.to(job.backend.device)


def _splats_of(path: Path, out: Path | None, on_event: OnEvent) -> Splats:
    if out is None:
        raise RunError("--splats needs --out: what is in the run is made of its own splats; name another place")
    if path.is_dir():
        raise DataError(f"--splats must be a file of splats, got the folder {path}; give the splats.ply in it")
    if georeference_of_file(path) is not None:
        raise DataError(f"--splats must be in the frame of the run, {path} is in metres of the world; export it again")
    return read_splats(path, lambda text: on_event(Notice(text)))


def checked_output(path: Path, out: Path, ending: str = ".ply", what: str = "") -> Path:
    """``out``, if it may be written: a PLY by its name, and not the splats of the run, from which all else is made.

    Parameters
    ----------
    ending : str
        That of its name.
    what : str
        What needs that ending, for the error.
    """
    path, out = Path(path), Path(out)
    if not f"/{out.name}".lower().endswith(ending):
        raise RunError(
            f"--out must name a {ending.removeprefix('/')} file, which is what {what or 'is written'}, got {out}"
        )
    if out.resolve() == (path / SPLATS).resolve():
        raise RunError(f"--out {out} is the splats of the run, which stay as they are; choose another name")
    return out
