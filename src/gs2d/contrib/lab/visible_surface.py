"""The evaluator of meshes against a true mesh or points, over the surface visible in the training views.

The settings are decisions of this project ([d]): no public protocol exists.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.lab.surface_protocols import VISIBLE_SURFACE
from gs2d.contrib.lab.surface_score import SurfaceScore, evaluate_surface, write_clouds
from gs2d.core.mesh import Mesh
from gs2d.data.arrays import read_npy
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.evaluation.evaluators import GENERAL, Notify, register_evaluator
from gs2d.io.meshes import FOREIGN, read_mesh, read_points
from gs2d.io.run_dir import make_folder
from gs2d.io.splat_ply import ply_kind

APART = 0.05  # fraction of the diagonal of the truth; a larger median distance suggests a wrong coordinate system
MESH_TRUTHS = ("mesh_gt.ply", "mesh_gt.obj", "points_gt.ply")  # files beside a capture
COUNTS_SUFFIX = "_seen.npy"  # FILE_seen.npy beside FILE.ply: number of views that see each face


@dataclass(frozen=True, eq=False)
class Truth:
    """A true surface for the visible-surface protocol."""

    path: Path
    surface: Mesh | np.ndarray  # a mesh, or points [P, 3]
    view_counts: np.ndarray | None  # [F] number of training views that see each face


def read_truth(path: Path) -> Truth:
    """Read a ground truth: a mesh (with the counts of ``NAME_seen.npy``, if it exists) or the points of a PLY file."""
    kind = "mesh" if path.suffix.lower() in FOREIGN else ply_kind(path)
    if kind == "points":
        return Truth(path, np.asarray(read_points(path).points, np.float64), None)
    if kind != "mesh":
        raise DataError(f"{path}: expected a mesh or points, got {kind} splats; use the true surface")
    mesh = read_mesh(path)
    counts = path.with_name(path.stem + COUNTS_SUFFIX)
    if not counts.exists():
        return Truth(path, mesh, None)
    views = read_npy(counts, "counts of views")
    if views.shape != (len(mesh.faces),):
        raise DataError(f"{counts} must hold {len(mesh.faces)} counts (faces of {path.name}), got {list(views.shape)}")
    return Truth(path, mesh, views)


@register_evaluator(GENERAL)
class VisibleSurfaceEvaluator:
    """Chamfer distance, precision, recall and F-score of a mesh, over the surface visible in the training views."""

    has_thresholds = True

    def find(self, capture: Path, ground_truth: Path | None, notify: Notify) -> Truth | None:
        """Return a mesh or points: the file ``ground_truth``, or one of ``MESH_TRUTHS`` in the folder."""
        folder = ground_truth or capture
        path = next((folder / name for name in MESH_TRUTHS if (folder / name).is_file()), None)
        if path is not None:
            notify(f"ground truth: {path}")
        elif ground_truth is not None and not ground_truth.is_dir():
            path = ground_truth
        elif ground_truth is not None:
            raise DataError(
                f"{ground_truth} must contain the official ground truth of a scene of DTU or Tanks and Temples, or one "
                f"of {', '.join(MESH_TRUTHS)}, got neither for the capture {capture.name}; use a PLY or OBJ file"
            )
        truth = None if path is None else read_truth(path)
        if truth is not None and truth.view_counts is not None:
            notify(f"view counts of true faces: {truth.path.stem}{COUNTS_SUFFIX}")
        return truth

    def score(
        self, mesh: Mesh, truth: Truth, scene: Scene, *, folder: Path, thresholds: tuple[float, ...]
    ) -> dict[str, Any]:
        """Score a mesh with the visible-surface protocol."""
        score = evaluate_surface(
            mesh,
            truth.surface,
            cameras=[view.camera for view in scene.train],
            view_counts=truth.view_counts,
            T_truth_mesh=scene.T_metric_scene,
            thresholds=thresholds or None,
        )
        scores = asdict(replace(score, clouds=None))
        scores.pop("clouds")
        rows = list(scores.pop("scores"))
        files = {}
        if score.clouds is not None:
            make_folder(folder)
            files = {what: f"{folder.name}/{name}" for what, name in write_clouds(folder, score.clouds).items()}
        is_world = np.array_equal(scene.T_metric_scene, np.eye(4))  # otherwise the scale_mat of DTU
        return {
            "unit": "world units" if is_world else "mm",
            "ground_truth": str(truth.path),
            **{name: rows[0][name] for name in ("threshold", "precision", "recall", "f_score")},
            **scores,
            "thresholds": rows,
            "self_check": _self_check(score, truth),
            "protocol": asdict(VISIBLE_SURFACE),
            "files": files,
        }


def _self_check(score: SurfaceScore, truth: Truth) -> dict[str, Any]:
    """Check that both surfaces overlap."""
    far = score.accuracy_median is not None and score.accuracy_median > APART * score.diagonal
    line = (
        f"half of the mesh is more than {APART:.0%} of the size of the truth away from {truth.path.name}: check its "
        "coordinate system and units"
    )
    return {"ok": not far and score.reason is None, "messages": [line] if far else []}
