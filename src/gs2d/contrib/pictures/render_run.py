"""Any views of a run, or an orbit around its subject, as PNG files and videos: ``gs2d render``."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.cli.console import Console
from gs2d.contrib.pictures.orbits import orbit_cameras
from gs2d.contrib.pictures.pictures_command import RenderCommand, RenderOptions
from gs2d.contrib.pictures.video import check_video, write_video
from gs2d.core.atomic_files import check_writable
from gs2d.core.camera import Camera
from gs2d.data import Scene, View
from gs2d.data.image_files import write_image
from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import RENDERS, make_folder, remove_created
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.run_images import file_names
from gs2d.pipeline.prepare.limits import use_memory
from gs2d.pipeline.prepare.loaded import open_finished, spare_photographs
from gs2d.training.events import Notice, OnEvent, Phase, Step, counted, ignore

MAX_FRAMES = 100_000  # of an orbit
MAX_WIDTH = 1 << 14  # px
FPS = 30.0  # of a video


def show_render(command: RenderCommand, console: Console) -> None:
    """Run ``gs2d render``."""
    use_memory(command.memory)
    result = render_run(command.run, command, console.on_event, out=command.out, threads=command.threads)
    console.say(f"{result['images']} images in {result['folder']}")
    if "video" in result:
        console.say(f"{result['video']}: {result['seconds']:.1f} s, {result['video_bytes'] / 1e6:.1f} MB")
    console.result(result)


def render_run(
    path: Path,
    options: RenderOptions = RenderOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Render the views of a split or an orbit as PNG files, and optionally as a video."""
    path, out = Path(path), None if out is None else Path(out)
    check_frames(options)
    video = options.video
    run, trained = open_finished(path, threads, on_event)
    kind, views = _views(path, options, trained.scene, on_event)
    if options.width is not None:
        views = [(name, replace(view, camera=_at_width(view.camera, options.width))) for name, view in views]
    if out is not None:
        spare_photographs([out / f"{name}.png" for name, _ in views], "--out", trained.scene)
    if video is not None:
        spare_photographs([video], "--video", trained.scene)
    folder = out or run.file(RENDERS) / kind
    created = make_folder(folder)
    with run.locked() if out is None else contextlib.nullcontext():
        if options.orbit and out is None:  # remove the frames of a longer video
            for old in folder.glob("[0-9]*.png"):
                if old.stem.isdecimal():
                    old.unlink()
        written: list[Path] = []
        try:
            for name, view in counted(views, "rendering", len(views), on_event):
                color = trained.render(view.camera).color
                is_new = not (folder / f"{name}.png").exists()
                write_image(folder / f"{name}.png", color.clamp(0, 1).cpu().numpy())
                written += [folder / f"{name}.png"] if is_new else []
        except BaseException:  # a full disk, Ctrl-C: leave no partial set of images
            for image in written:
                image.unlink(missing_ok=True)
            remove_created(created)
            raise
        result: dict[str, Any] = {"folder": str(folder), "images": len(views)}
        if video is None:
            return result
        on_event(Phase("compressing the video", len(views)))
        frames = [folder / f"{name}.png" for name, _ in views]
        with attempted(str(video), again("render", path, "--orbit", len(views), "--video", video), on_event):
            threads = torch.get_num_threads()
            write_video(video, frames, fps=FPS, threads=threads, on_frame=lambda done: on_event(Step(done)))
            result |= {"video": str(video), "seconds": len(views) / FPS, "video_bytes": video.stat().st_size}
        return result


def _views(path: Path, options: RenderOptions, scene: Scene, on_event: OnEvent) -> tuple[str, list[tuple[str, View]]]:
    """Return the name of the folder, and the views with their file names."""
    split = options.split
    if options.orbit:
        subject = read_subject(path)
        focus = None if subject is None or subject.kind != OBJECT else subject.center
        orbit = orbit_cameras([view.camera for view in scene.train], options.orbit, focus)
        empty = np.zeros((1, 1, 3), np.uint8)
        return "orbit", [(f"{i:04d}", View.from_arrays(f"{i:04d}", camera, empty)) for i, camera in enumerate(orbit)]
    if split is None and not scene.test:
        split = "train"
        on_event(Notice("rendering the training views, because the run has no test views"))
    split = split or "test"
    chosen = scene.test if split == "test" else scene.train
    if not chosen:
        raise DataError(f"the capture of {path} has no {split} views; use --split train or --orbit 120")
    return split, list(zip(file_names(chosen), chosen, strict=True))


def _at_width(camera: Camera, width: int) -> Camera:
    """Return the camera with another image width and the same aspect ratio."""
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))


def check_frames(options: RenderOptions) -> None:
    """Raise for invalid options."""
    orbit, width, video = options.orbit, options.width, options.video
    if width is not None and not (isinstance(width, int) and 1 <= width <= MAX_WIDTH):
        raise RunError(f"--width must be a number of pixels from 1 to {MAX_WIDTH}, got {width}")
    if not (isinstance(orbit, int) and 0 <= orbit <= MAX_FRAMES):
        raise RunError(f"--orbit must be a number of frames from 1 to {MAX_FRAMES}, got {orbit}")
    if video is not None:
        if not orbit:
            raise RunError("--video needs --orbit N, N >= 2")
        check_video(video, FPS, orbit)
        check_writable(video)
