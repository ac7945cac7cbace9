"""A capture as a training sees it: its protocol, its photographs at a size that fits into memory, the backend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from gs2d.config.protocols import Protocol, get_protocol, protocol_for
from gs2d.data import Scene, detect_format, load_scene
from gs2d.data.benchmarks import protocol_of
from gs2d.data.load import reader_of
from gs2d.data.masks import Masks
from gs2d.errors import ProtocolError
from gs2d.io.run_dir import RunFolder, is_run
from gs2d.pipeline.events import Event, Notice, OnEvent
from gs2d.pipeline.prepare.capture_masks import with_masks
from gs2d.pipeline.prepare.memory_budget import check_memory, least_downscale
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.render.backends import Backend, backend_report, get_backend

SHOWN_SKIPS = 3


@dataclass(frozen=True, eq=False)
class Opened:
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


def open_capture(options: TrainOptions, on_event: OnEvent, scene: Scene | None = None) -> Opened:
    """Choose backend and protocol and load the capture; its photographs are not decoded yet.

    Parameters
    ----------
    options : TrainOptions
    on_event : callable
    scene : Scene, optional
        The capture, if it is in memory already.
    """
    backend = choose_backend(options.backend, on_event)
    if scene is None:
        scene_format = detect_format(options.scene) if options.format == "auto" else options.format
        reader_of(scene_format)  # an unknown format is an error before anything is read
        protocol = choose_protocol(options, scene_format, on_event)
        downscale, scene = scene_that_fits(options, scene_format, protocol, backend, on_event)
    else:
        protocol, downscale = choose_protocol(options, scene.format, on_event), 1
    if options.test_every is not None and scene.own_split:
        raise ProtocolError(
            f"--test-every is for captures without a split of their own, got {options.scene}, which has one; "
            "leave it out"
        )
    return Opened(scene, with_masks(protocol, scene, on_event), backend, downscale)


def choose_protocol(options: TrainOptions, scene_format: str, on_event: OnEvent) -> Protocol:
    """Return the protocol of a name, or of the capture, with what the options change in it."""
    named = options.protocol
    if named == "auto":
        protocol = protocol_of(options.scene, scene_format)
        if protocol is not protocol_for(scene_format):
            line = f"protocol {protocol.name}: {options.scene.name} is a scene of that data set"
            on_event(Notice(line, detail=True))
    else:
        protocol = get_protocol(named) if isinstance(named, str) else named
    return protocol if options.test_every is None else replace(protocol, test_every=options.test_every)


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
    """Return the downscale of the run that is gone on with; None: there is none, or it was not written down."""
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
