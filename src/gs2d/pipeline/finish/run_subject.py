"""The subject of a run: detected in rendered depth and sparse points, reported, and written into the run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.data.bounds import Reach
from gs2d.data.subject_box import (
    OBJECT,
    Sight,
    Subject,
    check_subject_box,
    checked_box,
    find_subject,
    middle_weights,
    read_subject,
    shown,
    subject_in_box,
)
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.run_dir import SUBJECT, RunFolder
from gs2d.meshing.fusion_bounds import backproject
from gs2d.meshing.mesh_methods import MESH_METHODS
from gs2d.pipeline.finish.trusted_depth import surface_reach
from gs2d.pipeline.look.page import some_views
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.training.events import Notice, OnEvent

MAX_VIEWS = 64  # cameras that vote, evenly spaced
SIDE = 56  # px, shorter side of the depth maps
OPAQUE = 0.5  # least alpha of a pixel that shows a surface
BEHIND = 1.1  # times the rendered depth; sparse points beyond it are hidden
POINTS_PART = 0.5  # of the vote of a camera: its visible sparse points, if there are enough
ENOUGH_POINTS = 20
MAX_POINTS = 2000  # sparse points per camera


def subject_in(trained: Trained, box: Sequence[float] | None = None) -> Subject:
    """Return the subject of a scene: ``box`` (x0 y0 z0 x1 y1 z1, world units), or a detected one.

    Raises ProtocolError if the box is invalid, or the splats show no surface, RunError if there is no splat in the box.
    """
    if box is not None:
        centers_inside(trained.splats, box, "--subject-box")
    try:
        cameras = [view.camera for view in trained.scene.train]
        return find_subject(sights(trained)) if box is None else subject_in_box(box, cameras)
    except DataError as error:
        raise ProtocolError(str(error)) from error


def meshed_subject(
    run: RunFolder | None,
    trained: Trained,
    options: MeshOptions,
    on_event: OnEvent,
    *,
    box: Sequence[float] | None = None,
) -> Subject | None:
    """Return the subject if it is meshed, None if everything or another box is meshed.

    A run remembers its subject in ``subject.json``, even if it is not meshed. Without a run, ``box`` (6 numbers) is the
    subject unless ``options`` have one. Raises DataError if ``subject.json`` is damaged.
    """
    chosen = options.subject_box
    others = {
        **{"--bbox": options.bbox is not None, "--scene": options.whole_scene},
        f"--method {options.method}": not MESH_METHODS.get(options.method).bounded,
    }
    check_subject_box(chosen, others)
    is_meshed = chosen is not None or (trained.protocol.fusion.subject and not any(others.values()))
    if run is None and not is_meshed:
        return None
    subject = read_subject(run.path) if run is not None and chosen is None else None
    if subject is None:
        subject = subject_in(trained, chosen or (box if run is None else None))
        on_event(Notice(subject_line(subject, meshed=chosen is not None or trained.protocol.fusion.subject)))
        if run is not None:
            write_json(run.file(SUBJECT), subject.to_json())
    return subject if is_meshed and subject.kind == OBJECT else None


def centers_inside(splats: Splats, box: Sequence[float], option: str) -> Tensor:
    """Return which splats have their centres in a box, bool [N].

    ``box`` is x0 y0 z0 x1 y1 z1, world units; its faces belong to it. ``option`` is its name in errors. Raises
    DataError if the box is invalid, RunError if there is no splat in it.
    """
    low, high = torch.from_numpy(checked_box(box, option)).to(splats.means)
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not bool(inside.any()):
        ends = torch.cat([splats.means.min(dim=0).values, splats.means.max(dim=0).values])
        raise RunError(f"{option} contains none of the {len(splats):,} splats; all are in {_numbers(ends.tolist())}")
    return inside


def _numbers(box: Iterable[float]) -> str:
    """Format a box as options expect it."""
    return " ".join(f"{value:.4g}" for value in box)


def subject_line(subject: Subject, *, meshed: bool) -> str:
    """Describe the subject in one line, with the numbers for --bbox; ``meshed``: only the subject is meshed."""
    if subject.kind != OBJECT:
        return f"subject: the whole scene ({subject.why}); --subject-box x0 y0 z0 x1 y1 z1 selects a part"
    end = "--scene meshes everything" if meshed else "everything is meshed, --subject-box limits it"
    size = " x ".join(f"{side:.3g}" for side in subject.high - subject.low)
    return f"subject: {size} world units, box {_numbers(subject.box.ravel())} ({subject.why}); {end}"


def sights(trained: Trained) -> list[Sight]:
    """Return the votes of some training cameras: rendered depth, and visible sparse points."""
    points = np.zeros((0, 3)) if trained.scene.points is None else np.asarray(trained.scene.points.points, np.float64)
    reach = surface_reach(trained)
    return [
        _sight(camera := _small(view.camera), _depth(trained, camera), points, _voting_pixels(trained, view), reach)
        for view in some_views(trained.scene.train, MAX_VIEWS)
    ]


def _voting_pixels(trained: Trained, view: View) -> np.ndarray | None:
    """Return the pixels of a photograph that may vote, [H, W] bool, by its mask; None: all."""
    used = trained.scene.masks.found and trained.protocol.use_mask_in_training
    return view.mask() if used else None


def _small(camera: Camera) -> Camera:
    scale = min(SIDE / min(camera.width, camera.height), 1.0)
    return camera.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))


def _depth(trained: Trained, camera: Camera) -> np.ndarray:
    """Return the median depth, which unlike the mean is on a surface; 0 where alpha is low."""
    output = trained.render(camera)
    return np.asarray(torch.where(output.alpha >= OPAQUE, output.depth_median, 0).cpu().numpy(), np.float64)


def _sight(
    camera: Camera, depth: np.ndarray, points: np.ndarray, mask: np.ndarray | None, reach: Reach | None
) -> Sight:
    """Return the votes of one camera; ``mask`` [H, W] bool, of any size, marks the pixels that may vote."""
    points = points[shown(camera, points)]
    if mask is not None:
        image = Image.fromarray(mask).resize((camera.width, camera.height), Image.Resampling.NEAREST)
        small = np.asarray(image, dtype=bool)
        pixels = camera.project(points)[0].astype(np.int64)
        points = points[small[pixels[:, 1].clip(max=camera.height - 1), pixels[:, 0].clip(max=camera.width - 1)]]
        depth = np.where(small, depth, 0)
    rows, columns = np.nonzero(depth > 0)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    z = depth[rows, columns]
    surface = backproject(camera, z, rows, columns)
    near = np.ones(len(surface), dtype=bool) if reach is None else reach.contains(surface)
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
    """Return the points in the image of a camera that no rendered surface hides."""
    points = points[:: max(1, -(-len(points) // MAX_POINTS))]
    pixels, z = camera.project(points)
    column = np.minimum(pixels[:, 0].astype(np.int64), camera.width - 1)
    row = np.minimum(pixels[:, 1].astype(np.int64), camera.height - 1)
    surface = depth[row, column]
    return np.asarray(points[(surface <= 0) | (z <= BEHIND * surface)])
