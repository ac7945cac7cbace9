"""``gs2d poses``: a folder of photographs becomes a capture, in one step or not at all.

The finished capture is read back by the loader that training uses before it gets its name (``sfm.workspace``).
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gs2d.core.image_arrays import natural_key
from gs2d.core.json_files import write_json
from gs2d.data import load_scene
from gs2d.data.masks import FOLDER
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import make_folder, now, remove_made, versions
from gs2d.pipeline.attempts import attempted
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.photo_places import Places, places_of
from gs2d.pipeline.run_parts import PLACED
from gs2d.sfm.colmap_process import Group, MatchFacts, Request, Solved, check_installed, layers, read_facts, solve
from gs2d.sfm.fisheye import Circle
from gs2d.sfm.image_copies import copy_images
from gs2d.sfm.lens import START, lens_line
from gs2d.sfm.model import SfmModel, camera_line, check_any, focal_length, read_model, why_not_placed
from gs2d.sfm.panoramas import PANORAMA
from gs2d.sfm.photo_masks import copy_masks, masks_of
from gs2d.sfm.photos import (
    FEWEST,
    FISHEYE,
    Photo,
    camera_groups,
    find_photos,
    fisheye_hints,
    in_order_taken,
    panorama_groups,
    read_photos,
)
from gs2d.sfm.plot import write_image_of
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
from gs2d.training.events import Notice, OnEvent, Phase, RunPlan, Step, counted, ignore

CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", PANORAMA)
MATCHINGS = ("auto", "exhaustive", "sequential", "similar", "spatial")
MAPPERS = ("auto", "incremental", "global")
MANY = 500  # photographs, from which on "auto" places all at once (docs/notebook/sfm.md)
ALL_PAIRS = 150  # photographs, up to which "auto" matches every pair
ASKED_FOR = (  # what poses.json remembers of the options: with another of these the capture is another one
    *("cameras", "camera_model", "matching", "overlap", "neighbours", "positions"),
    *("mapper", "max_size", "feature_size", "frames", "seed"),
    *("masks", "match_masked"),
)
_MOST = 0.5  # of the photographs: so many have a place where "auto" goes by places
_GROWTH = {"placing cameras": 1.5}  # each is adjusted with those that have a place, but not with all of them every time
FRAMES = "frames"  # of a video, in the workplace, until they are in the capture
SMALLEST_SIDE, MAX_THREADS = 64, 1024
_PIECES = 5  # that are counted one by one
_DOUBTFUL_FRACTION, _DOUBTFUL_ERROR, _DOUBTFUL_ANGLE = 0.8, 1.5, 4.0  # of the photographs placed; px; degrees


def find_poses(options: PosesOptions, on_event: OnEvent = ignore) -> dict[str, Any]:
    """Make the capture; returns what ``poses.json`` holds, with ``capture``: its path.

    Raises
    ------
    BackendError
        pycolmap is not installed.
    DataError, RunError, DiskError
    """
    started = time.monotonic()
    on_event(RunPlan(PLACED))
    check_installed()
    check_poses_options(options)
    video = look_into(options.photos) if is_video(options.photos) else None
    paths = [] if video else _folder_of(options.photos, on_event)
    out = options.out.resolve()
    sweep_workspace(out)
    check_out(options.out, options.photos, overwrite=options.overwrite)
    threads = options.threads or _cores()
    made = make_folder(out.parent)
    try:
        with workspace(out) as work, _kept(work, on_event):
            check_out(options.out, options.photos, overwrite=options.overwrite)  # a killed command's capture is back
            made_of = _made_of(options, paths)
            root = work / FRAMES if video else options.photos
            paths = _frames_of(video, work, options.frames, made_of, on_event) if video else paths
            reading = read_photos(paths, root, threads=threads)
            photos = list(counted(reading, "reading photographs", len(paths), on_event))
            masks = _masks_of(options, photos, video is not None, on_event)
            made_of |= {"masks": [_stamp(mask) for mask in masks if mask is not None]} if any(masks) else {}
            request = _request(options, work, photos, threads, on_event)
            capture, circles = work / STAGED, _circles(request)
            if (any(masks) or circles) and not options.match_masked:
                request = replace(request, masks=str(capture / FOLDER))
            if line := go_on(work, {"photographs": made_of, **layers(request)}, ours=(STAGED,)):
                on_event(Notice(line))
            masked = copy_masks(photos, masks, capture / FOLDER, options.max_size, circles)
            staged = _stage(photos, capture / IMAGES, options, threads, on_event, ours=video is not None)
            solved = solve(request, _progress(on_event), lambda line: on_event(Notice(line)))
            try:
                result = _finish(options, request, photos, staged, solved, started, on_event, masked=masked)
            except DataError:
                forget(work)  # it would end so again
                raise
            check_out(options.out, options.photos, overwrite=options.overwrite)  # hours later it may hold something
            put_in_place(work / STAGED, out, work)
            forget(work)
    except BaseException:
        remove_made(made)
        raise
    lens = result["lens"]
    if lens["about"]:
        on_event(Notice(lens["about"], detail=not lens.get("fisheyes")))
    for line in filter(None, (_pieces_line(result), *_doubts(result))):
        on_event(Notice(line))
    return {"capture": str(options.out), **result}


@contextlib.contextmanager
def _kept(work: Path, on_event: OnEvent) -> Iterator[None]:
    """Say that what was found is kept, where a search ends before it is done."""
    try:
        yield
    except BaseException:
        if (work / SEARCH).exists():
            on_event(Notice(f"what was found is kept in {work}: the same command goes on; remove it to begin anew"))
        raise


def _made_of(options: PosesOptions, paths: Sequence[Path]) -> dict[str, Any]:
    """Return what the copies of the photographs are made of: files, programs, and options."""
    return {
        "versions": {**versions(), "pycolmap": importlib.metadata.version("pycolmap")},
        "photos": str(options.photos.resolve()),
        "files": [_stamp(path) for path in paths or [options.photos]],
        "max_size": options.max_size,
        "link": options.link,
        "frames": None if paths else options.frames,
    }


def _stamp(path: Path) -> tuple[str, int, int]:
    """Return a file's name, bytes and time; one that is gone is told of when it is read."""
    try:
        told = path.stat()
    except OSError:
        return str(path), 0, 0
    return str(path), told.st_size, told.st_mtime_ns


