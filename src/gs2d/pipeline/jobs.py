"""What can be done with a trained run: mesh, render, score, export, report again."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.extras import FFMPEG
from gs2d.core.files import check_writable
from gs2d.core.images import write_image
from gs2d.data import View
from gs2d.data.subject import OBJECT, read_subject
from gs2d.errors import DataError, RunError
from gs2d.evaluation.lpips import load_lpips
from gs2d.io.formats.registry import ENDINGS, LAYOUTS, layout_of, read_disks, write_layout
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import (
    LOCK,
    MESH,
    RENDERS,
    REPORT,
    SPLATS,
    SURFACE,
    TEXTURED,
    VERDICT,
    RunFolder,
    make_folder,
    open_run,
    remove_made,
)
from gs2d.pipeline.attempts import again, attempted, reason_of
from gs2d.pipeline.evaluate import score_views, split_metrics
from gs2d.pipeline.events import MissingFile, Notice, OnEvent, Phase, Step, counted, ignore
from gs2d.pipeline.exposure import exposed, exposure_named, read_exposures
from gs2d.pipeline.finished import finished_splats, open_job
from gs2d.pipeline.job import Job
from gs2d.pipeline.mesh import extract_mesh
from gs2d.pipeline.options import Box, EvaluateOptions, MeshOptions
from gs2d.pipeline.paths import flight_cameras, orbit_cameras
from gs2d.pipeline.predicted_exposure import with_predicted
from gs2d.pipeline.refined_poses import aligned
from gs2d.pipeline.render import file_names, render_view, shown_cameras
from gs2d.pipeline.subject import meshed_subject, within
from gs2d.pipeline.verdict.file import write_verdict
from gs2d.pipeline.verdict.measures import Collector

MAX_FRAMES = 100_000  # of an orbit or a flight
FPS = 30.0


def checked_output(path: Path, out: Path, ending: str = ".ply", what: str = "") -> Path:
    """``out``, if it may be written: a PLY by its name, and not the splats of the run, from which all else is made.

    Parameters
    ----------
    ending : str
        That of its name.
    what : str
        What needs that ending, for the error.

    Raises
    ------
    RunError
    """
    path, out = Path(path), Path(out)
    if out.suffix.lower() != ending:
        raise RunError(f"--out must name a {ending} file, which is what {what or 'is written'}, got {out}")
    if out.resolve() == (path / SPLATS).resolve():
        raise RunError(f"--out {out} is the splats of the run, which stay as they are; choose another name")
    return out


def mesh_run(
    path: Path,
    options: MeshOptions = MeshOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Extract the mesh of a finished run; returns its file, counts and limits.

    Raises
    ------
    RunError, DataError, ProtocolError, DiskError
    """
    path, out = Path(path), None if out is None else checked_output(path, out)
    run, job, splats = open_job(path, threads, on_event)
    if out is not None and out.resolve() != run.file(MESH).resolve():
        subject = meshed_subject(run, job, splats, options, on_event)
        return extract_mesh(job, splats, options, out, on_event, subject=subject)
    with run.locked():
        subject = meshed_subject(run, job, splats, options, on_event)
        result = extract_mesh(job, splats, options, run.file(MESH), on_event, subject=subject)
        metrics = run.metrics()
        if metrics.get("surface"):  # was of the mesh before
            run.write_metrics({**metrics, "surface": None})
            shutil.rmtree(run.file(SURFACE), ignore_errors=True)
        if run.file(TEXTURED).exists():
            run.file(TEXTURED).unlink()
            on_event(Notice(f"{TEXTURED} was of the mesh before: removed"))
    report_again(run, on_event)
    return result


