"""``gs2d reconstruct``: photographs or a video become cameras, splats, mesh, report and page, in one run folder."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json
from gs2d.core.missing import suggestion
from gs2d.data import detect_format
from gs2d.data.masks import OFF
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.run_dir import MESH, TEXTURED, RunFolder, is_run, make_folder
from gs2d.meshing.texture import required
from gs2d.pipeline.attempts import attempted_file
from gs2d.pipeline.finish.run_texture import PACKAGE, texture_run
from gs2d.pipeline.prepare.loaded import difference
from gs2d.pipeline.prepare.options import (
    Effort,
    HowItRuns,
    PosesOptions,
    ReconstructOptions,
    Resources,
    Training,
    TrainOptions,
    values,
)
from gs2d.pipeline.prepare.pose_finding import (
    check_poses_options,
    find_poses,
    lost_lines,
    placed_line,
    requested_options,
)
from gs2d.pipeline.prepare.resolve import check_options
from gs2d.pipeline.train.train_run import check_places, train
from gs2d.sfm.colmap_process import check_installed
from gs2d.sfm.photos import find_photos
from gs2d.sfm.video_frames import is_video, look_into
from gs2d.sfm.workspace import POSES_JSON, POSES_PNG, hidden_workspace, sweep_workspace
from gs2d.training.events import Notice, OnEvent, ignore

CAPTURE = "capture"
_PLAIN = re.compile(r"(images?|input|frames|rgb|photos?|photographs)(_\d+)?", re.IGNORECASE)


def capture_title(photos: Path) -> str:
    """Return the title of a reconstruction: the name of the video or folder, of the folder above for "images"."""
    if is_video(photos):
        return photos.stem
    return photos.parent.name or photos.name if _PLAIN.fullmatch(photos.name) else photos.name


def poses_options(options: ReconstructOptions) -> PosesOptions:
    """Return the options of ``gs2d poses``, which writes the capture into the run folder."""
    match_masked = options.match_masked or options.masked == OFF
    changed = {"out": options.out / CAPTURE, "match_masked": match_masked}
    return PosesOptions(**{**values(PosesOptions, options), **changed})


def train_options(options: ReconstructOptions) -> TrainOptions:
    """Return the options of ``gs2d train``."""
    kinds = (Training, Effort, HowItRuns, Resources)
    shared = {name: value for kind in kinds for name, value in values(kind, options).items()}
    return TrainOptions(scene=options.out / CAPTURE, format="colmap", **shared)


def reconstruct(options: ReconstructOptions, on_event: OnEvent = ignore) -> RunFolder:
    """Estimate the cameras of photographs and train on them; resumable.

    Options are checked before anything is written. The capture stays in the run folder once it is complete, even if
    training fails: ``resume`` then does not estimate the cameras again.
    """
    check_reconstruct(options)
    capture = options.out / CAPTURE
    if options.resume and (capture / POSES_JSON).exists():
        poses = _same_poses(capture, options)
        sweep_workspace(capture)
        on_event(Notice(f"using the cameras in {capture}: {placed_line(poses)}"))
    else:
        with _claimed(options.out):
            poses = find_poses(poses_options(options), on_event)
            if options.overwrite:  # its checkpoints belong to other cameras
                RunFolder(options.out).clear()
        for line in (f"{placed_line(poses)}; {capture / POSES_PNG} shows them", *lost_lines(poses)):
            on_event(Notice(line))
    training = replace(train_options(options), overwrite=False)
    run = train(training, on_event, title=capture_title(options.photos.resolve()), allowed=_allowed(options))
    if options.texture and not run.file(TEXTURED).exists():
        with attempted_file(run, TEXTURED, on_event):
            if not run.file(MESH).exists():
                raise ProtocolError(f"there is no {MESH} to texture")
            texture_run(run.path, on_event=on_event, threads=options.threads)
    return run


def _allowed(options: ReconstructOptions) -> tuple[str, ...]:
    """Return the names that may be in the run folder before training begins."""
    return (CAPTURE, hidden_workspace(options.out / CAPTURE).name)


# -- checks ------------------------------------------------------------------------------------------------------------
def check_reconstruct(options: ReconstructOptions) -> None:
    """Raise for anything that prevents the reconstruction, before anything is written."""
    training, out = train_options(options), options.out
    check_options(training)
    check_places(training, _allowed(options))
    if options.texture:
        required(PACKAGE)
    if options.resume and (out / CAPTURE / POSES_JSON).exists():
        _same_poses(out / CAPTURE, options)
        return
    if options.resume and is_run(out):
        raise RunError(
            f"{out} holds a run without the cameras of `gs2d reconstruct` in {CAPTURE}/; continue it with `gs2d "
            "train`, choose another --out, or start again with --overwrite"
        )
    check_installed()
    check_poses_options(poses_options(options))
    _check_photos(options)
    if (out / CAPTURE).exists() and not options.overwrite:
        raise RunError(f"{out} holds cameras and no run: continue with --resume, or start again with --overwrite")


def _check_photos(options: ReconstructOptions) -> None:
    """Raise if the folder has no photographs, has cameras too, or overlaps with the run folder."""
    photos, out = options.photos, options.out
    look_into(photos) if is_video(photos) else find_photos(photos)
    folder, run = photos.resolve(), out.resolve()
    if run == folder or folder in run.parents or run in folder.parents:
        raise RunError(f"--out {out} and the photographs {photos} must be separate folders")
    try:
        kind = detect_format(photos)
    except DataError:
        return
    raise DataError(
        f"{photos} must hold photographs only, got cameras too ({kind}): gs2d train {shlex.quote(str(photos))} --out "
        f"{shlex.quote(str(out))} trains with these; to estimate others"
        f"{suggestion(photos, 'photographs').removeprefix(';')}"
    )


@contextmanager
def _claimed(out: Path) -> Iterator[None]:
    """Lock the run folder while cameras are estimated; remove it after a failure if it did not exist before."""
    run = RunFolder(out, make_folder(out))
    with run.locked():
        try:
            yield
        except BaseException:
            if not is_run(out):
                run.discard()
            raise


def _same_poses(capture: Path, options: ReconstructOptions) -> dict[str, Any]:
    """Return the contents of ``poses.json``; raise RunError if it has other photographs or options."""
    poses, requested = read_json(capture / POSES_JSON), requested_options(poses_options(options))
    try:
        stored = {"photos": poses["photos"], **poses["requested"]}
        requested = {"photos": str(options.photos.resolve()), **requested}
        if stored != requested:
            raise RunError(
                f"{capture} was made with other options{difference(stored, requested)}; resume with the same, or start "
                "again with --overwrite"
            )
        if options.photos.is_dir():  # it is no longer needed and may be gone
            old = {row["source"] for row in poses["photographs"]}
            now = {path.relative_to(options.photos).as_posix() for path in find_photos(options.photos)[0]}
            if old != now:
                name = min(old ^ now)
                what = f"{name} is {'new in' if name in now else 'missing from'} {options.photos}"
                raise RunError(f"{what} since the cameras were estimated; start again with --overwrite")
        placed_line(poses)
        lost_lines(poses)
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise RunError(
            f"{capture / POSES_JSON} is not as `gs2d reconstruct` writes it ({error}); start again with --overwrite"
        ) from error
    return dict(poses)
