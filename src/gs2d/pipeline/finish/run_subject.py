"""What the cameras of a run look at: found from rendered depth and sparse points, said, written beside the results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from PIL import Image

from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.data.reach import Reach
from gs2d.data.subject_box import (
    OBJECT,
    Sight,
    Subject,
    check_subject_box,
    checked_box,
    find_subject,
    given_subject,
    middle_weights,
    read_subject,
    shown,
)
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.run_dir import SUBJECT, RunFolder
from gs2d.meshing.fusion_bounds import backproject
from gs2d.pipeline.finish.trusted_depth import surface_reach
from gs2d.pipeline.prepare.loaded import LoadedRun, RenderedScene
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.render.api import rasterize
from gs2d.training.events import Notice, OnEvent

MAX_VIEWS = 64  # cameras, evenly chosen, that vote
SIDE = 56  # px, the shorter side of the depth maps that are looked at
OPAQUE = 0.5  # a pixel is surface where at least this much of it is covered
BEHIND = 1.1  # times the rendered depth, beyond which a sparse point is hidden
POINTS_PART = 0.5  # of a camera's vote is that of the sparse points it sees, where there are enough of them
ENOUGH_POINTS = 20
MAX_POINTS = 2000  # sparse points of a camera, evenly from the list


def subject_of(
    run: RunFolder, loaded: LoadedRun, splats: Splats, on_event: OnEvent, *, box: Sequence[float] | None = None
) -> Subject:
    """Return the subject of a run: the given box, else what ``subject.json`` says, else what is found; then kept there.

    Parameters
    ----------
    box : sequence of 6 floats, optional
        x0 y0 z0 x1 y1 z1, world units: the user's own.

    Raises
    ------
    ProtocolError
        The box is none, or the splats show no surface.
    RunError
        There is no splat in the box: what would be kept is a mistake.
    DataError
        ``subject.json`` is damaged.
    DiskError
    """
    known = read_subject(run.path) if box is None else None
    if known is not None:
        return known
    subject = subject_in(loaded, splats, box)
    on_event(Notice(subject_line(subject, meshed=box is not None or loaded.protocol.fusion.subject)))
    write_json(run.file(SUBJECT), subject.to_json())
    return subject


def subject_in(loaded: RenderedScene, splats: Splats, box: Sequence[float] | None = None) -> Subject:
    """Return the subject of a scene: the given box, or what is found; nothing is read or written.

    Raises
    ------
    ProtocolError, RunError
        As :func:`subject_of`.
    """
    if box is not None:
        within(splats, box, "--subject-box")
    try:
        cameras = [view.camera for view in loaded.scene.train]
        return find_subject(sights(loaded, splats)) if box is None else given_subject(box, cameras)
    except DataError as error:
        raise ProtocolError(str(error)) from error


def meshed_subject(
    run: RunFolder, loaded: LoadedRun, splats: Splats, options: MeshOptions, on_event: OnEvent
) -> Subject | None:
    """Find the subject of a run; return it if the mesh is of it, None if it is of everything or of a box of its own."""
    wanted = wants_subject(loaded, options)
    subject = subject_of(run, loaded, splats, on_event, box=options.subject_box)
    return subject if wanted and subject.kind == OBJECT else None


def wants_subject(loaded: RenderedScene, options: MeshOptions) -> bool:
    """Whether the mesh is to be of the subject, if there is one.

    Raises
    ------
    ProtocolError, DataError
        Options that exclude each other, or a box that is none.
    """
    given = options.subject_box
    others = {"--bbox": options.bbox is not None, "--scene": options.whole_scene, "--unbounded": options.unbounded}
    check_subject_box(given, others)
    return given is not None or (loaded.protocol.fusion.subject and not any(others.values()))


def within(splats: Splats, box: Sequence[float], option: str = "--bbox") -> Splats:
    """Return the splats whose centres lie in a box, x0 y0 z0 x1 y1 z1, world units, which the user gave by an option.

    Raises
    ------
    DataError
        The numbers are no box.
    RunError
        There is no splat in it.
    """
    low, high = torch.from_numpy(checked_box(box, option)).to(splats.means)
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not bool(inside.any()):
        ends = torch.cat([splats.means.min(dim=0).values, splats.means.max(dim=0).values])
        raise RunError(f"{option} must hold splats, got none of {len(splats):,}; all lie in {_numbers(ends.tolist())}")
    return splats.rows(inside)


def _numbers(box: Iterable[float]) -> str:
    """Return a box as options take it."""
    return " ".join(f"{value:.4g}" for value in box)


def subject_line(subject: Subject, *, meshed: bool) -> str:
    """Return one line on what was found, with the numbers that --bbox takes; ``meshed``: the mesh is of it alone."""
    if subject.kind != OBJECT:
        return f"subject: the whole scene ({subject.why}); --subject-box x0 y0 z0 x1 y1 z1 names a part of it"
    end = "--scene takes everything" if meshed else "the mesh is of everything, --subject-box limits it"
    size = " x ".join(f"{side:.3g}" for side in subject.high - subject.low)
    return f"subject: {size} world units, box {_numbers(subject.box.ravel())} ({subject.why}); {end}"


def sights(loaded: RenderedScene, splats: Splats) -> list[Sight]:
    """Return what some of the training cameras see: rendered depth, and the sparse points that it does not hide."""
    views = loaded.scene.train
    count = min(len(views), MAX_VIEWS)
    chosen = [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]
    points = np.zeros((0, 3)) if loaded.scene.points is None else np.asarray(loaded.scene.points.points, np.float64)
    reach = surface_reach(loaded)
    return [
        _sight(camera := _small(view.camera), _depth(loaded, splats, camera), points, _kept(loaded, view), reach)
        for view in chosen
    ]


def _kept(loaded: RenderedScene, view: View) -> np.ndarray | None:
    """Return where a photograph may say what it looks at, [H, W] bool: where its mask keeps it. None: anywhere."""
    used = loaded.scene.masks.found and loaded.protocol.use_mask_in_training
    return view.mask() if used else None


def _small(camera: Camera) -> Camera:
    scale = min(SIDE / min(camera.width, camera.height), 1.0)
    return camera.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))


def _depth(loaded: RenderedScene, splats: Splats, camera: Camera) -> np.ndarray:
    """Return the median depth, 0 where little is covered: unlike the mean it lies on some surface."""
    with torch.no_grad():
        output = rasterize(splats, camera, loaded.settings, backend=loaded.backend)
    return np.asarray(torch.where(output.alpha >= OPAQUE, output.depth_median, 0).cpu().numpy(), np.float64)


def _sight(
    camera: Camera, depth: np.ndarray, points: np.ndarray, kept: np.ndarray | None, reach: Reach | None
) -> Sight:
    """Return the votes of one camera; ``kept`` [H, W] bool, of any size: pixels that may vote."""
    points = points[shown(camera, points)]
    if kept is not None:
        image = Image.fromarray(kept).resize((camera.width, camera.height), Image.Resampling.NEAREST)
        small = np.asarray(image, dtype=bool)
        pixels = camera.project(points)[0].astype(np.int64)
        points = points[small[pixels[:, 1].clip(max=camera.height - 1), pixels[:, 0].clip(max=camera.width - 1)]]
        depth = np.where(small, depth, 0)
    rows, columns = np.nonzero(depth > 0)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    z = depth[rows, columns]
    surface = backproject(camera, z, rows, columns)
    near = np.ones(len(surface), dtype=bool) if reach is None else reach.holds(surface)
    surface, pixels = surface[near], pixels[near]
    visible = _visible(camera, depth, points)
    parts = [(surface, middle_weights(camera, pixels)), (visible, middle_weights(camera, camera.project(visible)[0]))]
    fractions = [1.0, 0.0]
    if len(visible) >= ENOUGH_POINTS:
        fractions = [1 - POINTS_PART, POINTS_PART] if len(surface) else [0.0, 1.0]
    weights = [
        weight * (fraction / weight.sum() if weight.sum() > 0 else 0)
        for (_, weight), fraction in zip(parts, fractions, strict=True)
    ]
    return Sight(camera, np.concatenate([surface, visible]), np.concatenate(weights))


def _visible(camera: Camera, depth: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the points, in a camera's picture, that no rendered surface hides."""
    points = points[:: max(1, -(-len(points) // MAX_POINTS))]
    pixels, z = camera.project(points)
    column = np.minimum(pixels[:, 0].astype(np.int64), camera.width - 1)
    row = np.minimum(pixels[:, 1].astype(np.int64), camera.height - 1)
    surface = depth[row, column]
    return np.asarray(points[(surface <= 0) | (z <= BEHIND * surface)])