def render_run(
    path: Path,
    on_event: OnEvent = ignore,
    *,
    split: str = "test",
    orbit: int = 0,
    flight: int = 0,
    out: Path | None = None,
    video: Path | None = None,
    fps: float = FPS,
    exposure_of: str | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Render the views of a split, ``orbit`` frames of a circle or ``flight`` frames past the photographs, as PNGs.

    Frames of a circle or a flight can be made a video too: ``video`` names it, ``fps`` frames a second. All are in the
    mean exposure of the photographs, or in that of the training photograph ``exposure_of``.

    Raises
    ------
    RunError, DataError, BackendError, DiskError
    """
    from gs2d.io.video import write_video

    path, out, video = Path(path), None if out is None else Path(out), None if video is None else Path(video)
    asked, (moving, video) = video, check_frames(orbit, flight, video, fps)
    if video is not None and video != asked and video.suffix == ".webp":
        on_event(Notice(f"the video is an animated WebP, {video}: MP4 needs ffmpeg with libx264 ({FFMPEG})"))
    run, job, splats = open_job(path, threads, on_event)
    transform = None if exposure_of is None else exposure_named(exposure_of, read_exposures(run, job.recipe))
    views: list[tuple[str, View]]
    if moving:
        image = np.zeros((1, 1, 3), np.uint8)
        seen = [view.camera for view in job.scene.train]
        subject = read_subject(path)
        focus = None if subject is None or subject.kind != OBJECT else subject.center
        cameras = orbit_cameras(seen, orbit, focus) if orbit else flight_cameras(seen, flight)
        views = [(f"{i:04d}", View.from_arrays(f"{i:04d}", camera, image)) for i, camera in enumerate(cameras)]
    else:
        chosen = job.scene.test if split == "test" else job.scene.train
        views = list(zip(file_names(chosen), chosen, strict=True))
    if not views:
        raise DataError(f"the capture of {path} has no {split} views; use --split train or --orbit N")
    if out is not None:
        _spare_images([out / f"{name}.png" for name, _ in views], "--out", job)
    if video is not None:
        _spare_images([video], "--video", job)
    folder = out or run.file(RENDERS) / (moving or split)
    made = make_folder(folder)
    with _alone_in(folder) if out is None else contextlib.nullcontext():
        if moving and out is None:  # the run's own folder: no frame of a longer film stays among these
            for old in folder.glob("[0-9]*.png"):
                if old.stem.isdecimal():
                    old.unlink()
        written: list[Path] = []
        try:
            for name, view in counted(views, "rendering", len(views), on_event):
                color = exposed(render_view(splats, view, job.settings, job.backend), transform, job).clamp(0, 1)
                is_new = not (folder / f"{name}.png").exists()
                write_image(folder / f"{name}.png", color.cpu().numpy())
                written += [folder / f"{name}.png"] if is_new else []
        except BaseException:  # a full disk, Ctrl-C: half of the pictures would look like all of them
            for picture in written:
                picture.unlink(missing_ok=True)
            if made and out is None:
                (folder / LOCK).unlink(missing_ok=True)
            remove_made(made)
            raise
        result: dict[str, Any] = {"folder": str(folder), "images": len(views)}
        if video is None:
            return result
        on_event(Phase("compressing the video", len(views)))
        frames = [folder / f"{name}.png" for name, _ in views]
        with attempted(str(video), again("render", path, f"--{moving}", len(views), "--video", video), on_event):
            threads = torch.get_num_threads()
            write_video(video, frames, fps=fps, threads=threads, on_frame=lambda done: on_event(Step(done)))
            result |= {"video": str(video), "seconds": len(views) / fps, "video_bytes": video.stat().st_size}
        return result


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold a folder of the run, whose older frames go, against another command that renders into it."""
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(RunFolder(folder).locked())
        except RunError as error:
            raise RunError(f"{folder} is written by another process; wait for it or choose another --out") from error
        yield


def check_frames(orbit: int, flight: int, video: Path | None, fps: float) -> tuple[str, Path | None]:
    """Return what moves ("orbit", "flight" or nothing) and the video's whole name.

    Raises for what makes no video, before anything is loaded.

    Raises
    ------
    RunError, DataError, BackendError
    """
    from gs2d.io.video import check_video

    for name, frames in (("--orbit", orbit), ("--flight", flight)):
        if not (isinstance(frames, int) and 0 <= frames <= MAX_FRAMES):
            raise RunError(f"{name} must be a number of frames from 1 to {MAX_FRAMES}, got {frames}")
    if orbit and flight:
        raise RunError(f"--orbit {orbit} and --flight {flight} exclude each other; give one")
    if video is None and fps != FPS:
        raise RunError(f"--fps {fps:g} is of a video, and no --video was given; give both")
    if video is not None:
        if not (orbit or flight):
            raise RunError("--video needs frames that move, got neither --orbit N nor --flight N; give one")
        video = check_video(video, fps, orbit or flight)
        check_writable(video)
    return "orbit" if orbit else "flight" if flight else "", video


def _spare_images(files: Sequence[Path], option: str, job: Job) -> None:
    """Raise rather than write a rendering over a photograph of the capture."""
    images = {view.path.resolve() for view in job.scene.views if view.path is not None}
    for file in files:
        if file.resolve() in images:
            raise RunError(f"{option} would write over the capture's photograph {file}; choose another name")


def evaluate_run(
    path: Path,
    options: EvaluateOptions = EvaluateOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    threads: int | None = None,
) -> dict[str, Any]:
    """Score the final splats of a run, and its mesh against a ground truth; updates ``metrics.json`` and the report.

    Raises
    ------
    RunError, DataError
    """
    from gs2d.pipeline.truth import OfficialTruth, Truth, check_thresholds, choose_truth, read_truth, score_surface

    check_thresholds(options.thresholds)
    path, given = Path(path), options.ground_truth
    truth: Truth | OfficialTruth | None = None if given is None or given.is_dir() else read_truth(given)
    lpips = None if options.lpips_weights is None else load_lpips(options.lpips_weights)
    run, job, splats = open_job(path, threads, on_event)
    lpips = None if lpips is None else lpips.to(job.backend.device)
    result: dict[str, Any] = {"run": str(run.path), "surface": run.metrics().get("surface")}
    if truth is None and job.scene.root is not None:
        truth = choose_truth(given, job.scene.root, on_event)
    has_mesh = run.file(MESH).exists()
    if truth is not None and not has_mesh and given is not None:
        raise RunError(f"{path} has no {MESH}; make it with `gs2d mesh {path}`")
    drawing = (job.settings, job.backend)
    exposures = with_predicted(read_exposures(run, job.recipe), job.scene)
    if options.match_exposure:
        name = "scoring test views, colours matched"
        scores = score_views(splats, job.scene.test, *drawing, name=name, on_event=on_event, lpips=lpips, match=True)
        result |= split_metrics(scores, "test_matched", "test")
    if options.match_poses:
        name = "scoring test views, cameras aligned"
        best = tuple(aligned(splats, job.scene.test, *drawing, job.scene.extent, on_event))
        scores = score_views(splats, best, *drawing, name=name, on_event=on_event, lpips=lpips)
        result |= split_metrics(scores, "test_aligned", "test")
    collected = Collector(job.scene, job.settings.background)
    for split, views in (("train", job.scene.train), ("test", job.scene.test)):
        name = f"scoring {split} views"
        more: dict[str, Any] = {"exposures": exposures, "split": split, "visitors": [collected.visit]}
        scores = score_views(splats, views, *drawing, name=name, on_event=on_event, lpips=lpips, **more)
        result |= split_metrics(scores, split)
        result[f"{split}_views"] = {view: metrics.to_json() for view, metrics in scores.items()}
    if truth is not None and has_mesh:
        mesh = read_mesh(run.file(MESH))
        result["surface"] = score_surface(mesh, truth, job, options, on_event, folder=run.file(SURFACE))
    elif truth is not None:
        on_event(Notice(f"the surface is not scored: no {MESH}; make it with `gs2d mesh {path}`"))
    with run.locked():
        metrics = run.metrics()
        last = {k: v for k, v in result.items() if k.startswith(("train", "test")) and not k.endswith("_views")}
        stages = [*metrics["stages"][:-1], {**metrics["stages"][-1], **last}] if metrics["stages"] else []
        run.write_metrics({**metrics, "stages": stages, "surface": result["surface"]})
        with attempted(VERDICT, again("evaluate", path), on_event):
            result["verdict"] = write_verdict(run, job, collected)["verdict"]
    report_again(run, on_event)
    return result


def export_run(path: Path, out: Path, layout: str | None = None, *, bbox: Box | None = None) -> dict[str, Any]:
    """Write the splats of a run, or of a file of flat splats, in another layout.

    Parameters
    ----------
    layout : str or None
        A name of ``io.formats.registry.LAYOUTS``; None: by the ending of ``out``.
    bbox : six floats, optional
        Only the splats with their centres in this box, x0 y0 z0 x1 y1 z1, world units.

    Raises
    ------
    RunError, DataError, DiskError
    """
    layout = layout or layout_of(Path(out))
    if layout is None:
        raise RunError(f"--out must end in {', '.join(ENDINGS)}, which say what is written, got {out}")
    if layout not in LAYOUTS:
        raise RunError(f"--layout must be one of {', '.join(LAYOUTS)}, got {layout}")
    path, out = Path(path), checked_output(path, out, LAYOUTS[layout].ending, f"layout {layout} is")
    if out.resolve() == (path / MESH).resolve():
        raise RunError(f"--out {out} is the mesh of the run, which stays as it is; choose another name")
    if path.is_file() and out.resolve() == path.resolve():
        raise RunError(f"--out {out} is the file that is read; choose another name")
    splats = read_disks(path) if path.is_file() else finished_splats(open_run(path))
    splats = splats if bbox is None else within(splats, bbox)
    notes = write_layout(out, splats, layout)
    size = out.stat().st_size
    return {"file": str(out), "splats": len(splats), "bytes": size, "layout": layout, "notes": list(notes)}


def report_run(path: Path, on_event: OnEvent = ignore) -> Path:
    """Write the report of a run; a section that fails is said in it, and told as ``Missing``.

    Raises
    ------
    RunError, DataError, DiskError
    """
    from gs2d.report.write import write_report

    run = open_run(Path(path))
    command = again("report", run.path)

    def failed(section: str, error: Exception) -> None:
        on_event(MissingFile(f"{section} in {REPORT}", reason_of(error), command, error))

    cameras: list[Camera] = []
    with attempted(f"cameras of the pictures in {REPORT}", command, on_event):
        cameras = shown_cameras(run)
    write_report(run.path, cameras=cameras, on_failure=failed)
    return run.file(REPORT)


def report_again(run: RunFolder, on_event: OnEvent) -> None:
    """Write the report of a run that has changed."""
    with attempted(REPORT, again("report", run.path), on_event):
        report_run(run.path, on_event)


__all__ = ["evaluate_run", "export_run", "mesh_run", "render_run", "report_run"]