def _finish(
    options: PosesOptions,
    request: Request,
    photos: Sequence[Photo],
    staged: Sequence[str],
    solved: Solved,
    started: float,
    on_event: OnEvent,
    *,
    masked: int = 0,
) -> dict[str, Any]:
    """Write what the capture needs beside the models, and look at it as training does; what ``poses.json`` holds.

    Raises
    ------
    DataError
        No photograph found a place.
    """
    capture = Path(request.images).parent
    pieces = [read_model(capture / SPARSE / str(i), done) for i, done in enumerate(solved.models)]
    facts = read_facts(Path(request.database))
    check_any(pieces, facts, options.photos)
    result = _result(options, request, photos, staged, pieces, facts, solved)
    result |= {"masks": masked} if masked else {}
    result["seconds"] = round(time.monotonic() - started, 1)
    on_event(Phase("checking the capture", 0))
    with attempted(POSES_PNG, "", on_event):
        write_image_of(capture / POSES_PNG, pieces[0], _title(result))
    write_json(capture / POSES_JSON, result)
    load_scene(capture, format="colmap")
    return result


def _masks_of(options: PosesOptions, photos: Sequence[Photo], is_video: bool, on_event: OnEvent) -> list[Path | None]:
    """Return the mask of each photograph, and say how many have one."""
    if is_video:
        if options.masks is not None:
            raise DataError(
                "--masks are of photographs, got a video; take its frames with ffmpeg, and give their folder"
            )
        return [None] * len(photos)
    masks, line = masks_of(photos, options.photos, options.masks)
    if line:
        on_event(Notice(line))
    return masks


