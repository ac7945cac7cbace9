"""Hidden folder in which a capture is created, so that it appears completely or not at all.

All work is done in ``.NAME.poses`` beside the capture: copies, the COLMAP database, models. The next command with the
same ``--out`` continues an interrupted search there (``search``), or removes the folder if its inputs are unknown.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from gs2d.core.atomic_files import disk_error
from gs2d.core.json_files import read_json
from gs2d.data.masks import FOLDER as MASKS
from gs2d.errors import DataError, DiskError, RunError
from gs2d.io.run_dir import LOCK, RunFolder, make_folder, remove_created
from gs2d.sfm.search import SEARCH

IMAGES, SPARSE, POSES_JSON, POSES_PNG = "images", "sparse", "poses.json", "poses.png"
STAGED = "capture"  # the new capture, in the workspace
OLD = "old"  # an earlier capture, until it is replaced
_FILES = (IMAGES, SPARSE, POSES_JSON, POSES_PNG)


def check_out(path: Path, images: Path, *, overwrite: bool) -> None:
    """Raise RunError or DiskError if the capture cannot or must not be written to ``path``."""
    out, photos = path.resolve(), images.resolve()
    if out == photos or photos in out.parents or out in photos.parents:
        raise RunError(
            f"--out {path} must not be inside or above the folder of the photographs ({images}), which is only read; "
            "choose a folder beside it"
        )
    try:
        entries = {entry.name for entry in out.iterdir()}
    except FileNotFoundError:
        return
    except NotADirectoryError as error:
        raise RunError(f"--out must be a folder, {path} is a file or lies below one") from error
    except OSError as error:
        raise disk_error(out, error) from error
    if out.is_mount():
        raise RunError(f"--out {path} is a mount point, which cannot be renamed; choose a folder in it")
    others = sorted(entries - set(_FILES) - ({MASKS} if _has_own_masks(out) else set()))
    if POSES_JSON in entries and not others:
        if not overwrite:
            raise RunError(f"{path} already holds a capture; replace it with --overwrite")
    elif entries:
        raise RunError(
            f"--out must be new, empty or a capture of this command; {path} holds other files "
            f"({(others or sorted(entries))[0]}); choose another folder"
        )
    if out == Path.cwd() or out in Path.cwd().parents:
        raise RunError(f"--out {path} is the current folder and would be replaced; run the command from elsewhere")


def _has_own_masks(out: Path) -> bool:
    """Whether this command wrote the masks of a capture; other masks are not replaced."""
    try:
        return bool(read_json(out / POSES_JSON).get("masks"))
    except (DataError, AttributeError):
        return False


def hidden_workspace(out: Path) -> Path:
    """Return the folder in which the capture ``out`` is created."""
    return out.with_name(f".{out.name[:200]}.poses")


@contextlib.contextmanager
def workspace(out: Path) -> Iterator[Path]:
    """Lock the hidden folder of a capture; it is removed at the end, unless it holds an unfinished search.

    It is empty or holds an interrupted search, which ``search.forget`` ends. Raises RunError if another process creates
    the same capture.
    """
    work = hidden_workspace(out)
    created = make_folder(work)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(RunFolder(work).locked())
        except RunError as error:
            raise RunError(f"{out} is being created by another process; wait for it or choose another --out") from error
        try:
            if (work / OLD).exists() and not out.exists():  # killed between two renames
                os.rename(work / OLD, out)
            if not (work / SEARCH).exists():
                _empty(work)
            yield work
        finally:
            if not (work / SEARCH).exists():
                shutil.rmtree(work, ignore_errors=True)
    remove_created(created)  # on systems where an open lock file cannot be deleted


def sweep_workspace(out: Path) -> None:
    """Remove the workspace of a finished capture, left by a command that was killed while removing it.

    A locked workspace remains, and so does one with an unfinished search.
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
    """Move the finished capture to ``out``; an older one is removed with the workspace."""
    try:
        if out.exists():
            os.rename(out, work / OLD)
        os.rename(capture, out)
    except OSError as error:
        if (work / OLD).exists() and not out.exists():
            os.rename(work / OLD, out)
        raise disk_error(out, error) from error
