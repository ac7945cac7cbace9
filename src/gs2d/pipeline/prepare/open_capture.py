"""Open a capture for training: choose its protocol, training length, image size and backend."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from gs2d.config.protocols import Protocol, get_protocol
from gs2d.core.json_files import read_json
from gs2d.data import Scene, detect_format, load_scene
from gs2d.data.known_captures import missing_lines, protocol_for, protocol_of
from gs2d.data.load import reader_of
from gs2d.data.masks import EMPTY, Masks
from gs2d.data.scene import PointCloud, View
from gs2d.errors import ProtocolError
from gs2d.io.run_dir import RunFolder, is_run
from gs2d.pipeline.prepare.limits import check_memory, least_downscale
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.render.backends import Backend, backend_report, get_backend
from gs2d.sfm.workspace import POSES_JSON
from gs2d.training.events import Event, Notice, OnEvent

SHOWN_SKIPS = 3
FEW = 24  # photographs placed by `gs2d poses`; with fewer, all are needed for the surface


class QualityLevel(NamedTuple):
    """Iterations and approximate longer side of the images in px; None: the whole recipe, full-size images."""

    iterations: int | None = None
    side: int | None = None


WHOLE = QualityLevel()
_FULL = QualityLevel(None, 1600)  # the image size of the official code
QUALITIES = {  # of --quality, by the device that trains
    "draft": {"cpu": QualityLevel(1_800, 400), "gpu": QualityLevel(6_000, 800)},
    "normal": {"cpu": QualityLevel(6_000, 800), "gpu": QualityLevel(30_000, 1600)},
    "full": {"cpu": _FULL, "gpu": _FULL},
}


def quality_level(name: str, *, is_data_set: bool, on_host: bool) -> QualityLevel:
    """Return what a quality means; "auto" is the whole recipe for a data set with a protocol of its own."""
    if name == "auto" and is_data_set:
        return WHOLE
    return QUALITIES["normal" if name == "auto" else name]["cpu" if on_host else "gpu"]


@dataclass(frozen=True, eq=False)
class OpenCapture:
    """A capture as a training sees it."""

    scene: Scene
    protocol: Protocol
    backend: Backend
    downscale: int  # factor by which the photographs are smaller than their files
    quality: QualityLevel = WHOLE  # training length, where the options do not set it


def open_capture(options: TrainOptions, on_event: OnEvent) -> OpenCapture:
    """Choose backend and protocol and load the capture; its photographs are not decoded yet.

    The downscale is that of the options, of the resumed run, or by quality and memory. Raises DataError if training at
    the requested downscale, or at any, does not fit into memory.
    """
    backend = choose_backend(options.backend, on_event)
    scene_format = detect_format(options.scene) if options.format == "auto" else options.format
    reader_of(scene_format)  # an unknown format is an error before anything is read
    protocol = choose_protocol(options.protocol, options.scene, scene_format, on_event)
    if options.test_every is not None:
        protocol = replace(protocol, test_every=options.test_every)
    elif options.protocol == "auto":
        placed, _, _ = placed_photographs(options.scene)
        protocol = protocol if placed is None or placed >= FEW else replace(protocol, test_every=0)
    quality = quality_level(options.quality, is_data_set=not protocol.robust, on_host=backend.on_host)
    masks, notices = Masks(options.masks, options.masked), list[Event]()

    def load(factor: int, *lines: str) -> Scene:
        notices[:] = map(Notice, lines)
        return read_scene(options.scene, scene_format, factor, protocol, notices.append, masks)

    downscale = options.downscale
    if downscale is None and options.resume and is_run(options.out):
        begun = RunFolder(options.out).definition().get("downscale")
        downscale = begun if isinstance(begun, int) and begun >= 1 else None
    scene = load(downscale or 1)
    if downscale is None:
        side = max(max(view.camera.width, view.camera.height) for view in scene.views)
        downscale = 1 if quality.side is None else max(1, math.floor(side / quality.side + 0.5))
        scene = load(downscale) if downscale > 1 else scene
        fitting, need = least_downscale(scene, downscale, on_host=backend.on_host)
        if fitting is not None and fitting > downscale:
            downscale = fitting
            scene = load(fitting, f"{need}: they are shrunk by {fitting}, as by --downscale {fitting}")
    for event in notices:
        on_event(event)
    missing = missing_lines(options.scene)
    for line in missing[:SHOWN_SKIPS]:
        on_event(Notice(line))
    if len(missing) > SHOWN_SKIPS:
        on_event(Notice(f"{len(missing) - SHOWN_SKIPS} more files are missing; `gs2d info` lists them"))
    check_memory(scene, downscale, on_host=backend.on_host)
    if options.test_every is not None and scene.own_split:
        raise ProtocolError(f"--test-every: {options.scene} has its own test views; omit the option")
    return OpenCapture(scene, with_masks(protocol, scene, on_event), backend, downscale, quality)


def capture_in_memory(scene: Scene, protocol: str | Protocol, backend: str, on_event: OnEvent) -> OpenCapture:
    """Choose backend and protocol for a capture that is already loaded."""
    chosen = choose_backend(backend, on_event)
    rules = choose_protocol(protocol, scene.root or Path("."), scene.format, on_event)
    return OpenCapture(scene, with_masks(rules, scene, on_event), chosen, downscale=1)


def choose_protocol(named: str | Protocol, path: Path, scene_format: str, on_event: OnEvent) -> Protocol:
    """Return the protocol of a name; "auto": that of the capture."""
    if named != "auto":
        return get_protocol(named) if isinstance(named, str) else named
    protocol = protocol_of(path, scene_format)
    if protocol is not protocol_for(scene_format):
        on_event(Notice(f"protocol {protocol.name}: {path.name} belongs to that data set", detail=True))
    return protocol


def choose_backend(name: str, on_event: OnEvent) -> Backend:
    """Return the backend of a name; report the choice of "auto", and why a faster backend cannot run."""
    backend = get_backend(name)
    if name != "auto":
        return backend
    report = backend_report()  # best first: those before the chosen one cannot run
    chosen = [status.name for status in report].index(backend.name)
    if not backend.on_host:
        on_event(Notice(f"training on {report[chosen].details} (--backend cpu for the CPU)", detail=True))
    elif torch.version.cuda is not None and torch.cuda.device_count() > 0:
        on_event(Notice(f"training without the GPU: {report[0].reason}; {report[0].remedy}"))
    if backend.slow:
        better = report[chosen - 1]
        on_event(Notice(f"training with the slow backend {backend.name}: {better.reason}; {better.remedy}"))
    return backend


def read_scene(
    path: Path,
    scene_format: str,
    downscale: int,
    protocol: Protocol,
    on_event: OnEvent,
    masks: Masks = Masks(),  # noqa: B008 (frozen)
) -> Scene:
    """Load a capture and report what was decided or skipped."""
    chosen = masks.options()
    scene = load_scene(path, format=scene_format, downscale=downscale, test_every=protocol.test_every, **chosen)
    for text in scene.notes:
        on_event(Notice(text))
    for text in scene.details:
        on_event(Notice(text, detail=True))
    if scene.skipped:
        used, more = len({view.path or view.name for view in scene.views}), len(scene.skipped) > SHOWN_SKIPS
        count = f"{len(scene.skipped)} of {len(scene.skipped) + used} photographs are left out"
        first = f"{'; '.join(scene.skipped[:SHOWN_SKIPS])}{' ...' if more else ''}"
        on_event(Notice(f"{count} (`gs2d info` lists them): {first}", is_warning=True))
    return scene


def placed_photographs(capture: Path | None) -> tuple[int | None, int | None, tuple[str, ...]]:
    """Return the number of photographs with a camera, of all photographs, and the names without one.

    Numbers are None if `gs2d poses` did not make the capture.
    """
    path = None if capture is None else capture / POSES_JSON
    if path is None or not path.is_file():
        return None, None, ()
    data = read_json(path)
    try:
        lost = tuple(str(row["source"]) for row in data["photographs"] if not row["placed"])
        return int(data["placed"]), int(data["count"]), lost
    except (LookupError, TypeError, ValueError, OverflowError):
        return None, None, ()  # a file of this name by another program


# -- masks -------------------------------------------------------------------------------------------------------------
def with_masks(protocol: Protocol, scene: Scene, on_event: OnEvent) -> Protocol:
    """Return the protocol with masks used as requested; report masks that the protocol ignores."""
    masks = scene.masks
    if not masks.found or masks.masked == EMPTY or protocol.use_mask_in_training:
        return protocol
    if masks.requested:
        return replace(protocol, use_mask_in_training=True, use_mask_in_fusion=True)
    on_event(Notice(f"the protocol {protocol.name} trains on masked pixels too (--masked ignore excludes them)"))
    return protocol


def without_masked_points(scene: Scene, protocol: Protocol, on_event: OnEvent) -> Scene:
    """Return the scene without the sparse points that are visible in masked pixels only.

    Splats there would have no gradients and would never be pruned.
    """
    points, masks = scene.points, scene.masks
    if not masks.found or points is None or (masks.masked != EMPTY and not protocol.use_mask_in_training):
        return scene
    observed = scene.observed()
    if observed is None or len(observed.points) != len(points):
        return scene
    masked, valid = np.zeros((2, len(points)), dtype=np.int64)
    for view in scene.train:
        rows = observed.by_view.get(view.name)
        if rows is None or not len(rows):
            continue
        shown = _unmasked_pixels(view)
        pixels, depth = view.camera.project(observed.points[rows])
        with np.errstate(invalid="ignore"):
            column = np.floor(pixels[:, 0]).clip(0, shown.shape[1] - 1)
            row = np.floor(pixels[:, 1]).clip(0, len(shown) - 1)
        inside = (depth > 0) & np.isfinite(pixels).all(axis=1)
        keeps = shown[row[inside].astype(np.int64), column[inside].astype(np.int64)]
        np.add.at(valid, rows[inside][keeps], 1)
        np.add.at(masked, rows[inside][~keeps], 1)
    out = (masked > 0) & (valid == 0)
    if not out.any() or out.all():
        return scene
    line = f"{int(out.sum()):,} of {len(points):,} sparse points are in masked pixels only: left out"
    on_event(Notice(line, detail=True))
    arrays = (None if a is None else a[~out] for a in (points.colors, points.normals, points.sizes))
    return replace(scene, points=PointCloud(points.points[~out], *arrays))


def _unmasked_pixels(view: View) -> np.ndarray:
    """Return the unmasked pixels, [H, W] bool; the border that undistortion leaves counts as unmasked."""
    usable = np.ones((view.camera.height, view.camera.width), dtype=bool)
    mask, valid, alpha = view.mask(), view.valid(), view.alpha()
    if mask is not None:
        usable &= mask if valid is None else mask | ~valid
    return usable if alpha is None else usable & (alpha >= 0.5)