def _folder_of(photos: Path, on_event: OnEvent) -> list[Path]:
    """Return the photographs of a folder; what is not used is told."""
    paths, notes, warning = find_photos(photos)
    if warning:
        on_event(Notice(warning, is_warning=True))
    for note in notes:
        on_event(Notice(note))
    return paths


def _frames_of(video: Video, work: Path, count: int, made_of: dict[str, Any], on_event: OnEvent) -> list[Path]:
    """Frames of a video as photographs in a folder of their own; those of a search that was interrupted will do.

    Raises
    ------
    DataError
        It does not decode, or has too few frames.
    """
    folder = work / FRAMES
    if is_of(work, "photographs", made_of) and folder.is_dir():
        return sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
    shutil.rmtree(folder, ignore_errors=True)
    if video.hdr is not None:
        on_event(Notice(f"{video.path} is an HDR video ({video.hdr}): colours are taken as they are, a little flat"))
    looking = sharpness_of(video)
    with contextlib.closing(looking):
        sharpness = list(counted(looking, "looking for sharp frames", video.frames, on_event))
    if len(sharpness) < FEWEST:
        raise DataError(f"{video.path} must have {FEWEST} frames or more, got {len(sharpness)}; is the file cut?")
    numbers = choose(sharpness, count)
    on_event(Phase("taking frames", 0))
    frames = take(video, numbers, folder)
    on_event(Notice(f"{len(frames)} of {len(sharpness):,} frames were taken, the sharpest of each stretch (--frames)"))
    return frames


def check_poses_options(options: PosesOptions) -> None:
    """Raise RunError for an option that means nothing."""
    for name, allowed in (
        ("cameras", ("auto", "one", "each")),
        ("camera_model", ("auto", *CAMERA_MODELS)),
        ("matching", MATCHINGS),
        ("mapper", MAPPERS),
    ):
        got = getattr(options, name)
        if got not in allowed:
            raise RunError(f"--{name.replace('_', '-')} must be one of {', '.join(allowed)}, got {got}")
    numbers = (
        ("max_size", SMALLEST_SIDE, 1 << 16),
        ("feature_size", SMALLEST_SIDE, 1 << 16),
        ("frames", FEWEST, MAX_FRAMES),
        ("overlap", 1, 1000),
        ("neighbours", 1, 10_000),
        ("threads", 1, MAX_THREADS),
        ("seed", 0, (1 << 31) - 1),
    )
    for name, least, most in numbers:
        value = getattr(options, name)
        if value is not None and not (isinstance(value, int) and least <= value <= most):
            raise RunError(f"--{name.replace('_', '-')} must be a whole number from {least} to {most}, got {value}")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _stage(
    photos: Sequence[Photo], folder: Path, options: PosesOptions, threads: int, on_event: OnEvent, *, ours: bool
) -> list[str]:
    """Put the photographs into the capture; what was done to each. Those that are ``ours`` need no second copy."""
    link = options.link or ours
    copying = copy_images(photos, folder, max_size=options.max_size, link=link, threads=threads)
    with contextlib.closing(copying):  # after Ctrl-C nothing is written any more
        staged = list(counted(copying, "copying photographs", len(photos), on_event))
    counts = Counter(staged)
    if options.link and counts["copied"]:
        on_event(Notice(f"{counts['copied']} photographs were copied: --out is on a disk that cannot link to theirs"))
    if turned := sum(photo.orientation != 1 for photo in photos):
        on_event(Notice(f"{turned} photographs were turned upright, as their EXIF orientation says", detail=True))
    return staged


