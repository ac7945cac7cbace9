"""Pictures of a run: a few views after every stage, or any views as PNG files."""

from __future__ import annotations

import contextlib
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.core.atomic_files import check_writable
from gs2d.core.camera import Camera
from gs2d.core.extras import FFMPEG
from gs2d.core.json_files import write_json
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.core.text import name_bytes
from gs2d.data import Scene, View
from gs2d.data.image_files import write_image
from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import (
    LOCK,
    RENDERS,
    RunFolder,
    make_folder,
    remove_made,
)
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.camera_paths import flight_cameras, orbit_cameras
from gs2d.pipeline.finish.scoring import evenly
from gs2d.pipeline.finish.trusted_depth import believed_reach, within_reach
from gs2d.pipeline.prepare.loaded import LoadedRun, open_finished
from gs2d.pipeline.prepare.options import RenderOptions
from gs2d.pipeline.prepare.run_appearance import exposed, exposure_named, photographed
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.report.color_maps import (
    depth_image,
    depth_limits,
    error_image,
    highlight_image,
    normal_image,
    valid_image,
)
from gs2d.report.gallery import read_index
from gs2d.training.events import Notice, OnEvent, Phase, Step, counted, ignore

INDEX = "index.json"
LONGEST_NAME = 180  # bytes; file systems take 255, and a picture's kind and a temporary suffix come after it
IMAGES = ("color", "normal", "depth", "error", "high_error")

SHOWN_VIEWS = 3  # views that are rendered after each stage for the report


def choose_views(scene: Scene, count: int = SHOWN_VIEWS) -> list[tuple[str, View]]:
    """(split, view) of the views to show: test views where there are any, spread evenly."""
    split, views = ("test", scene.test) if scene.test else ("train", scene.train)
    return [(split, view) for view in evenly(views, count)]


def file_name(view: View) -> str:
    """Return a view's name as the start of a file name; a long one is cut, and a hash of the whole is added."""
    name = Path(view.name.replace("/", "__")).stem
    whole = name_bytes(name)
    if len(whole) <= LONGEST_NAME:
        return name
    return whole[:LONGEST_NAME].decode(errors="ignore") + "-" + _short_hash(name)


def file_names(views: Sequence[View]) -> list[str]:
    """``file_name`` of each view; those that would share a file (x.png and x.jpg, a/b and a__b) differ by a hash."""
    names = [file_name(view) for view in views]
    count = Counter(name.casefold() for name in names)  # not every file system knows upper from lower case
    return [
        name if count[name.casefold()] == 1 else f"{name}-{_short_hash(view.name)}"
        for name, view in zip(names, views, strict=True)
    ]


def _short_hash(text: str) -> str:
    return hashlib.sha256(name_bytes(text)).hexdigest()[:8]


def draw_stage(
    run: RunFolder,
    loaded: LoadedRun,
    shown: Sequence[tuple[str, View]],
    stage: str,
    splats: Splats,
    group: Tensor | None,
    outputs: Mapping[str, RenderOutput] = MappingProxyType({}),
) -> None:
    """Write the pictures of one stage, the photographs, and the index of both.

    Views are drawn as their photographs show the scene, as far as that is known.

    Parameters
    ----------
    group : Tensor [N] bool or None
        The high-error splats, once they are known.
    outputs : mapping
        By the name of the view: what was rendered of these splats already.
    """
    folder = run.file(RENDERS)
    for name in ("photos", stage):
        make_folder(folder / name)
    index_file = folder / INDEX
    index = read_index(folder) or {"views": [], "stages": []}
    limits = {entry["name"]: entry.get("depth_limits") for entry in index["views"]}
    views = []
    files = file_names([view for _, view in shown])
    for (split, view), file in zip(shown, files, strict=True):
        output = outputs.get(view.name) or render_view(splats, view, loaded.settings, loaded.backend)
        depth = output.depth(loaded.protocol.depth).cpu().numpy()
        alpha = output.alpha.cpu().numpy()
        # Limits are of the first stage, so that stages compare.
        near_far = limits.get(view.name) or shown_limits(loaded.scene, view, depth, alpha)
        photo = view.target(loaded.settings.background)
        color = photographed(view, output.color, loaded.settings.background).cpu().numpy()
        images = {
            "color": np.clip(color, 0, 1),
            "normal": normal_image(output.normal.cpu().numpy(), alpha),
            "depth": depth_image(depth, alpha, (near_far[0], near_far[1])),
            "error": error_image(color, photo, view.mask()),
        }
        if group is not None:
            fraction = fraction_of_group(splats, group, view, loaded.settings, loaded.backend)
            images["high_error"] = highlight_image(color, fraction)
        for what, image in images.items():
            write_image(folder / stage / f"{file}.{what}.png", image)
        write_image(folder / "photos" / f"{file}.png", valid_image(photo, view.valid()))
        shown_as = {"name": view.name, "file": file, "split": split, "depth_limits": near_far}
        views.append({**shown_as, "camera": camera_json(view.camera)})
    stages = [*(name for name in index["stages"] if name != stage), stage]
    write_json(index_file, {"views": views, "stages": stages, "images": list(IMAGES)})


