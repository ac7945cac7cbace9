"""The Tanks and Temples score: distances worked by hand, known transforms found, wrong frames reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.contrib.lab.evaluate_tnt import CropVolume, TntScore, TntTruth, box, evaluate_tnt, f_score
from gs2d.contrib.lab.surface_protocols import TNT_SURFACE
from gs2d.core.mesh import Mesh
from oracle_scenes import TAU, TntScene, grid_mesh, moved, similarity, tnt_scene

NAMES = [f"{i + 1:06d}.jpg" for i in range(60)]
NO_ICP = replace(TNT_SURFACE, stages=(replace(TNT_SURFACE.stages[0], iterations=0),))


def truth_of(scene: TntScene, name: str = "Truck") -> TntTruth:
    polygon = np.array(scene.crop["bounding_polygon"])[:, :2]
    crop = CropVolume(2, scene.crop["axis_min"], scene.crop["axis_max"], polygon)
    return TntTruth(name, scene.scan, crop, scene.T_truth_log, scene.log)


def score(scene: TntScene, **changes: object) -> TntScore:
    """The scene with something else about its truth, or with a published log."""
    published = changes.pop("published", None)
    truth = replace(truth_of(scene), **changes)
    return evaluate_tnt(Mesh(scene.vertices, scene.faces), NAMES, scene.centers, truth, TAU, published=published)


@pytest.fixture(scope="module")
def elsewhere() -> tuple[TntScene, TntScore]:
    """A capture in another frame than the log, as Truck of TNT_GOF, scored."""
    scene = tnt_scene(0)
    return scene, score(scene)


@pytest.fixture(scope="module")
def in_place() -> tuple[TntScene, TntScore]:
    """A capture in the frame of the log, scored."""
    scene = tnt_scene(0, T_log_capture=np.eye(4))
    return scene, score(scene)


def plane_scene(height: float, *, half: float = 1.0) -> tuple[Mesh, TntTruth, np.ndarray]:
    """A mesh at z = height over a scan at z = 0, in one frame; cameras above. Points every 0.02 on both."""
    vertices, faces = grid_mesh(100, 1.0, lambda x, y: np.full_like(x, height))
    keep = (np.abs(vertices[faces][:, :, :2]) <= half + 1e-9).all(axis=(1, 2))
    used, index = np.unique(faces[keep], return_inverse=True)
    scan, _ = grid_mesh(100, 1.0, lambda x, y: np.zeros_like(x))
    centers = np.random.default_rng(0).uniform(-2, 2, (60, 3)) + np.array([0, 0, 3])
    log = np.tile(np.eye(4), (60, 1, 1))
    log[:, :3, 3] = centers
    crop = box(np.array([-2, -2, -1.0]), np.array([2, 2, 1.0]))
    mesh = Mesh(vertices[used], index.reshape(-1, 3).astype(np.int32))
    return mesh, TntTruth("Barn", scan, crop, np.eye(4), log), centers


@pytest.mark.parametrize(("height", "score"), [(0.03, 1.0), (0.06, 0.0)])
def test_a_plane_above_a_plane_is_right_up_to_tau(height: float, score: float) -> None:
    """tau 0.05: at 0.03 every point is within it (neighbours at most 0.03 aside after thinning), at 0.06 none."""
    mesh, truth, centers = plane_scene(height)
    got = evaluate_tnt(mesh, NAMES, centers, truth, 0.05, protocol=NO_ICP)
    assert (got.precision, got.recall, got.f_score) == (score, score, score)
    assert got.accuracy == pytest.approx(height, abs=0.005)
    np.testing.assert_allclose(got.alignment.T_truth_mesh, np.eye(4), atol=1e-9)


def test_a_quarter_of_a_plane_has_full_precision_and_a_quarter_of_recall() -> None:
    mesh, truth, centers = plane_scene(0.0, half=0.5)
    got = evaluate_tnt(mesh, NAMES, centers, truth, 0.01, protocol=NO_ICP)
    assert got.precision == 1
    assert got.recall == pytest.approx(0.25, abs=0.02)  # and a rim of tau
    assert got.f_score == pytest.approx(f_score(1, got.recall))
    assert f_score(0.5, 0.25) == pytest.approx(1 / 3)  # 2 * 0.125 / 0.75
    assert f_score(0, 0) == 0


def test_the_stages_pull_a_displaced_plane_onto_the_scan() -> None:
    mesh, truth, centers = plane_scene(0.06)
    got = evaluate_tnt(mesh, NAMES, centers, truth, 0.05)
    assert got.f_score == 1
    assert got.alignment.shift == pytest.approx(0.06 / 0.05, rel=0.01)  # in tau


def test_what_lies_outside_the_crop_volume_does_not_count() -> None:
    mesh, truth, centers = plane_scene(0.0)
    left = replace(truth, crop=box(np.array([-2, -2, -1.0]), np.array([0, 2, 1.0])))
    got = evaluate_tnt(mesh, NAMES, centers, left, 0.05)
    assert got.clouds.mesh[:, 0].max() <= 0
    assert got.clouds.truth[:, 0].max() <= 0
    nothing = replace(truth, T_truth_log=similarity(1, np.eye(3), (0, 0, 9)))
    lost = evaluate_tnt(mesh, NAMES, centers, nothing, 0.05)
    assert (lost.precision, lost.recall, lost.f_score) == (None, 0, 0)
    assert lost.reason == "no part of the mesh lies inside the crop volume"
    assert not lost.alignment.ok
    assert "0% of the mesh lies within 80 tau" in lost.alignment.messages[0]


def test_the_score_does_not_depend_on_the_capture_s_frame(
    elsewhere: tuple[TntScene, TntScore], in_place: tuple[TntScene, TntScore]
) -> None:
    assert elsewhere[1].f_score == pytest.approx(in_place[1].f_score, abs=2e-3)
    for scene, got in (elsewhere, in_place):
        assert got.alignment.ok
        # to 3 tau of where it belongs: the log itself is 1 % too large and centimetres aside
        error = moved(got.alignment.T_truth_mesh, scene.vertices) - moved(scene.T_truth_capture, scene.vertices)
        assert np.linalg.norm(error, axis=1).max() < 3 * TAU


def test_a_capture_in_another_frame_than_the_log_is_told_in_one_line_and_scored_all_the_same(
    elsewhere: tuple[TntScene, TntScore], in_place: tuple[TntScene, TntScore]
) -> None:
    """Truck of TNT_GOF: _trans.txt alone would misplace it."""
    (line,) = elsewhere[1].alignment.messages
    assert line.startswith("the capture is not in the frame of Truck_COLMAP_SfM.log")
    assert "\n" not in line
    assert in_place[1].alignment.messages == ()


def test_a_log_that_does_not_belong_to_the_transform_is_caught(elsewhere: tuple[TntScene, TntScore]) -> None:
    """The log of the other frame in the place of the official one: cameras fit it, the surface lands elsewhere."""
    scene = elsewhere[0]
    wrong = scene.log.copy()
    wrong[:, :3, 3] = scene.centers  # the capture's own frame, which _trans.txt does not start from
    got = score(scene, trajectory=wrong)
    assert not got.alignment.ok
    assert got.alignment.camera_fraction == 1
    (line,) = got.alignment.messages
    assert "the cameras fit Truck_COLMAP_SfM.log, the surface does not fit the scan" in line
    assert "TNT_GOF has a log of the same name" in line
    assert got.f_score < 0.1


# coloured clouds