def _request(options: PosesOptions, work: Path, photos: Sequence[Photo], threads: int, on_event: OnEvent) -> Request:
    """Return what COLMAP is asked to do."""
    places = places_of(photos, options.positions)
    for note in places.notes:
        on_event(Notice(note))
    sizes = [photo.size_within(options.max_size) for photo in photos]
    groups = camera_groups(photos, sizes, options.cameras)
    panoramas, lines = panorama_groups(photos, groups, options.camera_model)
    hints, more = fisheye_hints(photos, groups, panoramas, options.camera_model)
    for line in (*lines, *more):
        on_event(Notice(line))
    # Cameras that are asked to be fisheyes become some later: COLMAP verifies no pair of those of unknown focal length.
    lens = START if options.camera_model in ("auto", FISHEYE) else options.camera_model
    order, ordered_by = in_order_taken(photos)
    return Request(
        images=str(work / STAGED / IMAGES),
        database=str(work / DATABASE),
        output=str(work / STAGED / SPARSE),
        groups=tuple(
            Group(
                tuple(photos[i].name for i in group),
                PANORAMA if is_panorama else lens,
                sizes[group[0]],
                str(photos[group[0]].source.resolve()),
                hint,
                (circle.x, circle.y, circle.radius) if circle else None,
            )
            for group, is_panorama, (hint, circle) in zip(groups, panoramas, hints, strict=True)
        ),
        in_order=tuple(photos[i].name for i in order),
        ordered_by=ordered_by,
        places=tuple(places.metres[i] for i in order),
        matching=_matching(options, len(photos), places),
        mapper=_mapper(options, len(photos)),
        overlap=options.overlap,
        neighbours=options.neighbours,
        feature_size=options.feature_size,
        threads=threads,
        seed=options.seed,
        asked_lens=None if options.camera_model == "auto" else options.camera_model,
    )


def _circles(request: Request) -> dict[str, Circle]:
    """Return the circles of round photographs, by their names."""
    return {name: Circle(*group.circle) for group in request.groups if group.circle for name in group.names}


def _matching(options: PosesOptions, count: int, places: Places) -> str:
    """Which pairs are compared.

    Raises
    ------
    DataError
        By places, of which there are none.
    """
    if options.matching == "spatial" and not places.known:
        raise DataError(
            f"--matching spatial needs photographs that know where they were taken, none of {count} does; give a file "
            "of --positions, or use --matching similar"
        )
    if options.matching != "auto":
        return options.matching
    if count <= ALL_PAIRS:
        return "exhaustive"
    return "spatial" if places.known >= _MOST * count else "similar"


def _mapper(options: PosesOptions, count: int) -> str:
    if options.mapper != "auto":
        return options.mapper
    return "global" if count >= MANY else "incremental"


def asked_for(options: PosesOptions) -> dict[str, Any]:
    """Return the options that decide what the capture is, as ``poses.json`` remembers them."""
    asked = {name: getattr(options, name) for name in ASKED_FOR}
    return {name: str(value.resolve()) if isinstance(value, Path) else value for name, value in asked.items()}


def _progress(on_event: OnEvent) -> Any:
    """Phases and steps from what the solver tells; a phase is announced once."""
    current = ""

    def tell(name: str, done: int, total: int) -> None:
        nonlocal current
        on_event(Step(done) if name == current else Phase(name, total, growth=_GROWTH.get(name, 1.0)))
        current = name

    return tell


