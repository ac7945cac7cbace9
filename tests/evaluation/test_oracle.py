"""Our evaluators against Open3D 0.19 on seeded scenes: ``scripts/oracle_open3d.py`` made ``oracle_open3d.json``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gs2d.contrib.lab.alignment import ransac_similarity
from gs2d.contrib.lab.evaluate_dtu import DtuTruth, evaluate_dtu, mesh_points
from gs2d.contrib.lab.evaluate_tnt import CropVolume, TntTruth, evaluate_tnt
from gs2d.core.mesh import Mesh
from gs2d.core.similarity import umeyama
from oracle_scenes import OBSERVED_RESOLUTION, TAU, dtu_scene, moved, tnt_scene

FIGURES = json.loads((Path(__file__).resolve().parents[1] / "helpers" / "oracle_open3d.json").read_text())
NAMES = [f"{i + 1:06d}.jpg" for i in range(60)]


def test_reference_values_belong_to_these_scenes() -> None:
    assert FIGURES["open3d"] == "0.19.0"
    assert FIGURES["tau"] == TAU


@pytest.mark.parametrize("figures", FIGURES["tnt"], ids=lambda f: f"seed{f['seed']}")
def test_f_score_and_alignment_equal_open3d(figures: dict) -> None:
    """Same steps, same criteria: shares and transforms to rounding, so not one point falls on another side of tau."""
    scene = tnt_scene(figures["seed"])
    polygon = np.array(scene.crop["bounding_polygon"])[:, :2]
    crop = CropVolume(2, scene.crop["axis_min"], scene.crop["axis_max"], polygon)
    truth = TntTruth("Barn", scene.scan, crop, scene.T_truth_log, scene.log)
    score = evaluate_tnt(Mesh(scene.vertices, scene.faces), NAMES, scene.centers, truth, TAU)
    for ours, theirs in zip(score.alignment.stages, figures["stages"], strict=True):
        assert ours["points"] == theirs["points"]
        assert ours["fraction_before"] == pytest.approx(theirs["share_before"], abs=1e-12)
        assert ours["fraction"] == pytest.approx(theirs["share"], abs=1e-12)
        assert ours["rms_before"] == pytest.approx(theirs["rms_before"], rel=1e-9)
        assert ours["rms"] == pytest.approx(theirs["rms"], rel=1e-9)
    np.testing.assert_allclose(score.alignment.T_truth_mesh, figures["stages"][-1]["T"], atol=1e-10)
    assert (score.mesh_points, score.truth_points) == (figures["mesh_points"], figures["truth_points"])
    for name in ("precision", "recall", "f_score", "accuracy", "completeness"):
        assert getattr(score, name) == pytest.approx(figures[name], rel=1e-9), name
    assert 0.5 < score.f_score < 0.8  # neither all nor nothing: the figures tell one evaluator from another


@pytest.mark.parametrize("figures", FIGURES["tnt"], ids=lambda f: f"seed{f['seed']}")
def test_alignment_of_camera_centres_equals_open3d(figures: dict) -> None:
    """All pairs: the same matrix. By RANSAC: Open3D keeps the fit to a random sample of six, so to the log's noise."""
    scene = tnt_scene(figures["seed"])
    targets = moved(scene.T_truth_log, scene.log[:, :3, 3])
    np.testing.assert_allclose(umeyama(scene.centers, targets), figures["T_all_pairs"], atol=1e-12)
    fit = ransac_similarity(scene.centers, targets, threshold=0.2)
    gap = moved(fit.T_target_source, scene.centers) - moved(np.array(figures["T_cameras"]), scene.centers)
    assert np.linalg.norm(gap, axis=1).max() < 0.02  # m; the log has 5 mm of noise on each axis


@pytest.mark.parametrize("figures", FIGURES["dtu"], ids=lambda f: f"seed{f['seed']}")
def test_the_chamfer_distance_equals_the_reference_except_for_the_shuffle(figures: dict) -> None:
    """The same points on the mesh; the random thinning moves the score of this small scene by 0.6 % (one sigma)."""
    scene = dtu_scene(figures["seed"])
    mesh = Mesh(scene.vertices, scene.faces)
    assert len(mesh_points(mesh, 0.2)) == figures["sampled"]
    truth = DtuTruth(24, scene.scan, scene.observed.astype(bool), scene.bounds, OBSERVED_RESOLUTION, scene.plane)
    score = evaluate_dtu(mesh, (), np.eye(4), truth)
    assert score.mesh_points == pytest.approx(figures["observed"], rel=0.01)
    assert score.truth_points == figures["above"]
    for name in ("accuracy", "completeness", "chamfer"):
        assert getattr(score, name) == pytest.approx(figures[name], rel=0.02), name
