"""Edit the splats of a run or a file.

An edit of a run keeps the replaced file as ``edits/0001.ply``, ``edits/0002.ply`` ...; undoing renames the last one
back. An edit does not change the bits of other splats and attributes.
"""

from __future__ import annotations

import filecmp
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.cli.console import Console
from gs2d.contrib.edit.edit_command import EditCommand, EditOptions, Transform
from gs2d.core.atomic_files import atomic_write
from gs2d.core.splats import Splats
from gs2d.core.transforms import transform_splats
from gs2d.data.subject_box import LARGEST
from gs2d.errors import RunError
from gs2d.io import splat_ply
from gs2d.io.formats.splat_formats import write_layout
from gs2d.io.gaussians import Gaussians, Warn
from gs2d.io.run_dir import EDITS, SPLATS, RunFolder, make_folder, open_run
from gs2d.pipeline.attempts import REMADE_BY, remade_by
from gs2d.pipeline.finish.run_subject import centers_inside
from gs2d.pipeline.finish.splat_files import checked_layout, splats_of
from gs2d.pipeline.prepare.loaded import finished_splats


def show_edit(command: EditCommand, console: Console) -> None:
    """Run ``gs2d edit``."""
    result = edit(command.run, command, command.out)
    console.say(f"{result['file']}: {result['splats']:,} splats, before {result['before']:,}")
    for note in result["notes"]:
        console.say(note)
    console.result(result)


def edit(path: Path, options: EditOptions, out: Path | None = None) -> dict[str, Any]:
    """Edit the splats of a run, or write the edited splats of a run or a file to ``out``.

    ``path`` is a run folder, or a file of flat splats, which needs ``out``, a file in the format of its ending. Without
    ``out`` the splats of the run are replaced, undoably. Returns ``file``, ``splats`` and ``before`` (numbers of
    splats), and ``notes``. Raises RunError or DataError if the options contradict each other, the edit changes no splat
    or deletes all, or a file is damaged.
    """
    path, out = Path(path), None if out is None else Path(out)
    _check(path, options, out)
    notes: list[str] = []
    if out is not None:
        layout = checked_layout(path, out)
        before = splats_of(path, notes.append)
        edited = edited_splats(before, options, notes.append)
        notes += write_layout(out, edited, layout)
        return {"file": str(out), "splats": len(edited), "before": len(before), "notes": notes}
    run = open_run(path)
    with run.locked():
        before, since = finished_splats(run), run.file(SPLATS).stat().st_mtime_ns
        edited = _undone(run) if options.undo else edited_splats(before, options, notes.append)
        if not options.undo:
            _replace(run, before, edited)
    outdated = _outdated(run, since if options.undo else None)
    if outdated:
        notes.append(
            f"{', '.join(outdated)}: made from other splats; make again: {'; '.join(dict.fromkeys(outdated.values()))}"
        )
    return {"file": str(run.file(SPLATS)), "splats": len(edited), "before": len(before), "notes": notes}


def edited_splats(splats: Splats, options: EditOptions, warn: Warn) -> Splats:
    """Return splats after an edit; ``warn`` receives messages about a merged file."""
    if options.keep_box is not None:
        return splats.rows(centers_inside(splats, options.keep_box, "--keep-box"))
    if options.delete_box is not None:
        outside = ~centers_inside(splats, options.delete_box, "--delete-box")
        if not bool(outside.any()):
            raise RunError(f"--delete-box contains all {len(splats):,} splats; give a smaller box")
        return splats.rows(outside)
    if options.merge is None:
        return _moved(splats, options.transform)
    other = _moved(splats_of(options.merge, warn), options.transform)
    degrees = splats.sh_degree, other.sh_degree
    if degrees[0] != degrees[1]:
        warn("SH degrees {} and {} are merged; the lower one gets coefficients of 0".format(*degrees))
    return Gaussians.joined([Gaussians.of(splats), Gaussians.of(other)]).disks()


