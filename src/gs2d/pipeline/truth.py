"""The ground truth of a surface: read from a file, compared with a mesh."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.errors import DataError
from gs2d.evaluate.surface import evaluate_surface
from gs2d.io.ply import ply_kind, read_mesh, read_points
from gs2d.pipeline.events import Notice, OnEvent, Phase
from gs2d.pipeline.options import EvaluateOptions
from gs2d.pipeline.prepare import Job
from gs2d.triangles import Mesh

SEEN_SUFFIX = "_seen.npy"  # beside FILE.ply: FILE_seen.npy, how many views see each face


@dataclass(frozen=True, eq=False)
class Truth:
    """A true surface.

    Attributes
    ----------
    path : Path
    surface : Mesh, or ndarray [P, 3] of points
    seen : ndarray [F] or None
        How many training views see each face.
    """

    path: Path
    surface: Mesh | np.ndarray
    seen: np.ndarray | None


def read_truth(path: Path) -> Truth:
    """Read a ground truth: a PLY or OBJ mesh (with the counts of ``NAME_seen.npy`` beside it, if any) or PLY points.

    Raises
    ------
    DataError
    """
    kind = "mesh" if path.suffix.lower() == ".obj" else ply_kind(path)
    if kind == "points":
        return Truth(path, np.asarray(read_points(path).points, np.float64), None)
    if kind != "mesh":
        raise DataError(f"{path}: a mesh or points were expected, got {kind} splats; give the true surface")
    mesh = read_mesh(path)
    counts = path.with_name(path.stem + SEEN_SUFFIX)
    if not counts.exists():
        return Truth(path, mesh, None)
    try:
        seen = np.load(counts, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{counts} must hold a count for each face of {path.name}, got: {error}") from error
    if seen.shape != (len(mesh.faces),):
        raise DataError(f"{counts} must hold {len(mesh.faces)} counts (faces of {path.name}), got {list(seen.shape)}")
    return Truth(path, mesh, seen)


def check_thresholds(thresholds: tuple[float, ...]) -> None:
    """Raise for a threshold that is no distance, before anything slow happens.

    Raises
    ------
    DataError
    """
    if not all(t > 0 and math.isfinite(t) for t in thresholds):
        raise DataError(f"--thresholds must be positive distances, got {', '.join(map(str, thresholds))}")


def score_surface(mesh: Mesh, truth: Truth, job: Job, options: EvaluateOptions, on_event: OnEvent) -> dict[str, Any]:
    """Chamfer distance, precision, recall and F-score of a mesh, over what the training views see.

    Raises
    ------
    DataError
    """
    on_event(Phase("scoring the surface", 0))
    if truth.seen is not None:
        on_event(Notice(f"which true faces count is taken from {truth.path.stem}{SEEN_SUFFIX}"))
    score = evaluate_surface(
        mesh,
        truth.surface,
        cameras=[view.camera for view in job.scene.train],
        seen=truth.seen,
        T_truth_mesh=job.scene.T_metric_scene,
        thresholds=options.thresholds or None,
    )
    facts = asdict(score)
    facts["thresholds"] = list(facts.pop("scores"))
    return {"ground_truth": str(truth.path), **facts}
