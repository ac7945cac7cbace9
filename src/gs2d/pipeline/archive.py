"""Captures that come as a ZIP file: unpacked into the run folder, where every later command finds them."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from gs2d.data.archive import Archive, capture_root, read_archive, unpack
from gs2d.errors import RunError
from gs2d.io.run_dir import LOCK, RunFolder, check_claim, is_run, make_folder, remove_made
from gs2d.pipeline.events import OnEvent, Phase, Step
from gs2d.pipeline.job import check_train_options
from gs2d.pipeline.options import TrainOptions

UNPACKED = "unpacked"  # in the run folder: a folder for each archive, named by its contents


def train_archive(
    options: TrainOptions, on_event: OnEvent, train: Callable[[TrainOptions, OnEvent], RunFolder]
) -> RunFolder:
    """Train on a capture in a ZIP file: it is unpacked into ``out/unpacked`` once, and is the capture of the run.

    The folder has the name of the archive's contents: another archive does not touch it, the same one (also moved or
    renamed) is not unpacked again. A run that leaves nothing leaves nothing of it; when a run is replaced, the older
    contents go with its end.

    Raises
    ------
    Gs2dError
    """
    options = replace(options, allowed=(*options.allowed, UNPACKED))
    check_train_options(options)
    check_claim(options.out, resume=options.resume, overwrite=options.overwrite, allowed=options.allowed)
    archive = read_archive(options.scene)
    home = options.out / UNPACKED
    if home.is_symlink() or (home.exists() and not home.is_dir()):
        raise RunError(f"{home} must be a folder, for what {options.scene} holds; choose another --out")
    target = home / archive.digest
    with _undone(options.out, target) as ours:
        with RunFolder(options.out).locked():
            make_folder(home)
            if not target.exists():
                _unpack(archive, target, on_event)
                ours.append(target)
        run = train(replace(options, scene=capture_root(target), title=options.title or options.scene.stem), on_event)
    for other in home.iterdir():  # of a run that was replaced
        if other != target:
            shutil.rmtree(other, ignore_errors=True)
    return run


@contextlib.contextmanager
def unpacked_for_a_look(path: Path) -> Iterator[Path]:
    """The root of the capture in a ZIP file, in a temporary folder that goes again.

    Raises
    ------
    DataError, DiskError
    """
    archive = read_archive(path)
    with tempfile.TemporaryDirectory(prefix="gs2d-") as folder:
        target = Path(folder) / archive.digest
        _unpack(archive, target, lambda _: None)
        yield capture_root(target)


def _unpack(archive: Archive, target: Path, on_event: OnEvent) -> None:
    on_event(Phase(f"unpacking {archive.path.name}", len(archive.entries)))
    unpack(archive, target, lambda done: on_event(Step(done)))


@contextlib.contextmanager
def _undone(out: Path, target: Path) -> Iterator[list[Path]]:
    """Take away what was unpacked (the list) for a run that left nothing, and the folders that were made for it."""
    ours: list[Path] = []
    made = make_folder(out)
    try:
        yield ours
    except BaseException:
        if not _is_of(out, target):
            for folder in ours:
                shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # it holds those of an older run
            target.parent.rmdir()
        if not is_run(out):
            (out / LOCK).unlink(missing_ok=True)
        remove_made(made)
        raise


def _is_of(out: Path, target: Path) -> bool:
    """Whether the run in a folder was made with what was unpacked there."""
    if not is_run(out):
        return False
    where = RunFolder(out).definition().get("scene", {}).get("path", "")
    return target.resolve() in (Path(where).resolve(), *Path(where).resolve().parents)