def shown_limits(scene: Scene, view: View, depth: np.ndarray, alpha: np.ndarray) -> list[float]:
    """Return the nearest and farthest depth worth a colour, world units: of what is within reach, where anything is."""
    reach = believed_reach(scene)
    near = alpha if reach is None else alpha * within_reach(reach, view.camera, depth)
    return list(depth_limits(depth, near if (near >= 0.5).any() else alpha))


def camera_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as plain numbers; ``Camera(**it)`` is the camera again."""
    facts = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**facts, "T_cam_world": camera.T_cam_world.tolist()}


def shown_cameras(run: RunFolder) -> list[Camera]:
    """Cameras of the views that were drawn; none before the first stage was.

    Raises
    ------
    DataError
        The index of the pictures is broken.
    """
    index = read_index(run.file(RENDERS)) or {"views": []}
    try:
        return [Camera(**entry["camera"]) for entry in index["views"]]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{run.file(RENDERS) / INDEX} must hold the camera of each view, got another entry ({error}); delete it "
            "(the report then has no pictures of views), or train again with --overwrite"
        ) from error


def render_view(splats: Splats, view: View, settings: RasterSettings, backend: Backend) -> RenderOutput:
    """All images of one view, without gradients."""
    with torch.no_grad():
        return rasterize(splats, view.camera, settings, backend=backend)


def fraction_of_group(
    splats: Splats, group: Tensor, view: View, settings: RasterSettings, backend: Backend
) -> np.ndarray:
    """How much of each pixel the splats of a row group make up: their blending weights, summed; [H, W] in [0, 1]."""
    return splatted(splats, group, view, settings, backend)


def splatted(splats: Splats, values: Tensor, view: View, settings: RasterSettings, backend: Backend) -> np.ndarray:
    """Return the sum over splats of blending weight times ``values`` [N] (>= 0) in each pixel, [H, W].

    Drawn as a scene in which each splat is as grey as its value says, over black.
    """
    grey = values.to(splats.dtype)[:, None].expand(-1, 3)
    marked = Splats(**{**dict(splats.items()), "sh0": rgb_to_sh0(grey), "shN": torch.zeros_like(splats.shN)})
    settings = replace(settings, background=(0.0, 0.0, 0.0))
    return np.asarray(render_view(marked, view, settings, backend).color[..., 0].cpu().numpy())


MAX_FRAMES = 100_000  # of an orbit or a flight
MAX_WIDTH = 1 << 14  # px


def render_run(
    path: Path,
    options: RenderOptions = RenderOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None = None,
    splats_file: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Render the views of a split, ``orbit`` frames of a circle or ``flight`` frames past the photographs, as PNGs.

    ``splats_file`` is drawn instead of the splats of the run, into ``out``.
    """
    from gs2d.io.video import write_video

    path, out, video = Path(path), None if out is None else Path(out), options.video
    split, orbit, flight, width, fps = options.split, options.orbit, options.flight, options.width, options.fps
    if width is not None and not (isinstance(width, int) and 1 <= width <= MAX_WIDTH):
        raise RunError(f"--width must be a number of pixels from 1 to {MAX_WIDTH}, got {width}")
    asked, (moving, video) = video, check_frames(orbit, flight, video, fps)
    if video is not None and video != asked and video.suffix == ".webp":
        on_event(Notice(f"the video is an animated WebP, {video}: MP4 needs ffmpeg with libx264 ({FFMPEG})"))
    run, loaded, splats = open_finished(path, threads, on_event, splats_file=splats_file, out=out)
    named = options.exposure_of
    transform = None if named is None else exposure_named(named, loaded.scene.train)
    views: list[tuple[str, View]]
    if moving:
        image = np.zeros((1, 1, 3), np.uint8)
        seen = [view.camera for view in loaded.scene.train]
        subject = read_subject(path)
        focus = None if subject is None or subject.kind != OBJECT else subject.center
        cameras = orbit_cameras(seen, orbit, focus) if orbit else flight_cameras(seen, flight)
        views = [(f"{i:04d}", View.from_arrays(f"{i:04d}", camera, image)) for i, camera in enumerate(cameras)]
    else:
        if split is None and not loaded.scene.test:
            split = "train"
            on_event(Notice("rendering the training views, because the run has no test views"))
        split = split or "test"
        chosen = loaded.scene.test if split == "test" else loaded.scene.train
        views = list(zip(file_names(chosen), chosen, strict=True))
    if not views:
        raise DataError(f"the capture of {path} has no {split} views; use --split train or --orbit 120")
    if width is not None:
        views = [(name, replace(view, camera=_at_width(view.camera, width))) for name, view in views]
    if out is not None:
        _spare_images([out / f"{name}.png" for name, _ in views], "--out", loaded)
    if video is not None:
        _spare_images([video], "--video", loaded)
    folder = out or run.file(RENDERS) / (moving or split or "test")
    made = make_folder(folder)
    with _alone_in(folder) if out is None else contextlib.nullcontext():
        if moving and out is None:  # the run's own folder: no frame of a longer film stays among these
            for old in folder.glob("[0-9]*.png"):
                if old.stem.isdecimal():
                    old.unlink()
        written: list[Path] = []
        try:
            for name, view in counted(views, "rendering", len(views), on_event):
                output = render_view(splats, view, loaded.settings, loaded.backend)
                color = output.color
                if transform is not None:
                    color = exposed(output, transform, loaded.scene.train[0], loaded.settings.background)
                is_new = not (folder / f"{name}.png").exists()
                write_image(folder / f"{name}.png", color.clamp(0, 1).cpu().numpy())
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


