"""The flown capture: what its files say of each other, and that it may be of any size."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from benchmarks.flight import PIXEL_NOISE, Flight, flown_cameras, write_flight

from gs2d.data import load_scene
from gs2d.data.image_files import read_image
from gs2d.data.readers.colmap import read_images, read_points
from gs2d.io.meshes import read_mesh
from gs2d.meshing.raycast import cast_camera

FLIGHT = Flight(10, width=64, height=48, points=8000, seed=3, gps_noise=0.0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "capture"
    write_flight(folder, FLIGHT, threads=1)
    return folder


def test_a_flown_capture_is_read_as_a_colmap_one_with_its_cameras(capture: Path) -> None:
    scene = load_scene(capture, test_every=0)
    assert scene.format == "colmap"
    assert [view.name for view in scene.train] == [f"{k:06d}.jpg" for k in range(10)]
    for view, camera in zip(scene.train, flown_cameras(FLIGHT), strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-9)
        assert (view.camera.fx, view.camera.cx, view.camera.width) == (camera.fx, 32.0, 64)
        assert view.image().shape == (48, 64, 3)


def test_sparse_points_lie_where_the_true_surface_is_and_are_seen_where_they_project_to(capture: Path) -> None:
    mesh = read_mesh(capture / "mesh_gt.ply")
    points = read_points(capture / "sparse/0", "bin")
    assert points is not None
    assert len(points.ids) > 300
    place = dict(zip(points.ids.tolist(), points.xyz, strict=True))
    misses, seen = [], dict.fromkeys(place, 0)
    for image, camera in zip(
        read_images(capture / "sparse/0", "bin", observations=True), flown_cameras(FLIGHT), strict=True
    ):
        assert image.point_ids is not None
        assert image.observations is not None
        assert len(image.point_ids) > 20
        at, depth = camera.project(np.array([place[number] for number in image.point_ids.tolist()]))
        misses.append(image.observations - at)
        hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, camera, samples=4)
        column, row = np.minimum((at * 4).astype(int), (255, 191)).T
        assert np.median(np.abs(hits.depth[row, column] - depth)) < 0.15  # m; a pixel is 1.4 m wide
        for number in image.point_ids.tolist():
            seen[number] += 1
    assert np.concatenate(misses).std() == pytest.approx(PIXEL_NOISE, rel=0.1)
    assert min(seen.values()) >= 3


def test_no_photograph_looks_beyond_the_land_and_neighbours_show_the_same(capture: Path) -> None:
    mesh = read_mesh(capture / "mesh_gt.ply")
    cameras = flown_cameras(FLIGHT)
    first = read_image(capture / "images/000000.jpg").astype(float)
    for camera in cameras:
        hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, camera)
        assert (hits.face >= 0).all()
    hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, cameras[1])
    rows, columns = np.indices(hits.depth.shape)
    rays = np.stack([(columns + 0.5 - 32) / cameras[1].fx, (rows + 0.5 - 24) / cameras[1].fy, np.ones(rows.shape)], -1)
    world = (rays * hits.depth[..., None] - cameras[1].T_cam_world[:3, 3]) @ cameras[1].rotation
    at, _ = cameras[0].project(world.reshape(-1, 3))
    both = (at >= 1).all(axis=1) & (at < (63, 47)).all(axis=1)
    assert both.mean() > 0.6
    there, here = read_image(capture / "images/000001.jpg").astype(float).reshape(-1, 3)[both], at[both].astype(int)
    same = np.abs(first[here[:, 1], here[:, 0]] - there).mean()
    other = np.abs(first[here[:, 1], 63 - here[:, 0]] - there).mean()
    assert same < 0.6 * other  # the wrong places of the same picture


def test_the_bytes_of_a_flown_capture_do_not_depend_on_the_threads(capture: Path, tmp_path: Path) -> None:
    write_flight(tmp_path, FLIGHT, threads=3)

    def digests(folder: Path) -> dict[str, str]:
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}

    assert digests(tmp_path) == digests(capture)
    assert len(digests(capture)) == 10 + 3 + 1


def test_the_same_land_may_be_flown_over_with_any_number_of_photographs() -> None:
    for count in (60, 960):
        places = np.array([camera.center for camera in flown_cameras(Flight(count, side=300.0))])
        assert np.ptp(places[:, :2], axis=0) == pytest.approx([270, 270], rel=0.15)
    grown = [np.ptp([c.center[0] for c in flown_cameras(Flight(count))]) for count in (60, 960)]
    assert grown[1] / grown[0] == pytest.approx(4, rel=0.15)