def _moved(splats: Splats, transform: Transform | None) -> Splats:
    """Apply ``--transform``: scale, then rotations about the axes x, y, z of the world, then translation."""
    from scipy.spatial.transform import Rotation

    if transform is None:
        return splats
    scale, angles, translation = transform[0], transform[1:4], transform[4:]
    if not (1 / LARGEST <= scale <= LARGEST and all(abs(value) <= LARGEST for value in (*angles, *translation))):
        numbers = " ".join(f"{value:g}" for value in transform)
        raise RunError(f"--transform needs a positive scale, three angles in degrees and a translation, got {numbers}")
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return transform_splats(splats, scale, rotation, np.array(translation))


def _check(path: Path, options: EditOptions, out: Path | None) -> None:
    """Raise for options that contradict each other, or an edit that is not possible in a run."""
    values = {"--keep-box": options.keep_box, "--delete-box": options.delete_box, "--merge": options.merge}
    edits = [name for name, value in values.items() if value is not None]
    edits += ["--undo"] * options.undo
    edits += ["--transform"] * (options.transform is not None and edits != ["--merge"])
    if len(edits) != 1:
        raise RunError(
            f"expected one of {', '.join(values)}, --transform and --undo, got {' and '.join(edits) or 'none'}; run "
            "the command once for each edit"
        )
    if options.undo and (out is not None or path.is_file()):
        raise RunError("--undo restores the splats of a run: give its folder, without --out")
    if out is None and path.is_file():
        raise RunError(f"{path} is a file, which is not changed; name another one with --out")
    if out is None and edits == ["--transform"]:
        raise RunError(
            "--transform would move the splats away from the cameras of the run; write a file with --out, or place the "
            "splats of another run with --merge OTHER --transform"
        )


def _versions(run: RunFolder) -> list[Path]:
    """Return the splat files of earlier versions, oldest first; delete the copy of a killed edit."""
    files = sorted(run.file(EDITS).glob("[0-9]*.ply"))
    while files and filecmp.cmp(files[-1], run.file(SPLATS), shallow=False):
        files.pop().unlink()
    return files


def _replace(run: RunFolder, before: Splats, edited: Splats) -> None:
    """Replace the splats of a run and keep the old file."""
    same = len(before) == len(edited) and before.sh_degree == edited.sh_degree
    if same and all(bool((value == dict(edited.items())[name]).all()) for name, value in before.items()):
        raise RunError(f"the edit changes none of the {len(before):,} splats; nothing was written")
    versions = _versions(run)
    number = int(versions[-1].stem) + 1 if versions else 1
    make_folder(run.file(EDITS))
    path, backup = run.file(SPLATS), run.file(EDITS) / f"{number:04d}.ply"
    try:
        os.link(path, backup)  # the old file gets a second name; no bytes are copied
    except OSError:  # a file system without links
        with atomic_write(backup) as file, open(path, "rb") as source:
            shutil.copyfileobj(source, file)
        shutil.copystat(path, backup)
    splat_ply.write_splats(path, edited)


def _undone(run: RunFolder) -> Splats:
    """Restore the splat file before the last edit and return its splats."""
    versions = _versions(run)
    if not versions:
        raise RunError(f"{run.path} has no edit to undo")
    restored = splat_ply.read_splats(versions[-1])  # raises if it is damaged
    os.replace(versions.pop(), run.file(SPLATS))
    if not versions:
        shutil.rmtree(run.file(EDITS), ignore_errors=True)
    return restored


def _outdated(run: RunFolder, undone_at: int | None) -> dict[str, str]:
    """Return the files made from other splats than those of the run, with the commands that make them again.

    After an edit, these are all. After an undo, those not made between the splats of the run and the undone edit
    (``undone_at``, ns).
    """
    since = math.inf if undone_at is None else run.file(SPLATS).stat().st_mtime_ns
    return {
        name: remade_by(run, name)
        for name in REMADE_BY
        if run.file(name).exists() and not since <= run.file(name).stat().st_mtime_ns < (undone_at or 0)
    }
