"""The DTU score: distances worked by hand, in millimetres, over what the scanner observed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial import cKDTree

from gs2d.contrib.lab import evaluate_dtu as dtu
from gs2d.contrib.lab.dataset_folders import dtu_truth_files
from gs2d.contrib.lab.evaluate_dtu import (
    DtuTruth,
    ViewSilhouette,
    evaluate_dtu,
    inside_silhouettes,
    read_dtu_truth,
    thin,
)
from gs2d.contrib.lab.surface_protocols import DTU_SURFACE
from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.io.ply_format import write_ply
from oracle_scenes import grid_mesh, similarity

T_MM = similarity(10.0, np.eye(3), (100, 0, 0))  # the scene's unit is 10 mm


def flat(height: float, half: float = 1.0, cells: int = 20) -> Mesh:
    """A square in the scene's frame: 20 mm wide."""
    return Mesh(*grid_mesh(cells, half, lambda x, y: np.full_like(x, height)))


def flat_truth(**changes: object) -> DtuTruth:
    """A scan of the square every 0.25 mm, all of it observed, the table at -5 mm."""
    line = np.linspace(-10, 10, 81)
    x, y = np.meshgrid(line, line)
    points = np.column_stack([x.ravel() + 100, y.ravel(), np.zeros(x.size)])
    bounds = np.array([[88.0, -12, -12], [112, 12, 12]])
    truth = DtuTruth(24, points, np.ones((13, 13, 13), bool), bounds, 2.0, np.array([0.0, 0, 1, 5]))
    return replace(truth, **changes)


def test_parallel_squares_have_their_distance_in_millimetres() -> None:
    """0.1 scene units are 1 mm. The nearest of the scan's points is at most 0.25 / sqrt(2) = 0.18 aside: 1 to 1.016."""
    score = evaluate_dtu(flat(0.1), (), T_MM, flat_truth())
    assert score.accuracy == pytest.approx(1.005, abs=0.011)
    assert score.completeness == pytest.approx(1.005, abs=0.011)
    assert score.chamfer == pytest.approx((score.accuracy + score.completeness) / 2)
    assert (score.ok, score.messages, score.reason) == (True, (), None)
    assert score.truth_points == 81 * 81


def test_points_on_a_sphere_inside_a_sphere_are_at_the_difference_of_the_radii() -> None:
    """Radius 11 against 10 mm: 1 mm both ways; the scan has 20 000 points, about 0.25 mm apart."""
    i = np.arange(20_000) + 0.5
    z, a = 1 - 2 * i / 20_000, np.pi * (1 + 5**0.5) * i
    sphere = np.column_stack([np.cos(a) * np.sqrt(1 - z**2), np.sin(a) * np.sqrt(1 - z**2), z])
    truth = flat_truth(points=10 * sphere + (100, 0, 0), plane=np.array([0.0, 0, 0, 1]))
    vertices, faces = sphere_mesh(40)
    score = evaluate_dtu(Mesh(1.1 * vertices, faces), (), T_MM, truth)
    assert score.accuracy == pytest.approx(1.0, abs=0.02)
    assert score.completeness == pytest.approx(1.0, abs=0.02)


