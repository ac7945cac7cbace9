"""``gs2d reconstruct``: photographs or a video become cameras, splats, mesh, report and page, in one run folder."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json
from gs2d.core.missing import instead
from gs2d.data import detect_format, load_scene
from gs2d.data.masks import OFF
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.run_dir import LOCK, MESH, TEXTURED, RunFolder, check_claim, is_run, make_folder, open_run, remove_made
from gs2d.meshing.texture import required
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.run_texture import PACKAGES as TEXTURE_PACKAGES
from gs2d.pipeline.finish.run_texture import texture_run
from gs2d.pipeline.prepare.options import (
    Finding,
    HowItRuns,
    PosesOptions,
    ReconstructOptions,
    Resources,
    Training,
    TrainOptions,
    values,
)
from gs2d.pipeline.prepare.pose_finding import asked_for, check_poses_options, find_poses, placed_line
from gs2d.pipeline.prepare.resolve import check_options
from gs2d.pipeline.run_parts import PLACED, TEXTURED_TOO, TRAINED
from gs2d.pipeline.train.train_run import check_viewer, train
from gs2d.sfm.colmap_process import check_installed
from gs2d.sfm.photos import find_photos
from gs2d.sfm.video_frames import is_video, look_into
from gs2d.sfm.workspace import POSES_JSON, POSES_PNG, hidden_workspace, sweep_workspace
from gs2d.training.events import Notice, OnEvent, RunPlan, ignore

CAPTURE = "capture"
FEW = 24  # photographs, below which each is needed for the surface and none is held out
NO_NAMES = ("images", "photos", "photographs", "pictures")  # of folders; the one above has a better one
SHOWN_LOST = 3  # photographs without a place that are named; poses.json has all


def poses_options(options: ReconstructOptions) -> PosesOptions:
    """Return those of ``gs2d poses``, which puts the capture into the run folder."""
    finding = values(Finding, options.finding)
    if options.training.masked == OFF:
        finding["match_masked"] = True
    return PosesOptions(
        photos=options.photos,
        out=options.out / CAPTURE,
        threads=options.threads,
        seed=options.seed,
        overwrite=options.overwrite,
        **finding,
    )


def train_options(options: ReconstructOptions) -> TrainOptions:
    """Return those of ``gs2d train``."""
    capture = options.out / CAPTURE
    return TrainOptions(
        scene=capture,
        out=options.out,
        format="colmap",
        quality=options.quality,
        schedule_scale=options.schedule_scale,
        downscale=options.downscale,
        **values(Training, options.training),
        **values(HowItRuns, options),
        **values(Resources, options),
    )


def reconstruct(options: ReconstructOptions, on_event: OnEvent = ignore) -> RunFolder:
    """Find the cameras of photographs and train on them; resumable.

    What can be refused is refused before anything is made. The capture is kept in the run folder from when it is
    whole, also where training fails later: ``resume`` then does not find the cameras again.
    """
    check_reconstruct(options)
    on_event(RunPlan((*PLACED, *(TEXTURED_TOO if options.texture else TRAINED))))
    find_cameras(options, on_event)
    return train_found(options, on_event)


def find_cameras(options: ReconstructOptions, on_event: OnEvent) -> None:
    """Put the photographs with their cameras into the run folder, or take those that ``resume`` finds there."""
    capture = options.out / CAPTURE
    if options.resume and (capture / POSES_JSON).exists():
        poses = _same_poses(capture, options)
        sweep_workspace(capture)
        on_event(Notice(f"the cameras were found before, in {capture}: {placed_line(poses)}"))
    else:
        with _claimed(options.out):
            poses = find_poses(poses_options(options), on_event)
            if options.overwrite:  # its checkpoints are of other cameras
                RunFolder(options.out).clear()
        _tell(poses, capture, on_event)


def train_found(options: ReconstructOptions, on_event: OnEvent) -> RunFolder:
    """Train on the cameras that were found; texture the mesh, if it is asked for."""
    training = replace(train_options(options), overwrite=False)
    if training.test_every is None and training.protocol == "auto" and _placed(options.out / CAPTURE) < FEW:
        training = replace(training, test_every=0)
    run = train(training, on_event, title=_title(options.photos.resolve()), allowed=_allowed(options))
    if options.texture and not run.file(TEXTURED).exists():
        with attempted(TEXTURED, again("mesh", run.path, "--texture"), on_event):
            if not run.file(MESH).exists():
                raise ProtocolError(f"there is no {MESH} to be given a texture")
            texture_run(run.path, on_event=on_event, threads=options.threads)
    return run


def _allowed(options: ReconstructOptions) -> tuple[str, ...]:
    """Return the names that may be in the run folder before training begins."""
    return (CAPTURE, hidden_workspace(options.out / CAPTURE).name)


def _placed(capture: Path) -> int:
    """Return how many photographs have a camera."""
    return len({view.path for view in load_scene(capture, format="colmap", test_every=0).views})


def _title(photos: Path) -> str:
    """Return what the report is called."""
    if is_video(photos):
        return photos.stem
    return photos.parent.name if photos.name.lower() in NO_NAMES and photos.parent.name else photos.name


def check_reconstruct(options: ReconstructOptions) -> None:
    """Refuse what can be refused before anything is made."""
    training, out = train_options(options), options.out
    check_options(training)
    check_claim(out, resume=options.resume, overwrite=options.overwrite, allowed=_allowed(options))
    if options.texture:
        for package in TEXTURE_PACKAGES:
            required(package)
    check_viewer(training)
    if training.start_from is not None:
        open_run(training.start_from)
    if training.cache is not None:
        remove_made(make_folder(training.cache))
    if options.resume and (out / CAPTURE / POSES_JSON).exists():
        _same_poses(out / CAPTURE, options)
        return
    if options.resume and is_run(out):
        raise RunError(
            f"{out} holds a run without the cameras of `gs2d reconstruct` in {CAPTURE}/; go on with gs2d train, choose "
            "another --out, or begin anew with --overwrite"
        )
    check_installed()
    check_poses_options(poses_options(options))
    _check_photos(options)
    if (out / CAPTURE).exists() and not options.overwrite:
        raise RunError(
            f"{out} holds the cameras of photographs, and no run: go on with --resume, or begin anew with --overwrite"
        )


def _check_photos(options: ReconstructOptions) -> None:
    """Refuse a folder that is no folder of photographs without cameras, or that the run would lie in."""
    photos, out = options.photos, options.out
    look_into(photos) if is_video(photos) else find_photos(photos)
    folder, run = photos.resolve(), out.resolve()
    if run == folder or folder in run.parents or run in folder.parents:
        raise RunError(f"--out {out} must lie beside the photographs, not in their folder or above it ({photos})")
    try:
        kind = detect_format(photos)
    except DataError:
        return
    raise DataError(
        f"{photos} must hold photographs alone, got cameras too ({kind}): gs2d train {shlex.quote(str(photos))} --out "
        f"{shlex.quote(str(out))} trains with these; to find others{instead(photos, 'photographs').removeprefix(';')}"
    )


@contextmanager
def _claimed(out: Path) -> Iterator[None]:
    """Hold the run folder while something else than training works in it; what was made for nothing goes again."""
    made, run = make_folder(out), RunFolder(out)
    try:
        with run.locked():
            try:
                yield
            except BaseException:
                if not is_run(out):
                    run.file(LOCK).unlink(missing_ok=True)
                raise
    except BaseException:
        remove_made(made)
        raise


def _same_poses(capture: Path, options: ReconstructOptions) -> dict[str, Any]:
    """Return what ``poses.json`` holds, if these photographs and options made it.

    Raises
    ------
    RunError
        Names the first difference.
    """
    poses, wanted = read_json(capture / POSES_JSON), poses_options(options)
    again = "resume with the same, or begin anew with --overwrite"
    try:
        if poses["photos"] != str(options.photos.resolve()):
            raise RunError(f"{capture} was made of {poses['photos']}, not of {options.photos}; {again}")
        for name, value in asked_for(wanted).items():
            before = poses["asked"].get(name, getattr(PosesOptions, name))  # an option that there was not, then
            if before != value:
                option = f"--{name.replace('_', '-')}"
                raise RunError(f"{capture} was made with {option} {before}, now {value}; {again}")
        if options.photos.is_dir():  # their folder is not needed any more
            before = {row["source"] for row in poses["photographs"]}
            now = {path.relative_to(options.photos).as_posix() for path in find_photos(options.photos)[0]}
            for name in sorted(before ^ now)[:1]:
                what = "is new in" if name in now else "is gone from"
                raise RunError(
                    f"{name} {what} {options.photos} since the cameras were found; begin anew with --overwrite"
                )
        _lines(poses, capture)
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise RunError(
            f"{capture / POSES_JSON} must be as `gs2d reconstruct` writes it, got another entry ({error}); begin anew "
            "with --overwrite"
        ) from error
    return dict(poses)


def _tell(poses: dict[str, Any], capture: Path, on_event: OnEvent) -> None:
    """How the search for the cameras ended."""
    for line in _lines(poses, capture):
        on_event(Notice(line))


def _lines(poses: dict[str, Any], capture: Path) -> list[str]:
    """Say how the search for the cameras ended."""
    lost = [row for row in poses["photographs"] if not row["placed"]]
    more = len(lost) - SHOWN_LOST
    return [
        f"{placed_line(poses)}; {capture / POSES_PNG} shows them",
        *(f"no camera: {row['source']}: {row['reason']}" for row in lost[:SHOWN_LOST]),
        *([f"... and {more} more without a camera, in {capture / POSES_JSON}"] if more > 0 else []),
    ]
