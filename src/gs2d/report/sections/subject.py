"""The subject: its box among cameras and sparse points, from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.core.camera import Camera
from gs2d.data.image_files import read_image
from gs2d.data.subject_box import OBJECT, Subject, read_subject
from gs2d.io.run_dir import RENDERS
from gs2d.report.html import render
from gs2d.report.record import RunRecord
from gs2d.report.sections.registry import register_section

IMAGE = "subject.png"
MAX_POINTS = 8000
SPAN = 1.3  # radius of the drawing, relative to the farthest camera or corner
_CAMERA, _BOX = "#d62728", "#111111"


def write_subject_image(path: Path, subject: Subject, cameras: Sequence[Camera], points: np.ndarray) -> None:
    """Draw a subject among the training cameras and sparse points [P, 3] of a capture, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    axes = plane_axes(subject.up)  # rows: right, ahead, up
    middle = subject.box.mean(axis=0)
    corners = np.array([[subject.box[i >> k & 1, k] for k in range(3)] for i in range(8)])
    edges = [(i, i | 1 << k) for i in range(8) for k in range(3) if not i >> k & 1]
    centers = np.array([camera.center for camera in cameras])
    reach = SPAN * max(float(np.linalg.norm(np.concatenate([centers, corners]) - middle, axis=1).max()), 1e-9)
    arrows = 0.08 * reach * np.array([camera.forward for camera in cameras])
    shown = points[:: max(1, -(-len(points) // MAX_POINTS))]
    figure = Figure(figsize=(10, 5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for place, (name, upwards) in enumerate((("from above", 1), ("from the side", 2)), start=1):
        plane = axes[[0, upwards]].T  # [3, 2]
        plot = figure.add_subplot(1, 2, place)
        plot.plot(*((shown - middle) @ plane).T, ",", color="#8899aa")
        box = (corners - middle) @ plane
        plot.add_collection(LineCollection([box[[a, b]] for a, b in edges], colors=_BOX, linewidths=1.0))
        start, end = (centers - middle) @ plane, (centers + arrows - middle) @ plane
        plot.add_collection(LineCollection(list(np.stack([start, end], axis=1)), colors=_CAMERA, linewidths=0.9))
        plot.plot(*start.T, ".", color=_CAMERA, markersize=4)
        plot.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title=name, xticks=[], yticks=[])
    with atomic_write(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})


def plane_axes(up: np.ndarray) -> np.ndarray:
    """Return right, ahead and up [3, 3] for pictures of a capture in which ``up`` [3] is up."""
    up = up / np.linalg.norm(up)
    right = np.cross(np.eye(3)[int(np.abs(up).argmin())], up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


@register_section("subject", title="Subject")
def subject_section(run: RunRecord) -> str | None:
    """Return the box of the subject and its drawing; None where the run has no subject."""
    subject = read_subject(run.path)
    if subject is None:
        return None
    drawn = run.path / RENDERS / IMAGE
    return render(
        "subject.html",
        is_object=subject.kind == OBJECT,
        why=subject.why,
        box=" ".join(f"{value:.4g}" for value in subject.box.ravel()),
        pixels=read_image(drawn) / np.float32(255) if drawn.is_file() else None,
    )
