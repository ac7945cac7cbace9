"""Meshes of DTU and Tanks and Temples against their official ground truth: what goes into ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.config.datasets import SceneFacts
from gs2d.config.surface_protocols import DTU_SURFACE, TNT_SURFACE
from gs2d.contrib.lab.evaluate_dtu import Silhouette, evaluate_dtu, read_dtu_truth
from gs2d.contrib.lab.evaluate_tnt import Alignment, evaluate_tnt, read_tnt_truth, read_trajectory
from gs2d.core.mesh import Mesh
from gs2d.data.benchmarks import published_log
from gs2d.data.image_files import read_mask
from gs2d.data.readers.dtu import dtu_silhouettes
from gs2d.errors import DataError
from gs2d.evaluation.surface import write_clouds
from gs2d.pipeline.prepare.job import Job


def score_dtu(mesh: Mesh, scene: SceneFacts, files: Mapping[str, Path], job: Job, folder: Path) -> dict[str, Any]:
    """Chamfer distance, mm."""
    truth = read_dtu_truth(scene.scan or 0, files)
    silhouettes, T = _silhouettes(job), job.scene.T_metric_scene
    score = evaluate_dtu(mesh, silhouettes, T, truth)
    return {
        "evaluator": "dtu",
        "unit": "mm",
        "chamfer": score.chamfer,
        "accuracy": score.accuracy,
        "completeness": score.completeness,
        "f_score": None,
        "mesh_points": score.mesh_points,
        "truth_points": score.truth_points,
        "dropped_mesh": score.dropped_mesh,
        "dropped_truth": score.dropped_truth,
        "culled": score.culled,
        "reason": score.reason,
        "thresholds": [],
        "self_check": {"ok": score.ok, "messages": list(score.messages)},
        "protocol": asdict(DTU_SURFACE),
        "files": _written(folder, write_clouds(folder, score.clouds)),
    }


def _silhouettes(job: Job) -> list[Silhouette]:
    """Return the mask files at their full size; where there are none, the views' own silhouettes."""
    found = dtu_silhouettes(job.scene.root) if job.scene.root is not None else ()
    if found:
        return [Silhouette(view.camera, read_mask(view.path)) for view in found]
    own = [(view.camera, view.object_mask()) for view in job.scene.train]
    return [Silhouette(camera, mask) for camera, mask in own if mask is not None]


def score_tnt(mesh: Mesh, scene: SceneFacts, files: Mapping[str, Path], job: Job, folder: Path) -> dict[str, Any]:
    """Precision, recall and F-score at the scene's tau."""
    if scene.tau is None:
        raise DataError(f"a tau was expected for {scene.name}, its data set names none")
    log = None if job.scene.root is None else published_log(job.scene.root, scene.name)
    views = job.scene.views
    score = evaluate_tnt(
        mesh,
        [view.name for view in views],
        np.stack([view.camera.center for view in views]),
        read_tnt_truth(scene.name, files),
        scene.tau,
        published=read_trajectory(log) if log is not None and log.is_file() and log.stat().st_size else None,
    )
    row = {"threshold": score.tau, "precision": score.precision, "recall": score.recall, "f_score": score.f_score}
    return {
        "evaluator": "tnt",
        "unit": "m",
        **row,
        "chamfer": score.chamfer,
        "accuracy": score.accuracy,
        "completeness": score.completeness,
        "mesh_points": score.mesh_points,
        "truth_points": score.truth_points,
        "reason": score.reason,
        "thresholds": [row],
        "self_check": _alignment(score.alignment),
        "protocol": asdict(TNT_SURFACE),
        "files": _written(folder, write_clouds(folder, score.clouds)),
    }


def _alignment(alignment: Alignment) -> dict[str, Any]:
    facts = {name: getattr(alignment, name) for name in Alignment.__dataclass_fields__}
    return facts | {
        "messages": list(alignment.messages),
        "stages": [asdict(stage) for stage in alignment.stages],
        "T_truth_mesh": alignment.T_truth_mesh.tolist(),
    }


def _written(folder: Path, names: Mapping[str, str]) -> dict[str, str]:
    """Names relative to the run."""
    return {what: f"{folder.name}/{name}" for what, name in names.items()}
