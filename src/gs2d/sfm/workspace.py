"""Where a capture is made before it has its name: it appears as a whole or not at all.

All work is done in the hidden folder ``.NAME.poses`` beside the capture: copies, COLMAP's database, models. What an
interrupted or killed command leaves there is resumed by the next one with the same ``--out`` (``search``), or
removed where nothing says of what it was made.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from gs2d.core.files import disk_error
from gs2d.core.json_files import read_json
from gs2d.data.masks import FOLDER as MASKS
from gs2d.errors import DataError, DiskError, RunError
from gs2d.io.run_dir import LOCK, RunFolder, make_folder, remove_made
from gs2d.sfm.search import SEARCH

IMAGES, SPARSE, POSES_JSON, POSES_PNG = "images", "sparse", "poses.json", "poses.png"
STAGED = "capture"  # the new one, in the workplace
OLD = "old"  # an earlier capture, until the new one has its name
EXIT_BUG = (IMAGES, SPARSE, POSES_JSON, POSES_PNG)


def check_out(given: Path, images: Path, *, overwrite: bool) -> None:
    """Raise before anything slow begins, where the capture cannot or must not be put."""
    out, photos = given.resolve(), images.resolve()
    if out == photos or photos in out.parents or out in photos.parents:
        raise RunError(
            f"--out {given} must lie beside the photographs, not in their folder or above it ({images}): "
            "that folder is only read"
        )
    try:
        entries = {entry.name for entry in out.iterdir()}
    except FileNotFoundError:
        return
    except NotADirectoryError as error:
        raise RunError(f"--out must be a folder, {given} is a file or lies below one") from error
    except OSError as error:
        raise disk_error(out, error) from error
    if out.is_mount():
        raise RunError(f"--out {given} is where a disk is mounted, and cannot be renamed; choose a folder in it")
    others = sorted(entries - set(EXIT_BUG) - ({MASKS} if _has_masks_of_ours(out) else set()))
    if POSES_JSON in entries and not others:
        if not overwrite:
            raise RunError(f"{given} already holds a capture; replace it with --overwrite")
    elif entries:
        raise RunError(
            f"--out must be new, empty or a capture of this command; {given} holds other files "
            f"({(others or sorted(entries))[0]}); choose another folder"
        )
    if out == Path.cwd() or out in Path.cwd().parents:
        raise RunError(f"--out {given} is the folder that you are in, and is replaced as a whole; go elsewhere")


def _has_masks_of_ours(out: Path) -> bool:
    """Whether the masks of a capture were put there by this command: nobody else's are replaced."""
    try:
        return bool(read_json(out / POSES_JSON).get("masks"))
    except (DataError, AttributeError):
        return False


def hidden_workspace(out: Path) -> Path:
    """Where the capture ``out`` is made."""
    return out.with_name(f".{out.name[:200]}.poses")


@contextlib.contextmanager
def workspace(out: Path) -> Iterator[Path]:
    """Hold a hidden folder beside the capture against other processes; remove it at the end, but for a search.

    It is empty, or has what a search that was interrupted left; ``search.forget`` ends one.

    Raises
    ------
    RunError
        Another process makes the same capture.
    """
    work = hidden_workspace(out)
    made = make_folder(work)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(RunFolder(work).locked())
        except RunError as error:
            raise RunError(f"{out} is being made by another process; wait for it or choose another --out") from error
        try:
            if (work / OLD).exists() and not out.exists():  # killed between two renames
                os.rename(work / OLD, out)
            if not (work / SEARCH).exists():
                _empty(work)
            yield work
        finally:
            if not (work / SEARCH).exists():
                shutil.rmtree(work, ignore_errors=True)
    remove_made(made)  # where an open lock cannot be deleted


def sweep_workspace(out: Path) -> None:
    """Remove the workplace of a capture that is in place: a command was killed while it removed it.

    One that another process holds stays, and so does one in which another capture is being made.
    """
    work = hidden_workspace(out)
    done = (out / POSES_JSON).exists() and not ((work / SEARCH).exists() and (work / STAGED).exists())
    if done and work.is_dir():
        with contextlib.suppress(RunError, DiskError), RunFolder(work).locked():
            shutil.rmtree(work, ignore_errors=True)


def _empty(work: Path) -> None:
    for entry in work.iterdir():
        if entry.name != LOCK:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def put_in_place(capture: Path, out: Path, work: Path) -> None:
    """Rename the finished capture to its name; an older one goes with the workplace."""
    try:
        if out.exists():
            os.rename(out, work / OLD)
        os.rename(capture, out)
    except OSError as error:
        if (work / OLD).exists() and not out.exists():
            os.rename(work / OLD, out)
        raise disk_error(out, error) from error
