"""Open a capture for training: choose its protocol, the image size that fits into memory, and the backend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from gs2d.config.protocols import Protocol, get_protocol, protocol_for
from gs2d.data import Scene, detect_format, load_scene
from gs2d.data.known_captures import protocol_of
from gs2d.data.load import reader_of
from gs2d.data.masks import EMPTY, Masks
from gs2d.data.scene import PointCloud, View
from gs2d.errors import ProtocolError
from gs2d.io.run_dir import RunFolder, is_run
from gs2d.pipeline.prepare.limits import check_memory, least_downscale
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.render.backends import Backend, backend_report, get_backend
from gs2d.training.events import Event, Notice, OnEvent

SHOWN_SKIPS = 3


@dataclass(frozen=True, eq=False)
class OpenCapture:
    """A capture as a training sees it.

    Attributes
    ----------
    scene, protocol, backend
    downscale : int
        By which the photographs are smaller than their files.
    """

    scene: Scene
    protocol: Protocol
    backend: Backend
    downscale: int


def open_capture(options: TrainOptions, on_event: OnEvent) -> OpenCapture:
    """Choose backend and protocol and load the capture; its photographs are not decoded yet."""
    backend = choose_backend(options.backend, on_event)
    scene_format = detect_format(options.scene) if options.format == "auto" else options.format
    reader_of(scene_format)  # an unknown format is an error before anything is read
    protocol = choose_protocol(options.protocol, options.scene, scene_format, on_event)
    if options.test_every is not None:
        protocol = replace(protocol, test_every=options.test_every)
    downscale, scene = scene_that_fits(options, scene_format, protocol, backend, on_event)
    if options.test_every is not None and scene.own_split:
        raise ProtocolError(
            f"--test-every is for captures without a split of their own, got {options.scene}, which has one; "
            "leave it out"
        )
    return OpenCapture(scene, with_masks(protocol, scene, on_event), backend, downscale)


def capture_in_memory(scene: Scene, protocol: str | Protocol, backend: str, on_event: OnEvent) -> OpenCapture:
    """Choose backend and protocol for a capture that is loaded already."""
    chosen = choose_backend(backend, on_event)
    rules = choose_protocol(protocol, scene.root or Path("."), scene.format, on_event)
    return OpenCapture(scene, with_masks(rules, scene, on_event), chosen, downscale=1)


def choose_protocol(named: str | Protocol, path: Path, scene_format: str, on_event: OnEvent) -> Protocol:
    """Return the protocol of a name; "auto": that of the capture."""
    if named != "auto":
        return get_protocol(named) if isinstance(named, str) else named
    protocol = protocol_of(path, scene_format)
    if protocol is not protocol_for(scene_format):
        on_event(Notice(f"protocol {protocol.name}: {path.name} is a scene of that data set", detail=True))
    return protocol


def choose_backend(name: str, on_event: OnEvent) -> Backend:
    """Return the backend of a name; say what "auto" took if that is a GPU, not one that is here, or the reference."""
    backend = get_backend(name)
    if name != "auto":
        return backend
    report = backend_report()  # best first: all before the one that was taken cannot run
    taken = [status.name for status in report].index(backend.name)
    if not backend.on_host:
        on_event(Notice(f"training on {report[taken].details} (--backend cpu for the processor)", detail=True))
    elif torch.version.cuda is not None and torch.cuda.device_count() > 0:
        on_event(Notice(f"training without the GPU: {report[0].reason}; {report[0].remedy}"))
    if backend.slow:
        better = report[taken - 1]
        on_event(Notice(f"training with a slow backend, {backend.name}: {better.reason}; {better.remedy}"))
    return backend


def read_scene(
    path: Path,
    scene_format: str,
    downscale: int,
    protocol: Protocol,
    on_event: OnEvent,
    masks: Masks = Masks(),  # noqa: B008 (frozen)
) -> Scene:
    """Load a capture and tell what was decided or skipped."""
    chosen = masks.options()
    scene = load_scene(path, format=scene_format, downscale=downscale, test_every=protocol.test_every, **chosen)
    for text in scene.notes:
        on_event(Notice(text))
    for text in scene.details:
        on_event(Notice(text, detail=True))
    if scene.skipped:
        on_event(Notice(_about_skipped(scene), is_warning=True))
    return scene


def scene_that_fits(
    options: TrainOptions, scene_format: str, protocol: Protocol, backend: Backend, on_event: OnEvent
) -> tuple[int, Scene]:
    """Load a capture, and by what it is shrunk: as asked for, as the run was begun, or as much as memory needs.

    Raises
    ------
    DataError
        At the downscale that was asked for it cannot be trained in the memory there is, or at none.
    """
    masks = Masks(options.masks, options.masked)
    fixed = options.downscale or _begun_with(options)
    said: list[Event] = []
    scene = read_scene(options.scene, scene_format, fixed or 1, protocol, said.append, masks)
    fitting, need = (1, "") if fixed else least_downscale(scene, 1, on_host=backend.on_host)
    if fitting is not None and fitting > 1:
        said = [Notice(f"{need}: they are shrunk by {fitting}, as by --downscale {fitting}")]
        scene = read_scene(options.scene, scene_format, fitting, protocol, said.append, masks)
    for event in said:
        on_event(event)
    check_memory(scene, fixed or fitting or 1, on_host=backend.on_host)
    return fixed or fitting or 1, scene


def _begun_with(options: TrainOptions) -> int | None:
    """Return the downscale of the run that is resumed; None if there is none or it was not recorded."""
    if not (options.resume and is_run(options.out)):
        return None
    begun = RunFolder(options.out).definition().get("downscale")
    return begun if isinstance(begun, int) and begun >= 1 else None


def _about_skipped(scene: Scene) -> str:
    """Return one line about the views that are left out: how many, and which for each reason."""
    reasons: dict[str, list[tuple[str, str]]] = {}
    for line in scene.skipped:
        name, _, reason = line.partition(": ")
        reasons.setdefault(reason.partition("; ")[0], []).append((name, reason))
    parts = []
    for found in reasons.values():
        names = ", ".join(name for name, _ in found[:SHOWN_SKIPS])
        more = f" and {len(found) - SHOWN_SKIPS} more" if len(found) > SHOWN_SKIPS else ""
        parts.append(f"{names}{more}: {found[0][1]}")
    wholes = len({view.path or view.name for view in scene.views})
    count = f"{len(scene.skipped)} of {len(scene.skipped) + wholes} photographs are left out"
    return f"{count} (`gs2d info` lists them): {'; '.join(parts)}"


def with_masks(protocol: Protocol, scene: Scene, on_event: OnEvent) -> Protocol:
    """Return the protocol under which the scene's masks are what the user says; one that passes them over is told."""
    masks = scene.masks
    if not masks.found or masks.masked == EMPTY or protocol.use_mask_in_training:
        return protocol
    if masks.asked_for:
        return replace(protocol, use_mask_in_training=True, use_mask_in_fusion=True)
    on_event(Notice(f"the protocol {protocol.name} trains on masked pixels too (--masked ignore leaves them out)"))
    return protocol