def sphere_mesh(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere of squares on a cube, pushed out."""
    line = np.tan(np.linspace(-np.pi / 4, np.pi / 4, steps + 1))
    vertices, faces, start = [], [], 0
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = (a.ravel() for a in np.meshgrid(line, line))
            corner = np.insert(np.column_stack([u, v]), axis, sign, axis=1)
            vertices.append(corner / np.linalg.norm(corner, axis=1, keepdims=True))
            i = (np.arange(steps)[:, None] * (steps + 1) + np.arange(steps)).ravel() + start
            a, b, c, d = i, i + 1, i + steps + 2, i + steps + 1
            faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
            start += len(corner)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def test_distances_of_twenty_millimetres_and_more_are_dropped() -> None:
    """Half of the reconstruction is on the scan, half 30 mm above it (inside the widened box, which ends at 132)."""
    both = flat(0.0), flat(3.0)
    faces = np.concatenate([both[0].faces, both[1].faces + len(both[0].vertices)])
    merged = Mesh(np.concatenate([m.vertices for m in both]), faces)
    truth = flat_truth(observed=np.ones((13, 13, 40), bool))
    score = evaluate_dtu(merged, (), T_MM, truth)
    assert score.dropped_mesh == pytest.approx(0.5, abs=0.01)
    assert score.accuracy == pytest.approx(0.1, abs=0.06)
    assert score.ok


def test_only_observed_cells_count_for_accuracy_and_only_points_above_the_plane_for_completeness() -> None:
    observed = np.ones((13, 13, 13), bool)
    observed[:7] = False  # cells with centres at x = 88, 90 ... 100: nearest cell below 101
    score = evaluate_dtu(flat(0.1), (), T_MM, flat_truth(observed=observed))
    assert score.clouds.mesh[:, 0].min() >= 101
    assert score.completeness == pytest.approx(1.005, abs=0.011)  # to all points in the box, observed or not
    left = evaluate_dtu(flat(0.1), (), T_MM, flat_truth(plane=np.array([-1.0, 0, 0, 100])))  # x < 100 is above
    assert left.clouds.truth[:, 0].max() < 100


def test_the_reconstruction_ends_at_the_widened_box() -> None:
    """Box from 88 to 112, widened by 1 and 2 mm: a scanned point at x = 120 is 6 mm from what is left at 114."""
    truth = flat_truth(points=np.concatenate([flat_truth().points, [[120.0, 0, 0], [80.0, 0, 0]]]))
    narrow = replace(DTU_SURFACE, margin_low=1.0, margin_high=2.0)
    score = evaluate_dtu(flat(0.0, half=3.0), (), T_MM, truth, protocol=narrow)
    np.testing.assert_allclose(score.clouds.truth_distances[-2:], [6, 7], atol=0.3)
    assert score.clouds.truth_distances[:-2].max() < 0.3
    assert (DTU_SURFACE.margin_low, DTU_SURFACE.margin_high) == (60, 120)


def test_a_mesh_in_another_place_says_so_instead_of_scoring_well() -> None:
    score = evaluate_dtu(flat(0.0), (), similarity(10.0, np.eye(3), (100, 0, 11)), flat_truth())
    assert score.ok
    far = evaluate_dtu(flat(0.0), (), similarity(10.0, np.eye(3), (1000, 0, 0)), flat_truth())
    assert (far.chamfer, far.ok) == (None, False)
    assert "scale_mat" in far.messages[0]
    high = flat_truth(observed=np.ones((13, 13, 40), bool))
    above = evaluate_dtu(flat(0.0), (), similarity(10.0, np.eye(3), (100, 0, 40)), high)
    assert (above.chamfer, above.ok) == (None, False)
    assert "0% of the mesh lies within 20 mm" in above.messages[0]
    with pytest.raises(DataError, match="T_metric_scene must be a rotation"):
        evaluate_dtu(flat(0.0), (), np.diag([1.0, 2, 1, 1]), flat_truth())


# points


@pytest.mark.parametrize("slab_size", [50, 400, 10_000])
@pytest.mark.parametrize("flatten", [(1, 1, 1), (1, 0, 1), (0, 1, 1)])
def test_thinning_keeps_points_apart_and_leaves_no_gap(slab_size: int, flatten: tuple[int, int, int]) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (3000, 3)) * flatten
    kept = thin(points, 0.05, slab_size=slab_size)
    assert len(cKDTree(kept).query_pairs(0.05)) == 0
    assert cKDTree(kept).query(points)[0].max() <= 0.05
    np.testing.assert_array_equal(kept, thin(points, 0.05, slab_size=slab_size))


# culling


def views(width: int = 160) -> list[ViewSilhouette]:
    """Three cameras that see [-1, 1]^2 as 80 of 160 pixels; the silhouette is its left half."""
    out = []
    for shift in (-0.05, 0.0, 0.05):
        eye = np.array([0.0, shift, 4.0])
        camera = look_at(eye, np.array([0, shift, 0.0]), np.array([0, 1.0, 0]), width=160, height=160, fx=160)
        mask = np.zeros((width, width), bool)
        mask[:, : width // 2] = True
        out.append(ViewSilhouette(camera, mask))
    return out


@pytest.mark.parametrize("width", [160, 320])
def test_vertices_outside_a_widened_silhouette_go_and_those_outside_the_image_stay(width: int) -> None:
    """24 px of 1600 are 2.4 of 160: columns 80 and 81, x below 0.05 (40 px a unit).

    Beside the image and behind the camera: kept.
    """
    points = np.array([[-0.5, 0, 0], [0.04, 0, 0], [0.06, 0, 0], [0.5, 0, 0], [9, 0, 0], [0.5, 0, 9]])
    assert inside_silhouettes(points, views(width)).tolist() == [True, True, False, False, True, True]
    nothing = [ViewSilhouette(views()[0].camera, np.zeros((160, 160), bool))]
    assert inside_silhouettes(points[:2], nothing).tolist() == [False, False]


# files


def write_truth(folder: Path, scan: int = 24) -> dict[str, Path]:
    """The three files of a scan in the real formats."""
    truth = flat_truth()
    files = {name: folder / path for name, path in dtu_truth_files(scan).items()}
    for path in files.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.zeros(len(truth.points), [(c, "<f4") for c in "xyz"] + [("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for i in range(3):
        rows["xyz"[i]] = truth.points[:, i]
    write_ply(files["scan"], {"vertex": rows})
    savemat(files["mask"], {"ObsMask": truth.observed.astype(np.uint8), "BB": truth.bounds, "Res": np.array([[2.0]])})
    savemat(files["plane"], {"P": truth.plane[:, None]})
    return files


def test_the_official_files_are_read(tmp_path: Path) -> None:
    files = write_truth(tmp_path, 7)
    assert files["scan"].name == "stl007_total.ply"
    truth = read_dtu_truth(7, files)
    expected = flat_truth()
    np.testing.assert_allclose(truth.points, expected.points, atol=1e-5)
    np.testing.assert_array_equal(truth.observed, expected.observed)
    np.testing.assert_array_equal(truth.bounds, expected.bounds)
    np.testing.assert_array_equal(truth.plane, expected.plane)
    assert truth.resolution == 2.0
    assert len(truth.above_plane()) == len(truth.points)


@pytest.mark.parametrize("name", ["scan", "mask", "plane"])
def test_a_missing_or_broken_official_file_is_named(tmp_path: Path, name: str) -> None:
    files = write_truth(tmp_path)
    whole = files[name].read_bytes()
    files[name].write_bytes(whole[:60])
    with pytest.raises(DataError, match=files[name].name):
        read_dtu_truth(24, files)
    files[name].unlink()
    with pytest.raises(DataError, match=files[name].name):
        read_dtu_truth(24, files)


def test_a_matlab_file_with_too_many_values_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is lowered here: compressing 600 million zeros takes seconds."""
    assert "1 << 29" in dtu._MATLAB
    monkeypatch.setattr(dtu, "_MATLAB", dtu._MATLAB.replace("1 << 29", "1 << 16"))
    files = write_truth(tmp_path)
    savemat(files["plane"], {"P": np.zeros((300, 300), np.uint8)}, do_compression=True)
    with pytest.raises(DataError, match=r"Plane24\.mat must be a MATLAB 5 file, got: .*million"):
        read_dtu_truth(24, files)
