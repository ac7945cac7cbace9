"""Evaluators of meshes against the official ground truth of DTU and of Tanks and Temples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.lab.dataset_folders import find_truth, published_log, recognise
from gs2d.contrib.lab.datasets import SceneInfo
from gs2d.contrib.lab.dtu_reader import dtu_silhouettes
from gs2d.contrib.lab.evaluate_dtu import ViewSilhouette, evaluate_dtu, read_dtu_truth
from gs2d.contrib.lab.evaluate_tnt import Alignment, evaluate_tnt, read_tnt_truth, read_trajectory
from gs2d.contrib.lab.surface_protocols import DTU_SURFACE, TNT_SURFACE
from gs2d.contrib.lab.surface_score import write_clouds
from gs2d.core.mesh import Mesh
from gs2d.data.image_files import read_mask
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.evaluation.evaluators import Notify, register_evaluator
from gs2d.io.run_dir import make_folder


@dataclass(frozen=True, eq=False)
class OfficialTruth:
    """The files of an official ground truth."""

    info: SceneInfo
    files: Mapping[str, Path]  # by kind, as of ``gs2d.contrib.lab.dataset_folders.find_truth``


def find_official(name: str, capture: Path, ground_truth: Path | None, notify: Notify) -> OfficialTruth | None:
    """Return the official ground truth of a capture, if its data set has the evaluator ``name``.

    Raises DataError if files of this scene are missing in the folder ``ground_truth``.
    """
    match = None if ground_truth is not None and not ground_truth.is_dir() else recognise(capture, ground_truth)
    if match is None or match[0].evaluator != name:
        return None
    dataset, info = match
    files, missing = find_truth(dataset, info, capture, ground_truth)
    if not missing:
        return OfficialTruth(info, files)
    if ground_truth is not None:
        lines = "; ".join(piece.line() for piece in missing)
        raise DataError(f"{ground_truth} must hold the ground truth of {info.name} ({dataset.title}): {lines}")
    for piece in missing if files else ():
        notify(piece.line())
    return None


@register_evaluator("dtu")
class DtuEvaluator:
    """Chamfer distance of DTU, mm."""

    has_thresholds = False

    def find(self, capture: Path, ground_truth: Path | None, notify: Notify) -> OfficialTruth | None:
        """Return the official files of a scan of DTU."""
        return find_official("dtu", capture, ground_truth, notify)

    def score(
        self, mesh: Mesh, truth: OfficialTruth, scene: Scene, *, folder: Path, thresholds: tuple[float, ...]
    ) -> dict[str, Any]:
        """Compare by the official evaluation."""
        make_folder(folder)
        scan = read_dtu_truth(truth.info.scan or 0, truth.files)
        score = evaluate_dtu(mesh, _silhouettes(scene), scene.T_metric_scene, scan)
        return {
            "unit": "mm",
            "ground_truth": str(truth.files["scan"]),
            "f_score": None,
            **{name: value for name, value in vars(score).items() if name not in ("clouds", "ok", "messages")},
            "thresholds": [],
            "self_check": {"ok": score.ok, "messages": list(score.messages)},
            "protocol": asdict(DTU_SURFACE),
            "files": _written(folder, write_clouds(folder, score.clouds)),
        }


@register_evaluator("tnt")
class TanksAndTemplesEvaluator:
    """Precision, recall and F-score of Tanks and Temples at the scene's tau."""

    has_thresholds = False

    def find(self, capture: Path, ground_truth: Path | None, notify: Notify) -> OfficialTruth | None:
        """Return the official files of a scene of Tanks and Temples."""
        return find_official("tnt", capture, ground_truth, notify)

    def score(
        self, mesh: Mesh, truth: OfficialTruth, scene: Scene, *, folder: Path, thresholds: tuple[float, ...]
    ) -> dict[str, Any]:
        """Compare by the official evaluation."""
        name, tau = truth.info.name, truth.info.tau
        if tau is None:
            raise DataError(f"a tau was expected for {name}, its data set names none")
        make_folder(folder)
        log = None if scene.root is None else published_log(scene.root, name)
        score = evaluate_tnt(
            mesh,
            [view.name for view in scene.views],
            np.stack([view.camera.center for view in scene.views]),
            read_tnt_truth(name, truth.files),
            tau,
            published=read_trajectory(log) if log is not None and log.is_file() and log.stat().st_size else None,
        )
        row = {"threshold": score.tau, "precision": score.precision, "recall": score.recall, "f_score": score.f_score}
        return {
            "unit": "m",
            "ground_truth": str(truth.files["scan"]),
            "threshold": score.tau,
            **{name: value for name, value in vars(score).items() if name not in ("clouds", "tau", "alignment")},
            "thresholds": [row],
            "self_check": _alignment(score.alignment),
            "protocol": asdict(TNT_SURFACE),
            "files": _written(folder, write_clouds(folder, score.clouds)),
        }


def _silhouettes(scene: Scene) -> list[ViewSilhouette]:
    """Return the mask files at full size, else the silhouettes of the views."""
    files = dtu_silhouettes(scene.root) if scene.root is not None else ()
    if files:
        return [ViewSilhouette(view.camera, read_mask(view.path)) for view in files]
    own = [(view.camera, view.object_mask()) for view in scene.train]
    return [ViewSilhouette(camera, mask) for camera, mask in own if mask is not None]


def _alignment(alignment: Alignment) -> dict[str, Any]:
    more = {"messages": list(alignment.messages), "stages": list(alignment.stages)}
    return vars(alignment) | more | {"T_truth_mesh": alignment.T_truth_mesh.tolist()}


def _written(folder: Path, names: Mapping[str, str]) -> dict[str, str]:
    """Return names relative to the run."""
    return {what: f"{folder.name}/{name}" for what, name in names.items()}
