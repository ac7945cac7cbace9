"""A run's mesh against the official ground truth found on disk: what ``gs2d evaluate`` writes into ``metrics.json``."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from gs2d.contrib.lab.surface_score import evaluate_surface
from gs2d.core.mesh import Mesh
from gs2d.data import load_scene
from gs2d.errors import DataError
from gs2d.evaluation.evaluators import GENERAL, choose_truth, score_surface
from gs2d.io.meshes import read_points, write_mesh
from official_captures import T_MM, write_dtu_capture, write_points, write_tnt_capture
from oracle_scenes import grid_mesh, moved

FIGURES = json.loads((Path(__file__).resolve().parents[2] / "helpers" / "oracle_open3d.json").read_text())
HEADLINE = {"evaluator", "unit", "f_score", "chamfer", "accuracy", "completeness", "mesh_points", "truth_points",
            "reason", "thresholds", "self_check", "protocol", "ground_truth", "files"}  # fmt: skip


def ignore(text: str) -> None:
    pass


def scored(mesh: Mesh, root: Path, folder: Path, given: Path | None = None, **options: Any) -> tuple[dict, list[str]]:
    """The surface entry and what the user was told."""
    heard: list[str] = []
    truth = choose_truth(given, root, heard.append)
    assert truth is not None
    result = score_surface(mesh, truth, load_scene(root), folder=folder, notify=heard.append, **options)
    assert set(result) >= HEADLINE
    assert set(result["self_check"]) >= {"ok", "messages"}
    json.dumps(result, allow_nan=False)  # what metrics.json can hold
    return result, heard


@pytest.mark.parametrize("where", ["beside", "parent", "own"])
def test_a_scene_of_tanks_and_temples_is_scored_by_its_protocol(tmp_path: Path, where: str) -> None:
    """Truck's tau is 5 mm; the official files are found beside the capture, or in the folder that is given."""
    root, truth, scene = write_tnt_capture(tmp_path)
    given = {"beside": None, "parent": truth.parent, "own": truth}[where]
    result, told = scored(Mesh(scene.vertices, scene.faces), root, tmp_path / "surface", given)
    assert (result["evaluator"], result["unit"], result["threshold"]) == ("tnt", "m", 0.005)
    assert result["thresholds"] == [
        {"threshold": 0.005, "precision": result["precision"], "recall": result["recall"], "f_score": result["f_score"]}
    ]
    assert 0 < result["f_score"] < 0.3  # waves of 60 mm
    check = result["self_check"]
    assert check["ok"]
    assert check["camera_fraction"] == 1
    assert len(check["stages"]) == 3
    assert result["protocol"]["camera_threshold"] == 0.2
    assert result["ground_truth"] == str(truth / "Truck.ply")
    assert told == check["messages"]
    assert told[0].startswith("the capture is not in the frame of Truck_COLMAP_SfM.log")
    for name in result["files"].values():
        assert (tmp_path / name).is_file()
    assert len(read_points(tmp_path / result["files"]["precision_cloud"]).points) == result["mesh_points"]


def test_a_scan_of_dtu_is_scored_in_millimetres(tmp_path: Path) -> None:
    """The mesh in the scene's frame, 12 mm to a unit, scores as the same mesh in millimetres did in the oracle."""
    root, official, scene = write_dtu_capture(tmp_path)
    mesh = Mesh(moved(np.linalg.inv(T_MM), scene.vertices + T_MM[:3, 3]), scene.faces)
    write_points(official / "Points/stl/stl024_total.ply", scene.scan + T_MM[:3, 3])
    bounds = scene.bounds + T_MM[:3, 3]
    savemat(official / "ObsMask/ObsMask24_10.mat", {"ObsMask": scene.observed, "BB": bounds, "Res": 2.0})
    result, told = scored(mesh, root, tmp_path / "surface", thresholds=(0.1,))
    assert (result["evaluator"], result["unit"], result["f_score"]) == ("dtu", "mm", None)
    figures = FIGURES["dtu"][0]
    for name in ("chamfer", "accuracy", "completeness"):
        assert result[name] == pytest.approx(figures[name], rel=0.02), name
    assert result["self_check"] == {"ok": True, "messages": []}
    assert result["protocol"]["max_distance"] == 20
    assert told == ["--set thresholds is ignored: the evaluator dtu has its own protocol"]
    assert (tmp_path / "surface/surface.png").is_file()