def _result(
    options: PosesOptions,
    request: Request,
    photos: Sequence[Photo],
    staged: Sequence[str],
    pieces: Sequence[SfmModel],
    facts: MatchFacts,
    solved: Solved,
) -> dict[str, Any]:
    """All that is known about the capture, for ``poses.json``."""
    best = pieces[0]
    per_camera = Counter(image.camera_id for image in best.images)
    rows = []
    for photo, how in zip(photos, staged, strict=True):
        row = {"name": photo.name, "source": photo.label, "file": how, "features": facts.features.get(photo.name, 0)}
        placed = photo.name in best.names
        reason = {} if placed else {"reason": why_not_placed(photo.name, pieces, facts)}
        rows.append({**row, "placed": placed, **reason})
    return {
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
                "model": best.cameras[number].model,
                "size": [best.cameras[number].width, best.cameras[number].height],
                "params": list(best.cameras[number].params),
                "focal_px": focal_length(best.cameras[number]),
                "photos": count,
                "about": camera_line(best.cameras[number], count, _circle_of(best, number, request)),
            }
            for number, count in sorted(per_camera.items())
        ],
        "lens": {**solved.lens, "about": lens_line(solved.lens)},
        "other_models": [
            {"folder": f"{SPARSE}/{i}", "photos": sorted(piece.names), "points": len(piece.points.xyz)}
            for i, piece in enumerate(pieces[1:], start=1)
        ],
        "photographs": rows,
        "asked": asked_for(options),
        "options": {
            "matching": request.matching,
            "mapper": request.mapper,
            "pairs_matched": len(facts.matches),
            "overlap": options.overlap,
            "neighbours": options.neighbours,
            "max_size": options.max_size,
            "feature_size": options.feature_size,
            "threads": request.threads,
            "seed": options.seed,
        },
        "created": now(),
    }


def _circle_of(model: SfmModel, number: int, request: Request) -> Circle | None:
    """Return the circle of a camera's photographs, which share it."""
    circles = _circles(request)
    return next((circles.get(image.name) for image in model.images if image.camera_id == number), None)


def placed_line(result: dict[str, Any]) -> str:
    """Summarize the reconstruction in one line."""
    return (
        f"{result['placed']} of {result['count']} photographs placed; {result['points']:,} points, "
        f"{result['photos_per_point']:.1f} photographs per point, "
        f"mean reprojection error {result['mean_error_px']:.2f} px"
    )


def _title(result: dict[str, Any]) -> str:
    return (
        f"{result['placed']} of {result['count']} photographs placed, {result['points']:,} points, "
        f"{result['mean_error_px']:.2f} px"
    )


def _pieces_line(result: dict[str, Any]) -> str:
    """Say how many photographs each piece has, where there are several."""
    others = [len(other["photos"]) for other in result["other_models"]]
    if not others:
        return ""
    rest = ", ".join(str(count) for count in others[:_PIECES]) + (" ..." if len(others) > _PIECES else "")
    return (
        f"the photographs form {len(others) + 1} unconnected models of {result['placed']}, {rest} photographs: the "
        f"largest is the capture ({SPARSE}/0); take photographs between them to connect them"
    )


def _doubts(result: dict[str, Any]) -> list[str]:
    """Return what a person should look at before training."""
    doubts = []
    if result["placed"] < _DOUBTFUL_FRACTION * result["count"]:
        doubts.append(
            f"only {result['placed']} of {result['count']} photographs placed: look at {POSES_PNG}, and take "
            "more between the missing photographs and the others"
        )
    if result["median_angle_degrees"] < _DOUBTFUL_ANGLE:
        doubts.append(
            f"the photographs were taken from nearly the same position ({result['median_angle_degrees']:.1f} degrees "
            "between the rays to a point, 10 or more are good), so depths are unreliable: move sideways between "
            "photographs"
        )
    if result["mean_error_px"] > _DOUBTFUL_ERROR:
        doubts.append(
            f"the mean reprojection error is {result['mean_error_px']:.2f} px (expected below "
            f"{_DOUBTFUL_ERROR}): try --cameras each, or --camera-model OPENCV_FISHEYE for a very wide lens"
        )
    if result["up"] is None:
        doubts.append("the photographs do not agree on which way is up: the axes are COLMAP's")
    return doubts


__all__ = ["PosesOptions", "asked_for", "check_poses_options", "find_poses", "placed_line"]
