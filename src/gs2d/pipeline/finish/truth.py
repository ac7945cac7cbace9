"""The ground truth of a surface: found, read, compared with a mesh by the protocol of its data set."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.config.datasets import DataSet, SceneFacts
from gs2d.config.surface_protocols import VISIBLE_SURFACE
from gs2d.contrib.lab.truth_official import score_dtu, score_tnt
from gs2d.core.mesh import Mesh
from gs2d.data.arrays import read_npy
from gs2d.data.benchmarks import MESH_TRUTHS, find_truth, recognise
from gs2d.errors import DataError
from gs2d.evaluation.surface import SurfaceScore, evaluate_surface, write_clouds
from gs2d.io.meshes import FOREIGN, read_mesh, read_points
from gs2d.io.run_dir import make_folder
from gs2d.io.splat_ply import ply_kind
from gs2d.pipeline.events import Notice, OnEvent, Phase
from gs2d.pipeline.prepare.job import Job
from gs2d.pipeline.prepare.options import EvaluateOptions

APART = 0.05  # of the truth's diagonal: farther, and it is hardly the same surface in the same frame
SEEN_SUFFIX = "_seen.npy"  # beside FILE.ply: FILE_seen.npy, how many views see each face


@dataclass(frozen=True, eq=False)
class Truth:
    """A true surface, compared by the visible-surface protocol.

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


@dataclass(frozen=True, eq=False)
class OfficialTruth:
    """The files of an official ground truth, compared by its data set's protocol.

    Attributes
    ----------
    dataset, facts : DataSet, SceneFacts
    files : mapping of str to Path
        Keys as ``gs2d.data.benchmarks`` names them.
    """

    dataset: DataSet
    facts: SceneFacts
    files: Mapping[str, Path]


def read_truth(path: Path) -> Truth:
    """Read a ground truth: a mesh (with the counts of ``NAME_seen.npy``, if it exists) or the points of a PLY file."""
    kind = "mesh" if path.suffix.lower() in FOREIGN else ply_kind(path)
    if kind == "points":
        return Truth(path, np.asarray(read_points(path).points, np.float64), None)
    if kind != "mesh":
        raise DataError(f"{path}: a mesh or points were expected, got {kind} splats; give the true surface")
    mesh = read_mesh(path)
    counts = path.with_name(path.stem + SEEN_SUFFIX)
    if not counts.exists():
        return Truth(path, mesh, None)
    seen = read_npy(counts, "counts of views")
    if seen.shape != (len(mesh.faces),):
        raise DataError(f"{counts} must hold {len(mesh.faces)} counts (faces of {path.name}), got {list(seen.shape)}")
    return Truth(path, mesh, seen)


def choose_truth(given: Path | None, root: Path, on_event: OnEvent) -> Truth | OfficialTruth | None:
    """Return what a capture's surface is compared with: a folder that was given, or what lies beside the capture.

    Beside a scene of DTU or Tanks and Temples its official files; beside any other ``mesh_gt.ply``, ``mesh_gt.obj`` or
    ``points_gt.ply``. (A file that was given is read by ``read_truth``.)

    Raises
    ------
    DataError
        A folder was given, and it does not hold the official ground truth of this scene; names each missing file.
    """
    known = recognise(root, given)
    if known is not None and known[0].evaluator in ("dtu", "tnt"):
        dataset, facts = known
        files, missing = find_truth(dataset, facts, root, given)
        if not missing:
            return OfficialTruth(dataset, facts, files)
        if given is not None:
            lines = "; ".join(piece.line() for piece in missing)
            raise DataError(f"{given} must hold the ground truth of {facts.name} ({dataset.title}): {lines}")
        for piece in missing if files else ():
            on_event(Notice(piece.line()))
    folder = given or root
    path = next((folder / name for name in MESH_TRUTHS if (folder / name).is_file()), None)
    if path is not None:
        on_event(Notice(f"ground truth: {path}"))
        return read_truth(path)
    if given is not None:
        raise DataError(
            f"{given} must hold the official ground truth of a scene of DTU or Tanks and Temples, or one of "
            f"{', '.join(MESH_TRUTHS)}, got neither for the capture {root.name}; give a PLY or OBJ file"
        )
    return None


def check_thresholds(thresholds: tuple[float, ...]) -> None:
    """Raise for a threshold that is no distance, before anything slow happens."""
    if not all(t > 0 and math.isfinite(t) for t in thresholds):
        raise DataError(f"--thresholds must be positive distances, got {', '.join(map(str, thresholds))}")


def score_surface(
    mesh: Mesh, truth: Truth | OfficialTruth, job: Job, options: EvaluateOptions, on_event: OnEvent, *, folder: Path
) -> dict[str, Any]:
    """Return the ``surface`` entry of ``metrics.json`` (docs/guides/runs.md); the coloured clouds go to ``folder``."""
    on_event(Phase("scoring the surface", 0))
    if isinstance(truth, Truth):
        return _score_visible(mesh, truth, job, options, on_event, folder)
    if options.thresholds:
        on_event(Notice(f"--thresholds are not used: {truth.dataset.title} has its own protocol"))
    make_folder(folder)
    if truth.dataset.evaluator == "dtu":
        facts = score_dtu(mesh, truth.facts, truth.files, job, folder)
    else:
        facts = score_tnt(mesh, truth.facts, truth.files, job, folder)
    for message in facts["self_check"]["messages"]:
        on_event(Notice(message))
    return {**facts, "ground_truth": str(truth.files["scan"])}


def _score_visible(
    mesh: Mesh, truth: Truth, job: Job, options: EvaluateOptions, on_event: OnEvent, folder: Path
) -> dict[str, Any]:
    """Chamfer distance, precision, recall and F-score of a mesh, over what the training views see."""
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
    facts = asdict(replace(score, clouds=None))
    facts.pop("clouds")
    rows = list(facts.pop("scores"))
    files = {}
    if score.clouds is not None:
        make_folder(folder)
        files = {what: f"{folder.name}/{name}" for what, name in write_clouds(folder, score.clouds).items()}
    check = _self_check(score, truth)
    for message in check["messages"]:
        on_event(Notice(message))
    return {
        "evaluator": "visible-surface",
        "unit": "world units" if np.array_equal(job.scene.T_metric_scene, np.eye(4)) else "mm",  # the scale_mat of DTU
        "ground_truth": str(truth.path),
        **{name: rows[0][name] for name in ("threshold", "precision", "recall", "f_score")},
        **facts,
        "thresholds": rows,
        "self_check": check,
        "protocol": asdict(VISIBLE_SURFACE),
        "files": files,
    }


def _self_check(score: SurfaceScore, truth: Truth) -> dict[str, Any]:
    """Whether both surfaces lie in one place at all."""
    far = score.accuracy_median is not None and score.accuracy_median > APART * score.diagonal
    line = (
        f"half of the mesh is more than {APART:.0%} of the true size away from {truth.path.name}: "
        "is it in the capture's frame, and in its units?"
    )
    return {"ok": not far and score.reason is None, "messages": [line] if far else []}