def without_masked_points(scene: Scene, protocol: Protocol, on_event: OnEvent) -> Scene:
    """Return the scene without the sparse points that training photographs show in masked pixels alone.

    Nothing would ever move or prune splats there.
    """
    points, masks = scene.points, scene.masks
    if not masks.found or points is None:
        return scene
    if masks.masked != EMPTY and not protocol.use_mask_in_training:
        return scene
    observed = scene.observed()
    if observed is None or len(observed.points) != len(points):
        return scene
    masked, kept = np.zeros((2, len(points)), dtype=np.int64)
    for view in scene.train:
        rows = observed.seen.get(view.name)
        if rows is None or not len(rows):
            continue
        shown = _kept_pixels(view)
        pixels, depth = view.camera.project(observed.points[rows])
        with np.errstate(invalid="ignore"):
            column, row = (
                np.floor(pixels[:, k]).clip(0, size - 1) for k, size in ((0, shown.shape[1]), (1, len(shown)))
            )
        there = (depth > 0) & np.isfinite(pixels).all(axis=1)
        keeps = shown[row[there].astype(np.int64), column[there].astype(np.int64)]
        np.add.at(kept, rows[there][keeps], 1)
        np.add.at(masked, rows[there][~keeps], 1)
    out = (masked > 0) & (kept == 0)
    if not out.any() or out.all():
        return scene
    line = f"{int(out.sum()):,} of {len(points):,} sparse points lie in masked pixels alone: left out"
    on_event(Notice(line, detail=True))
    return replace(scene, points=_rows(points, ~out))


def _kept_pixels(view: View) -> np.ndarray:
    """Return where a mask keeps a photograph, [H, W] bool; the rim that undistortion leaves counts as kept."""
    kept = np.ones((view.camera.height, view.camera.width), dtype=bool)
    mask, valid, alpha = view.mask(), view.valid(), view.alpha()
    if mask is not None:
        kept &= mask if valid is None else mask | ~valid
    return kept if alpha is None else kept & (alpha >= 0.5)


def _rows(points: PointCloud, rows: np.ndarray) -> PointCloud:
    colors, normals, sizes = (None if a is None else a[rows] for a in (points.colors, points.normals, points.sizes))
    return PointCloud(points.points[rows], colors, normals, sizes)