def _at_width(camera: Camera, width: int) -> Camera:
    """Return the camera with an image of another width and the same aspect ratio."""
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))


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
    """
    from gs2d.io.video import check_video

    for name, frames in (("--orbit", orbit), ("--flight", flight)):
        if not (isinstance(frames, int) and 0 <= frames <= MAX_FRAMES):
            raise RunError(f"{name} must be a number of frames from 1 to {MAX_FRAMES}, got {frames}")
    if orbit and flight:
        raise RunError(f"--orbit {orbit} and --flight {flight} exclude each other; give one")
    if video is None and fps != RenderOptions.fps:
        raise RunError(f"--fps {fps:g} is of a video, and no --video was given; give both")
    if video is not None:
        if not (orbit or flight):
            raise RunError("--video needs frames that move, got none; give --orbit N or --flight N, N >= 2")
        video = check_video(video, fps, orbit or flight)
        check_writable(video)
    return "orbit" if orbit else "flight" if flight else "", video


def _spare_images(files: Sequence[Path], option: str, loaded: LoadedRun) -> None:
    """Raise rather than write a rendering over a photograph of the capture."""
    images = {view.path.resolve() for view in loaded.scene.views if view.path is not None}
    for file in files:
        if file.resolve() in images:
            raise RunError(f"{option} would write over the capture's photograph {file}; choose another name")
