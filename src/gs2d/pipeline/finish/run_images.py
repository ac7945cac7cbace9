"""Images of a run: a few views after every stage for the report, or any views as PNG files and videos."""

from __future__ import annotations

import contextlib
import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.core.atomic_files import check_writable
from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.core.text import name_bytes
from gs2d.data import Scene, View
from gs2d.data.image_files import write_image
from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import RENDERS, RunFolder, make_folder, remove_created
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.trusted_depth import believed_reach, within_reach
from gs2d.pipeline.finish.viewpoints import orbit_cameras
from gs2d.pipeline.prepare.learned_views import photographed
from gs2d.pipeline.prepare.loaded import Trained, open_finished, spare_photographs
from gs2d.pipeline.prepare.options import RenderOptions
from gs2d.report.color_maps import depth_image, depth_limits, error_image, highlight_image, normal_image, valid_image
from gs2d.report.gallery import Gallery, read_gallery
from gs2d.training.events import Notice, OnEvent, Phase, Step, counted, ignore

INDEX = "index.json"
LONGEST_NAME = 180  # bytes; file systems allow 255, including the kind of image and a temporary suffix
IMAGES = ("color", "normal", "depth", "error", "high_error")
SHOWN_VIEWS = 3  # rendered after each stage for the report
MAX_FRAMES = 100_000  # of an orbit
MAX_WIDTH = 1 << 14  # px
FPS = 30.0  # of a video


# -- images of the report ----------------------------------------------------------------------------------------------
def file_names(views: Sequence[View]) -> list[str]:
    """Return a file name without suffix for each view; names that are too long or equal get a hash."""
    names = []
    for view in views:
        name = Path(view.name.replace("/", "__")).stem
        whole = name_bytes(name)
        short = whole[:LONGEST_NAME].decode(errors="ignore")
        names.append(name if len(whole) <= LONGEST_NAME else f"{short}-{_short_hash(name)}")
    count = Counter(name.casefold() for name in names)  # some file systems ignore case
    return [
        name if count[name.casefold()] == 1 else f"{name}-{_short_hash(view.name)}"
        for name, view in zip(names, views, strict=True)
    ]


def _short_hash(text: str) -> str:
    return hashlib.sha256(name_bytes(text)).hexdigest()[:8]


def draw_stage(run: RunFolder, trained: Trained, stage: str, group: Tensor | None) -> None:
    """Write the images of one stage, the photographs, and the index of both, of a few test views (or training views).

    They are drawn with the appearance of their photographs, as far as the scene knows it. ``group`` [N] bool are the
    high-error splats, once they are available.
    """
    scene, background = trained.scene, trained.settings.background
    split, every = ("test", scene.test) if scene.test else ("train", scene.train)
    count = min(SHOWN_VIEWS, len(every))
    shown = [every[(2 * i + 1) * len(every) // (2 * count)] for i in range(count)]  # evenly spaced
    folder = run.file(RENDERS)
    for name in ("photos", stage):
        make_folder(folder / name)
    drawn = read_gallery(folder) or Gallery(folder, (), ())
    limits = {view.name: view.depth_limits for view in drawn.views}
    views = []
    for view, file in zip(shown, file_names(shown), strict=True):
        output = trained.render(view.camera)
        depth = output.depth(trained.protocol.depth).cpu().numpy()
        alpha = output.alpha.cpu().numpy()
        # All stages use the limits of the first, so that they can be compared.
        near_far = limits.get(view.name)
        if near_far is None:  # from depths within reach, if there are any
            reach = believed_reach(scene)
            near = alpha if reach is None else alpha * within_reach(reach, view.camera, depth)
            near_far = depth_limits(depth, near if (near >= 0.5).any() else alpha)
        photo = view.target(background)
        color = photographed(view, output.color, background).cpu().numpy()
        images = {
            "color": np.clip(color, 0, 1),
            "normal": normal_image(output.normal.cpu().numpy(), alpha),
            "depth": depth_image(depth, alpha, near_far),
            "error": error_image(color, photo, view.mask()),
        }
        if group is not None:
            fraction = splatted(trained, group, view.camera)
            images["high_error"] = highlight_image(color, fraction)
        for what, image in images.items():
            write_image(folder / stage / f"{file}.{what}.png", image)
        write_image(folder / "photos" / f"{file}.png", valid_image(photo, view.valid()))
        shown_as = {"name": view.name, "file": file, "split": split, "depth_limits": near_far}
        views.append({**shown_as, "camera": camera_json(view.camera)})
    stages = [*(name for name in drawn.stages if name != stage), stage]
    write_json(folder / INDEX, {"views": views, "stages": stages, "images": list(IMAGES)})


def camera_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as JSON values, the keyword arguments of ``Camera``."""
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**intrinsics, "T_cam_world": camera.T_cam_world.tolist()}


def splatted(trained: Trained, values: Tensor, camera: Camera) -> np.ndarray:
    """Return the sum over splats of blending weight times ``values`` [N] (>= 0) in each pixel, [H, W].

    With a boolean row group as ``values`` this is the fraction of each pixel that the group covers.
    """
    splats = trained.splats
    grey = values.to(splats.dtype)[:, None].expand(-1, 3)
    marked = Splats(**{**dict(splats.items()), "sh0": rgb_to_sh0(grey), "shN": torch.zeros_like(splats.shN)})
    drawing = replace(trained, splats=marked, settings=replace(trained.settings, background=(0.0, 0.0, 0.0)))
    return np.asarray(drawing.render(camera).color[..., 0].cpu().numpy())


# -- gs2d render -------------------------------------------------------------------------------------------------------
def render_run(
    path: Path,
    options: RenderOptions = RenderOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Render the views of a split or an orbit as PNG files, and optionally as a video."""
    from gs2d.io.video import write_video

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
    from gs2d.io.video import check_video

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
