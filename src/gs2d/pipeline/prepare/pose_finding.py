"""``gs2d poses``: photographs become a capture, completely or not at all.

The capture is created in a workspace (``sfm.workspace``), read back by the loader that training uses, and then moved.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.image_arrays import natural_key
from gs2d.core.json_files import write_json
from gs2d.core.processes import available_cores
from gs2d.data import load_scene
from gs2d.data.masks import FOLDER
from gs2d.data.positions import Positions, matched, read_positions, to_enu
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import make_folder, now, remove_created, versions
from gs2d.pipeline.attempts import attempted
from gs2d.pipeline.prepare.limits import MAX_THREADS
from gs2d.pipeline.prepare.options import PoseEstimation, PosesOptions, check_choices, values
from gs2d.sfm.colmap_process import Request, check_installed, layers, read_match_counts, solve
from gs2d.sfm.copies import copy_images, copy_masks, masks_of
from gs2d.sfm.lens import FISHEYE, PANORAMA, START
from gs2d.sfm.model import SfmModel, camera_line, check_any, focal_length, read_model, why_not_placed, write_image_of
from gs2d.sfm.photos import FEWEST, Photo, camera_groups, chronological_order, find_photos, panorama_groups, read_photos
from gs2d.sfm.search import DATABASE, SEARCH, forget, go_on, is_of
from gs2d.sfm.video_frames import MAX_FRAMES, Video, choose, is_video, look_into, sharpness_of, take
from gs2d.sfm.workspace import (
    IMAGES,
    POSES_JSON,
    POSES_PNG,
    SPARSE,
    STAGED,
    check_out,
    put_in_place,
    sweep_workspace,
    workspace,
)
from gs2d.training.events import Notice, OnEvent, Phase, Step, counted, ignore

MANY = 500  # photographs; more: "auto" uses the global mapper (docs/notebook/sfm.md)
ALL_PAIRS = 150  # photographs; up to this number "auto" matches every pair
POSITIONED = 0.5  # fraction of photographs with positions from which "auto" matches spatially
SMALLEST_SIDE = 64
LIMITS = {
    "max_size": (SMALLEST_SIDE, 1 << 16),
    "feature_size": (SMALLEST_SIDE, 1 << 16),
    "frames": (FEWEST, MAX_FRAMES),
    "overlap": (1, 1000),
    "neighbours": (1, 10_000),
    "threads": (1, MAX_THREADS),
    "seed": (0, (1 << 31) - 1),
}
FRAMES = "frames"  # folder of the frames of a video, in the workspace
_SHOWN_MODELS = 5
SHOWN_LOST = 5  # photographs without a camera that are named
_FEW_PLACED, _LARGE_ERROR, _SMALL_ANGLE = 0.8, 1.5, 4.0  # fraction of photographs; px; degrees
Position = tuple[float, float, float]
_MIN_SPREAD = 15.0  # m, root mean square: GPS in phones is off by 5 m and more
_SHOWN = 3


def find_poses(options: PosesOptions, on_event: OnEvent = ignore) -> dict[str, Any]:
    """Make a capture; return the contents of ``poses.json``, with the path of the capture as ``capture``.

    Raises BackendError if pycolmap is not installed.
    """
    started = time.monotonic()
    check_installed()
    check_poses_options(options)
    video = look_into(options.photos) if is_video(options.photos) else None
    paths = [] if video else _paths_in(options.photos, on_event)
    out = options.out.resolve()
    sweep_workspace(out)
    check_out(options.out, options.photos, overwrite=options.overwrite)
    threads = options.threads or available_cores()
    created = make_folder(out.parent)
    try:
        with workspace(out) as work, _resumable(work, on_event):
            check_out(options.out, options.photos, overwrite=options.overwrite)  # the workspace may have restored one
            source = _source_fields(options, paths)
            root = work / FRAMES if video else options.photos
            paths = _frames_of(video, work, options.frames, source, on_event) if video else paths
            reading = read_photos(paths, root, threads=threads)
            photos = list(counted(reading, "reading photographs", len(paths), on_event))
            masks = _masks_of(options, photos, video is not None, on_event)
            source |= {"masks": [_stamp(mask) for mask in masks if mask is not None]} if any(masks) else {}
            capture = work / STAGED
            used = str(capture / FOLDER) if any(masks) and not options.match_masked else None
            request = _request(options, work, photos, used, threads, on_event)
            if line := go_on(work, {"photographs": source, **layers(request)}, ours=(STAGED,)):
                on_event(Notice(line))
            masked = copy_masks(photos, masks, capture / FOLDER, options.max_size)
            staged = _stage(photos, capture / IMAGES, options, threads, on_event, is_video=video is not None)
            solved = solve(request, _progress(on_event), lambda line: on_event(Notice(line)))
            try:
                models, result = _read_models(options, request, photos, staged, solved)
                result |= {"masks": masked} if masked else {}
                result["seconds"] = round(time.monotonic() - started, 1)
                on_event(Phase("checking the capture", 0))
                with attempted(POSES_PNG, "", on_event):
                    write_image_of(capture / POSES_PNG, models[0], placed_line(result))
                write_json(capture / POSES_JSON, result)
                load_scene(capture, format="colmap")
            except DataError:
                forget(work)  # another attempt would end the same way
                raise
            check_out(options.out, options.photos, overwrite=options.overwrite)  # hours have passed
            put_in_place(work / STAGED, out, work)
            forget(work)
    except BaseException:
        remove_created(created)
        raise
    for line in _warnings(result):
        on_event(Notice(line))
    return {"capture": str(options.out), **result}


@contextlib.contextmanager
def _resumable(work: Path, on_event: OnEvent) -> Iterator[None]:
    """Report that intermediate results are kept, if the search fails."""
    try:
        yield
    except BaseException:
        if (work / SEARCH).exists():
            on_event(
                Notice(f"intermediate results are kept in {work}: the same command continues; delete it to restart")
            )
        raise


# -- input -------------------------------------------------------------------------------------------------------------
def check_poses_options(options: PosesOptions) -> None:
    """Raise for an invalid option."""
    check_choices(options)
    for name, (least, most) in LIMITS.items():
        value = getattr(options, name)
        if value is not None and not (isinstance(value, int) and least <= value <= most):
            raise RunError(f"--{name.replace('_', '-')} must be a whole number from {least} to {most}, got {value}")


def requested_options(options: PosesOptions) -> dict[str, Any]:
    """Return the options that determine the capture, as ``poses.json`` keeps them."""
    requested = {**values(PoseEstimation, options), "seed": options.seed}
    return {name: str(value.resolve()) if isinstance(value, Path) else value for name, value in requested.items()}


def _source_fields(options: PosesOptions, paths: Sequence[Path]) -> dict[str, Any]:
    """Return what determines the copies of the photographs: files, programs and options."""
    return {
        "versions": {**versions(), "pycolmap": importlib.metadata.version("pycolmap")},
        "photos": str(options.photos.resolve()),
        "files": [_stamp(path) for path in paths or [options.photos]],
        "max_size": options.max_size,
        "frames": None if paths else options.frames,
    }


def _stamp(path: Path) -> tuple[str, int, int]:
    """Return name, size and time of a file; zeros if it is missing, which is reported when it is read."""
    try:
        stat = path.stat()
    except OSError:
        return str(path), 0, 0
    return str(path), stat.st_size, stat.st_mtime_ns


def _masks_of(options: PosesOptions, photos: Sequence[Photo], is_video: bool, on_event: OnEvent) -> list[Path | None]:
    """Return the mask of each photograph, and report how many there are."""
    if is_video:
        if options.masks is not None:
            raise DataError("--masks does not work with a video; extract frames with ffmpeg, and use their folder")
        return [None] * len(photos)
    masks, line = masks_of(photos, options.photos, options.masks)
    if line:
        on_event(Notice(line))
    return masks


def _paths_in(photos: Path, on_event: OnEvent) -> list[Path]:
    """Return the photographs in a folder, and report ignored files."""
    paths, notes, warning = find_photos(photos)
    if warning:
        on_event(Notice(warning, is_warning=True))
    for note in notes:
        on_event(Notice(note))
    return paths


def _frames_of(video: Video, work: Path, count: int, source: dict[str, Any], on_event: OnEvent) -> list[Path]:
    """Extract the sharpest frames of a video, or return those of an interrupted search.

    Raises DataError if the video does not decode, or has too few frames.
    """
    folder = work / FRAMES
    if is_of(work, "photographs", source) and folder.is_dir():
        return sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
    shutil.rmtree(folder, ignore_errors=True)
    if video.hdr is not None:
        on_event(Notice(f"{video.path} is an HDR video ({video.hdr}): its colours will look flat"))
    looking = sharpness_of(video)
    with contextlib.closing(looking):
        sharpness = list(counted(looking, "looking for sharp frames", video.frames, on_event))
    if len(sharpness) < FEWEST:
        raise DataError(f"{video.path} must have at least {FEWEST} frames, got {len(sharpness)}; is the file complete?")
    on_event(Phase("taking frames", 0))
    frames = take(video, choose(sharpness, count), folder)
    on_event(Notice(f"using {len(frames)} of {len(sharpness):,} frames, the sharpest of each interval (--frames)"))
    return frames


def _stage(
    photos: Sequence[Photo], folder: Path, options: PosesOptions, threads: int, on_event: OnEvent, *, is_video: bool
) -> list[str]:
    """Copy the photographs into the capture, or link the frames of a video; return how each was copied."""
    copying = copy_images(photos, folder, max_size=options.max_size, link=is_video, threads=threads)
    with contextlib.closing(copying):  # stops writing after Ctrl-C
        staged = list(counted(copying, "copying photographs", len(photos), on_event))
    if turned := sum(photo.orientation != 1 for photo in photos):
        on_event(Notice(f"{turned} photographs were turned upright, following their EXIF orientation", detail=True))
    return staged


# -- the request to COLMAP ---------------------------------------------------------------------------------------------
def _request(
    options: PosesOptions, work: Path, photos: Sequence[Photo], masks: str | None, threads: int, on_event: OnEvent
) -> Request:
    """Return the request to COLMAP."""
    positions, note = metric_positions(photos, options.positions)
    if note:
        on_event(Notice(note))
    sizes = [photo.size_within(options.max_size) for photo in photos]
    groups = camera_groups(photos, sizes, options.cameras)
    panoramas, lines = panorama_groups(photos, groups, options.camera_model)
    for line in lines:
        on_event(Notice(line))
    # Fisheyes are set later: COLMAP verifies no pair of fisheyes with unknown focal length.
    lens = START if options.camera_model in ("auto", FISHEYE) else options.camera_model
    order, ordered_by = chronological_order(photos)
    located = sum(position is not None for position in positions)
    return {  # every path is absolute
        "images": str(work / STAGED / IMAGES),
        "database": str(work / DATABASE),
        "output": str(work / STAGED / SPARSE),  # folder for the models ``0``, ``1`` ...
        "groups": [  # photographs of one camera
            {
                "names": [photos[i].name for i in group],
                "camera_model": PANORAMA if is_panorama else lens,
                "size": sizes[group[0]],  # width and height, px
                "original": str(photos[group[0]].source.resolve()),  # with EXIF
            }
            for group, is_panorama in zip(groups, panoramas, strict=True)
        ],
        "in_order": [photos[i].name for i in order],  # chronological
        "ordered_by": ordered_by,  # "time" or "name"
        "places": [positions[i] for i in order],  # metres; None: unknown
        "matching": _matching(options.matching, len(photos), located),
        "mapper": options.mapper if options.mapper != "auto" else "global" if len(photos) >= MANY else "incremental",
        **{name: getattr(options, name) for name in ("overlap", "neighbours", "feature_size", "seed")},
        "threads": threads,
        "asked_lens": None if options.camera_model == "auto" else options.camera_model,  # None: by number (`lens`)
        "masks": masks,  # folder of masks (``NAME.png``): black pixels give no features
    }


def metric_positions(photos: Sequence[Photo], listed: Path | None) -> tuple[list[Position | None], str]:
    """Return the position of each photograph in a local frame, from a list or from EXIF, and a note.

    Unknown positions are None. Heights are 0 unless all are available. Raises DataError if the list cannot be read, or
    names none of the photographs.
    """
    labels = [photo.label for photo in photos]
    if listed is None:
        located = {photo.label: np.array(photo.metadata.place) for photo in photos if photo.metadata.place is not None}
        positions = Positions(located, None, "GPS in EXIF", in_degrees=True)
    else:
        positions = read_positions(listed)
        located = matched(positions, labels)
        if not located:
            raise DataError(
                f"{listed} names none of the {len(photos)} photographs, such as {labels[0]} (its first is "
                f"{next(iter(positions.places), 'missing')})"
            )
    if len(located) < 2:
        return [None] * len(photos), ""
    metres = np.stack(list(located.values()))
    if positions.in_degrees:
        metres = to_enu(metres, np.append(np.median(metres[:, :2], axis=0), 0.0))
    if not np.isfinite(metres[:, 2]).all():
        metres[:, 2] = 0.0
    spread = float(np.sqrt(((metres - np.median(metres, axis=0)) ** 2).sum(axis=1).mean()))
    if listed is None and spread < _MIN_SPREAD:
        note = f"GPS positions are not used: they spread over {spread:.1f} m (root mean square), the error of receivers"
        return [None] * len(photos), note
    by_label = dict(zip(located, ((float(x), float(y), float(z)) for x, y, z in metres), strict=True))
    note, lost = "", [label for label in labels if label not in by_label]
    if lost:
        names = ", ".join(lost[:_SHOWN]) + (" ..." if len(lost) > _SHOWN else "")
        note = f"{len(lost)} of {len(labels)} photographs have no position ({names}; {positions.source})"
    return [by_label.get(label) for label in labels], note


def _matching(requested: str, count: int, located: int) -> str:
    """Return how pairs are chosen for ``count`` photographs, of which ``located`` have positions."""
    if requested == "spatial" and not located:
        raise DataError(
            f"--matching spatial needs photographs with positions, got none of {count}; use --positions FILE or "
            "--matching similar"
        )
    if requested != "auto":
        return requested
    if count <= ALL_PAIRS:
        return "exhaustive"
    return "spatial" if located >= POSITIONED * count else "similar"


def _progress(on_event: OnEvent) -> Callable[[str, int, int], None]:
    """Return a listener of the solver that sends phases and steps."""
    current = ""

    def listen(name: str, done: int, total: int) -> None:
        nonlocal current
        on_event(Step(done) if name == current else Phase(name, total))
        current = name

    return listen


# -- the result --------------------------------------------------------------------------------------------------------
def _read_models(
    options: PosesOptions, request: Request, photos: Sequence[Photo], staged: Sequence[str], solved: Mapping[str, Any]
) -> tuple[list[SfmModel], dict[str, Any]]:
    """Return the models that COLMAP found, largest first, and the contents of ``poses.json``.

    Raises DataError if no photograph was placed.
    """
    models = [read_model(Path(request["output"]) / str(i), done) for i, done in enumerate(solved["models"])]
    stats = read_match_counts(Path(request["database"]))
    check_any(models, stats, options.photos)
    best = models[0]
    per_camera = Counter(image.camera_id for image in best.images)
    rows = []
    for photo, how in zip(photos, staged, strict=True):
        row = {"name": photo.name, "source": photo.label, "file": how, "features": stats.features.get(photo.name, 0)}
        placed = photo.name in best.names
        reason = {} if placed else {"reason": why_not_placed(photo.name, models, stats)}
        rows.append({**row, "placed": placed, **reason})
    return models, {
        "photos": str(options.photos.resolve()),
        "count": len(photos),
        "placed": len(best.images),
        "points": len(best.points.xyz),
        "mean_error_px": best.mean_error,
        "photos_per_point": best.mean_track,
        "median_angle_degrees": best.median_angle,
        "up": "+z" if best.upright else None,
        "cameras": [
            {
                "model": camera.model,
                "size": [camera.width, camera.height],
                "params": list(camera.params),
                "focal_px": focal_length(camera),
                "photos": count,
                "about": camera_line(camera, count),
            }
            for camera, count in ((best.cameras[number], count) for number, count in sorted(per_camera.items()))
        ],
        "lens": solved["lens"],
        "other_models": [
            {"folder": f"{SPARSE}/{i}", "photos": sorted(model.names), "points": len(model.points.xyz)}
            for i, model in enumerate(models[1:], start=1)
        ],
        "photographs": rows,
        "requested": requested_options(options),
        "options": {
            "matching": request["matching"],
            "mapper": request["mapper"],
            "pairs_matched": len(stats.matches),
            "threads": request["threads"],
        },
        "created": now(),
    }


def placed_line(result: dict[str, Any]) -> str:
    """Summarize the reconstruction in one line."""
    return (
        f"{result['placed']} of {result['count']} photographs placed; {result['points']:,} points, "
        f"{result['photos_per_point']:.1f} photographs per point, "
        f"mean reprojection error {result['mean_error_px']:.2f} px"
    )


def lost_lines(result: dict[str, Any]) -> list[str]:
    """Return why photographs have no camera, one line each; many are in ``poses.json`` only."""
    lost = [row for row in result["photographs"] if not row["placed"]]
    more = len(lost) - SHOWN_LOST
    lines = [f"no camera: {row['source']}: {row['reason']}" for row in lost[:SHOWN_LOST]]
    return [*lines, f"no camera: {more} more, in {POSES_JSON}"] if more > 0 else lines


def _warnings(result: dict[str, Any]) -> list[str]:
    """Return what the user should check before training."""
    lines = []
    if others := [len(other["photos"]) for other in result["other_models"]]:
        rest = ", ".join(map(str, others[:_SHOWN_MODELS])) + (" ..." if len(others) > _SHOWN_MODELS else "")
        lines.append(
            f"the photographs form {len(others) + 1} unconnected models of {result['placed']}, {rest} photographs: the "
            f"largest is the capture ({SPARSE}/0); take photographs between them to connect them"
        )
    if result["placed"] < _FEW_PLACED * result["count"]:
        lines.append(
            f"only {result['placed']} of {result['count']} photographs placed: look at {POSES_PNG}, and take "
            "more between the missing photographs and the others"
        )
    if result["median_angle_degrees"] < _SMALL_ANGLE:
        lines.append(
            f"the photographs were taken from nearly the same position ({result['median_angle_degrees']:.1f} degrees "
            "between the rays to a point, 10 or more are good), so depths are unreliable: move sideways between "
            "photographs"
        )
    if result["mean_error_px"] > _LARGE_ERROR:
        lines.append(
            f"the mean reprojection error is {result['mean_error_px']:.2f} px (expected below {_LARGE_ERROR}): try "
            "--cameras each, or --camera-model OPENCV_FISHEYE for a very wide lens"
        )
    if result["up"] is None:
        lines.append("the up direction is unknown: the axes are those of COLMAP")
    return lines
