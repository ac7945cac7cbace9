"""What the cameras of a run look at: found from rendered depth and sparse points, said, written beside the results."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gs2d.camera import Camera
from gs2d.data.subject import OBJECT, Sight, Subject, find_subject, given_subject, middle_weights, read_subject, shown
from gs2d.errors import DataError, DiskError, ProtocolError, RunError
from gs2d.io.files import write_json
from gs2d.io.run import RENDERS, SUBJECT, RunFolder, make_folder
from gs2d.pipeline.events import Notice, OnEvent
from gs2d.pipeline.options import MeshOptions
from gs2d.pipeline.prepare import Job
from gs2d.render.api import rasterize
from gs2d.report_subject import PICTURE, write_subject_picture
from gs2d.splats import Splats

MOST_VIEWS = 64  # cameras, evenly chosen, that vote
SIDE = 56  # px, the shorter side of the depth maps that are looked at
OPAQUE = 0.5  # as for the mesh
BEHIND = 1.1  # times the rendered depth, beyond which a sparse point is hidden
POINTS_PART = 0.5  # of a camera's vote is that of the sparse points it sees, where there are enough of them
ENOUGH_POINTS = 20
MOST_POINTS = 2000  # sparse points of a camera, evenly from the list


def subject_of(
    run: RunFolder, job: Job, splats: Splats, on_event: OnEvent, *, box: Sequence[float] | None = None
) -> Subject:
    """Return the subject of a run: the given box, else what ``subject.json`` says, else what is found; then kept there.

    Parameters
    ----------
    box : sequence of 6 floats, optional
        x0 y0 z0 x1 y1 z1, wu: the user's own.

    Raises
    ------
    ProtocolError
        The box is none, or the splats show no surface.
    DataError
        ``subject.json`` is damaged.
    DiskError
    """
    known = read_subject(run.path) if box is None else None
    if known is not None:
        return known
    try:
        cameras = [view.camera for view in job.scene.train]
        subject = find_subject(sights(job, splats)) if box is None else given_subject(box, cameras)
    except DataError as error:
        raise ProtocolError(str(error)) from error
    write_json(run.file(SUBJECT), subject.to_json())
    on_event(Notice(subject_line(subject)))
    _draw(run, job, subject, on_event)
    return subject


def _draw(run: RunFolder, job: Job, subject: Subject, on_event: OnEvent) -> None:
    """Write the picture for the report; a full disk costs the picture, not the mesh."""
    points = np.zeros((0, 3)) if job.scene.points is None else np.asarray(job.scene.points.points, np.float64)
    try:
        make_folder(run.file(RENDERS))
        cameras = [view.camera for view in job.scene.train]
        write_subject_picture(run.file(RENDERS) / PICTURE, subject, cameras, points)
    except DiskError as error:
        on_event(Notice(f"no picture of the subject: {error}"))


def meshed_subject(run: RunFolder, job: Job, splats: Splats, options: MeshOptions, on_event: OnEvent) -> Subject | None:
    """Find the subject of a run, and return it where the mesh is to be of it: None for everything, or a box of its own.

    Raises
    ------
    ProtocolError, DataError, DiskError
    """
    given = options.subject_box
    own = [name for name in ("bbox", "whole_scene", "unbounded") if getattr(options, name)]
    if given is not None and own:
        name = {"whole_scene": "--scene"}.get(own[0], f"--{own[0]}")
        raise ProtocolError(f"--subject-box and {name} exclude each other, got both; leave one out")
    subject = subject_of(run, job, splats, on_event, box=given)
    wanted = given is not None or (job.protocol.fusion.subject and not own)
    return subject if wanted and subject.kind == OBJECT else None


def within(splats: Splats, box: Sequence[float]) -> Splats:
    """Return the splats whose centres lie in a box, x0 y0 z0 x1 y1 z1, wu.

    Raises
    ------
    RunError
        The numbers are no box, or there is no splat in it.
    """
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not (corners[:3] < corners[3:]).all():
        raise RunError(f"--bbox must be a lower corner and a higher one, x0 y0 z0 x1 y1 z1, got {list(box)}")
    low, high = torch.from_numpy(corners).to(splats.means).split(3)
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not bool(inside.any()):
        least, most = (f(dim=0).values.tolist() for f in (splats.means.min, splats.means.max))
        raise RunError(f"--bbox must hold splats, got none of {len(splats):,}; they lie from {least} to {most}")
    return splats.rows(inside)


def subject_line(subject: Subject) -> str:
    """Return one line on what was found, with the numbers that --bbox takes."""
    if subject.kind != OBJECT:
        return f"subject: the whole scene ({subject.why}); --subject-box x0 y0 z0 x1 y1 z1 names a part of it"
    size = " x ".join(f"{side:.3g}" for side in subject.high - subject.low)
    numbers = " ".join(f"{value:.4g}" for value in subject.box.ravel())
    return f"subject: {size} wu, box {numbers} ({subject.why}); --scene takes everything"


def sights(job: Job, splats: Splats) -> list[Sight]:
    """Return what some of the training cameras see: rendered depth, and the sparse points that it does not hide."""
    views = job.scene.train
    count = min(len(views), MOST_VIEWS)
    cameras = [views[i].camera for i in np.linspace(0, len(views) - 1, count).round().astype(int)]
    points = np.zeros((0, 3)) if job.scene.points is None else np.asarray(job.scene.points.points, np.float64)
    return [_sight(camera, _depth(job, splats, camera), points) for camera in map(_small, cameras)]


def _small(camera: Camera) -> Camera:
    scale = min(SIDE / min(camera.width, camera.height), 1.0)
    return camera.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))


def _depth(job: Job, splats: Splats, camera: Camera) -> np.ndarray:
    """The median depth, 0 where little is covered: unlike the mean it lies on some surface."""
    with torch.no_grad():
        output = rasterize(splats, camera, job.settings, backend=job.backend)
    return np.asarray(torch.where(output.alpha >= OPAQUE, output.depth_median, 0).cpu().numpy(), np.float64)


def _sight(camera: Camera, depth: np.ndarray, points: np.ndarray) -> Sight:
    """The votes of one camera."""
    rows, columns = np.nonzero(depth > 0)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    z = depth[rows, columns]
    rays = np.concatenate([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((len(z), 1))], axis=1)
    surface = (rays * z[:, None] - camera.T_cam_world[:3, 3]) @ camera.rotation
    visible = _visible(camera, depth, points)
    parts = [(surface, middle_weights(camera, pixels)), (visible, middle_weights(camera, camera.project(visible)[0]))]
    shares = [1.0, 0.0]
    if len(visible) >= ENOUGH_POINTS:
        shares = [1 - POINTS_PART, POINTS_PART] if len(surface) else [0.0, 1.0]
    weights = [
        weight * (share / weight.sum() if weight.sum() > 0 else 0)
        for (_, weight), share in zip(parts, shares, strict=True)
    ]
    return Sight(camera, np.concatenate([surface, visible]), np.concatenate(weights))


def _visible(camera: Camera, depth: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The sparse points in a camera's picture that no rendered surface hides."""
    points = points[shown(camera, points)]
    points = points[:: max(1, -(-len(points) // MOST_POINTS))]
    pixels, z = camera.project(points)
    column = np.minimum(pixels[:, 0].astype(np.int64), camera.width - 1)
    row = np.minimum(pixels[:, 1].astype(np.int64), camera.height - 1)
    surface = depth[row, column]
    return np.asarray(points[(surface <= 0) | (z <= BEHIND * surface)])