def test_an_official_ground_truth_that_is_not_whole_is_named_file_by_file(tmp_path: Path) -> None:
    root, official, _ = write_dtu_capture(tmp_path)
    (official / "ObsMask/Plane24.mat").unlink()
    heard: list[str] = []
    assert choose_truth(None, root, heard.append) is None
    (line,) = heard
    assert "Plane24.mat is missing (to score the surface): get it from the archive SampleSet" in line
    with pytest.raises(DataError, match=r"must hold the ground truth of scan24 \(DTU\): .*Plane24.mat is missing"):
        choose_truth(official, root, ignore)
    with pytest.raises(DataError, match=r"stl024_total.ply is missing .*; .*ObsMask24_10.mat is missing .*; "):
        choose_truth(tmp_path / "DTU", root, ignore)


def test_a_capture_of_nobody_s_data_set_takes_the_mesh_beside_it(tmp_path: Path) -> None:
    root, _, scene = write_tnt_capture(tmp_path, "Shed")
    assert choose_truth(None, root, ignore) is None
    vertices, faces = grid_mesh(10, 1.0, lambda x, y: 0 * x)
    write_mesh(root / "mesh_gt.ply", Mesh(vertices, faces))
    heard: list[str] = []
    truth = choose_truth(None, root, heard.append)
    assert truth is not None
    assert truth.name == GENERAL
    assert heard == [f"ground truth: {root / 'mesh_gt.ply'}"]
    with pytest.raises(DataError, match="got neither for the capture Shed; use a PLY or OBJ file"):
        choose_truth(tmp_path / "GT", root, ignore)
    assert len(scene.centers) == 60


def flat(height: float) -> Mesh:
    vertices, faces = grid_mesh(20, 1.0, lambda x, y: np.full_like(x, height))
    return Mesh(vertices, faces)


def test_the_visible_surface_has_its_headline_at_a_quarter_of_a_per_cent_of_the_true_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Squares of 2 x 2: diagonal 2.83, thresholds 0.0071, 0.0141, 0.0283; 0.01 apart is between the first two."""
    root, _, _ = write_tnt_capture(tmp_path, "Shed")
    monkeypatch.setattr("gs2d.contrib.lab.visible_surface.evaluate_surface", partial(evaluate_surface, samples=4000))
    write_mesh(root / "mesh_gt.ply", flat(0.0))
    np.save(root / "mesh_gt_seen.npy", np.full(800, 9))
    truth = choose_truth(None, root, ignore)
    assert truth is not None
    assert truth.name == GENERAL
    scene: Any = SimpleNamespace(train=(), T_metric_scene=np.eye(4))
    result = score_surface(flat(0.01), truth, scene, folder=tmp_path, notify=ignore)
    assert set(result) >= HEADLINE
    assert result["evaluator"] == "visible-surface"
    assert [row["f_score"] for row in result["thresholds"]] == [0, 1, 1]
    assert result["threshold"] == pytest.approx(0.0025 * math.sqrt(8))
    assert (result["precision"], result["recall"], result["f_score"]) == (0, 0, 0)
    assert result["chamfer"] == pytest.approx(0.01, rel=1e-3)
    assert result["self_check"] == {"ok": True, "messages": []}
    assert len(read_points(tmp_path / "recall.ply").points) == result["truth_points"]
    assert result["files"]["picture"].endswith("/surface.png")
    far: list[str] = []
    elsewhere = score_surface(flat(0.5), truth, scene, folder=tmp_path, notify=far.append)
    assert not elsewhere["self_check"]["ok"]
    assert "check its coordinate system" in far[-1]
