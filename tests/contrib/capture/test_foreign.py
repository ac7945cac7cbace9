"""Captures of OpenSfM (OpenDroneMap), Metashape and Meshroom, against the same cameras as a COLMAP model."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from foreign_writers import (
    BENT,
    CHUNK,
    HEIGHT,
    OFF_CENTRE,
    WIDTH,
    Lens,
    alicevision_scene,
    as_colmap,
    metashape_calibration,
    metashape_document,
    metashape_similarity,
    metashape_transform,
    poses,
    small_alicevision,
    small_metashape,
    small_opensfm,
    write_images,
    write_points,
)
from gs2d.data import Scene, detect_format, load_scene
from gs2d.data.camera_models import Lens as OurLens
from gs2d.errors import DataError

Writer = Callable[[Path, Lens], None]


def metashape_with_points(root: Path, lens: Lens) -> None:
    small_metashape(root, lens)
    write_points(root / "points.ply")


WRITERS: dict[str, Writer] = {
    "opensfm": small_opensfm,
    "metashape": metashape_with_points,
    "alicevision": small_alicevision,
}


def assert_same_scene(scene: Scene, same: Scene, *, atol: float = 1e-9) -> None:
    """Names, split, cameras, undistorted pictures with their masks, and points."""
    for views, expected in ((scene.train, same.train), (scene.test, same.test)):
        assert [v.name for v in views] == [v.name for v in expected]
        for view, other in zip(views, expected, strict=True):
            a, b = view.camera, other.camera
            np.testing.assert_allclose(a.T_cam_world, b.T_cam_world, atol=atol)
            np.testing.assert_allclose((a.fx, a.fy, a.cx, a.cy), (b.fx, b.fy, b.cx, b.cy), rtol=1e-12)
            differ = np.abs(view.image().astype(int) - other.image().astype(int))
            assert differ.max() <= 1  # a level: coordinates differ by rounding
            np.testing.assert_array_equal(view.mask() is None, other.mask() is None)
            if view.mask() is not None:
                np.testing.assert_array_equal(view.mask(), other.mask())
    np.testing.assert_allclose(scene.points.points, same.points.points, atol=1e-9)
    np.testing.assert_array_equal(scene.points.colors, same.points.colors)


@pytest.mark.parametrize("lens", [OFF_CENTRE, BENT], ids=["off-centre", "bent"])
@pytest.mark.parametrize("format", WRITERS)
def test_the_cameras_of_each_tool_equal_those_of_colmap(tmp_path: Path, format: str, lens: Lens) -> None:
    WRITERS[format](tmp_path / "theirs", lens)
    assert detect_format(tmp_path / "theirs") == format
    scene = load_scene(tmp_path / "theirs")
    assert (scene.format, scene.skipped) == (format, ())
    assert_same_scene(scene, load_scene(as_colmap(tmp_path / "colmap", lens)))


def test_opensfm_perspective_is_worked_by_hand(tmp_path: Path) -> None:
    """f 0.9 of the larger side 40 px; the middle of 40x30 is (20, 15) from the corner."""
    camera = {"projection_type": "perspective", "width": 40, "height": 30, "focal": 0.9, "k1": 0.0, "k2": 0.0}
    small_opensfm(tmp_path, camera=camera)
    c = load_scene(tmp_path).train[0].camera
    np.testing.assert_allclose((c.fx, c.fy, c.cx, c.cy), (36.0, 36.0, 20.0, 15.0), rtol=1e-14)


@pytest.mark.parametrize("upright", [False, True])
def test_the_unit_of_opensfm_is_the_larger_side(tmp_path: Path, upright: bool) -> None:
    size = (30, 40) if upright else (40, 30)
    camera = {"projection_type": "radial", "width": size[0], "height": size[1]}
    camera |= {"focal_x": 1.0, "focal_y": 1.1, "c_x": 0.05, "c_y": -0.1, "k1": 0.0, "k2": 0.0}
    small_opensfm(tmp_path, camera=camera)
    for path in (tmp_path / "images").iterdir():
        Image.new("RGB", size).save(path)
    c = load_scene(tmp_path).train[0].camera
    expected = (40.0, 44.0, size[0] / 2 + 2, size[1] / 2 - 4)
    np.testing.assert_allclose((c.fx, c.fy, c.cx, c.cy), expected, rtol=1e-14)


def test_each_projection_of_opensfm_becomes_its_lens(tmp_path: Path) -> None:
    from gs2d.contrib.capture.opensfm import _intrinsics

    def of(model: str, **keys: float) -> OurLens | None:
        camera = {"projection_type": model, "width": 40, "height": 30, "focal": 1, "focal_x": 1, "focal_y": 1, **keys}
        return _intrinsics(camera, tmp_path, "camera").lens

    assert of("perspective", k1=0.1, k2=0.2) == OurLens("perspective", (0.1, 0.2))
    assert of("perspective") is None
    assert of("simple_radial", k1=0.1) == OurLens("perspective", (0.1,))
    assert of("fisheye", k1=0.1, k2=0.2) == OurLens("fisheye", (0.1, 0.2))
    assert of("fisheye_opencv", k1=1, k2=2, k3=3, k4=4) == OurLens("fisheye", (1, 2, 3, 4))
    six = of("fisheye62", k1=1, k2=2, k3=3, k4=4, k5=5, k6=6, p1=7, p2=8)
    assert six == OurLens("fisheye", (1, 2, 3, 4, 5, 6), (), (7, 8))
    for model in ("dual", "fisheye624"):
        with pytest.raises(DataError, match=f"camera has the unsupported projection {model}"):
            of(model)


def test_a_geocentric_chunk_becomes_metres_east_north_and_up(tmp_path: Path) -> None:
    """The ring stands upright at 60 N, 0 E: there east is +y, north (-sin 60, 0, cos 60), up (cos 60, 0, sin 60)."""
    write_images(tmp_path / "images", poses())
    sine = math.sin(math.pi / 3)
    north, east, up = np.array([-sine, 0.0, 0.5]), np.array([0.0, 1.0, 0.0]), np.array([0.5, 0.0, sine])
    a, e2 = 6378137.0, 0.00669437999014
    N = a / math.sqrt(1 - e2 * 0.75)
    place = np.array([(N + 50) * 0.5, 0.0, (N * (1 - e2) + 50) * sine])
    # The cameras' world is the chunk's inside; its similarity puts it at that place.
    here = (1.0, np.stack([east, north, up], axis=1), place)
    same = (1.0, np.eye(3), np.zeros(3))
    cameras = "".join(
        f"<camera id='{i}' sensor_id='0' label='{name}'><transform>{metashape_transform(T, same)}</transform></camera>"
        for i, (name, T) in enumerate(poses().items())
    )
    text = metashape_document(metashape_calibration(OFF_CENTRE), cameras, transform=metashape_similarity(here))
    (tmp_path / "cameras.xml").write_text(text)
    scene = load_scene(tmp_path)
    assert "the chunk is geocentric: the scene is in metres east, north and up of the mean camera" in scene.notes
    middle = np.mean([-T[:3, :3].T @ T[:3, 3] for T in poses().values()], axis=0)
    for view in scene.views:
        T = poses()[view.name]
        np.testing.assert_allclose(view.camera.center, -T[:3, :3].T @ T[:3, 3] - middle, atol=1e-4)
        np.testing.assert_allclose(view.camera.rotation, T[:3, :3], atol=2e-5)


def test_affinity_and_skew_of_metashape_by_its_formulas(tmp_path: Path) -> None:
    """u = w/2 + cx + x' (f + b1) + y' b2 of points that the lens bends, in numbers of the manual."""
    from xml.etree import ElementTree

    from gs2d.contrib.capture.metashape import _intrinsics

    for kind in ("frame", "fisheye"):
        sensor = ElementTree.fromstring(
            "<sensor id='0' type='frame'>"
            + metashape_calibration(BENT, "<b2>1.5</b2><k4>0.01</k4>", kind)
            + "</sensor>"
        )
        k = _intrinsics(sensor, "sensor 0")
        x, y = 0.3, -0.2
        if kind == "fisheye":
            r0 = math.hypot(x, y)
            x, y = x * math.atan(r0) / r0, y * math.atan(r0) / r0
        r2 = x * x + y * y
        radial = 1 + BENT.k[0] * r2 + BENT.k[1] * r2**2 + BENT.k[2] * r2**3 + 0.01 * r2**4
        P1, P2 = BENT.p[1], BENT.p[0]
        xd = x * radial + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y
        yd = y * radial + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y
        f, b1 = BENT.fy, BENT.fx - BENT.fy
        u = WIDTH * 0.5 + (BENT.cx - WIDTH / 2) + xd * f + xd * b1 + yd * 1.5
        v = HEIGHT * 0.5 + (BENT.cy - HEIGHT / 2) + yd * f
        bent = k.lens.distort(np.array([0.3, -0.2]))
        np.testing.assert_allclose((bent[0] * k.fx + k.cx, bent[1] * k.fy + k.cy), (u, v), rtol=1e-12)


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 4), (1, 2, 5), (1, 2, 14)])
def test_every_version_of_alicevision_files_is_read(tmp_path: Path, version: tuple[int, int, int]) -> None:
    lens = BENT if version >= (1, 2, 0) else Lens(35.0, 35.0, 18.5, 16.25, (0.12, -0.05, 0.02))
    small_alicevision(tmp_path / "theirs", lens, version=version, name="sfm.json")
    assert_same_scene(load_scene(tmp_path / "theirs"), load_scene(as_colmap(tmp_path / "colmap", lens)))


@pytest.mark.parametrize("marked", [True, False])
def test_views_of_a_rig_of_meshroom_have_its_pose_and_that_of_their_camera(tmp_path: Path, marked: bool) -> None:
    """The rig is turned by 30 degrees about its x axis and stands 0.2 beside the first camera of each pair."""
    write_images(tmp_path / "images", poses(8))
    data = alicevision_scene(OFF_CENTRE, (1, 2, 8), structure=False)
    T_rig_cam = [np.eye(4), np.eye(4)]
    T_rig_cam[0][:3, :3], T_rig_cam[0][:3, 3] = Rotation.from_euler("x", 30, degrees=True).as_matrix(), (0.2, 0, 0)
    T_rig_cam[1][:3, :3], T_rig_cam[1][:3, 3] = Rotation.from_euler("y", -8, degrees=True).as_matrix(), (0.35, 0, 0.1)
    transforms = [
        {"rotation": [repr(float(v)) for v in T[:3, :3].reshape(-1)], "center": [repr(float(v)) for v in T[:3, 3]]}
        for T in T_rig_cam  # camera to rig row by row is rig to camera column by column
    ]
    data["rigs"] = [{"rigId": "3", "subPoses": [{"status": "estimated", "pose": pose} for pose in transforms]}]
    data["views"], data["poses"] = data["views"][:8], data["poses"][:4]
    for i, view in enumerate(data["views"]):
        view |= {"poseId": str(200 + i // 2), "rigId": "3", "subPoseId": str(i % 2)}
        view |= {"isPoseIndependant": "false"} if marked else {}
    (tmp_path / "cameras.sfm").write_text(json.dumps(data))
    scene = load_scene(tmp_path)
    assert (len(scene.views), scene.skipped) == (8, ())
    rig_poses = list(poses().values())
    for view in scene.views:
        i = int(view.name[2])
        T_world_cam = np.linalg.inv(rig_poses[i // 2]) @ T_rig_cam[i % 2]
        np.testing.assert_allclose(np.linalg.inv(view.camera.T_cam_world), T_world_cam, atol=1e-12)


def rig_of_metashape(root: Path, sensor: str) -> None:
    """Eight moments of two cameras: the first have a transform, the second a master."""
    moments = poses(8)
    write_images(root / "images" / "left", moments)
    write_images(root / "images" / "right", {f"r{name}": T for name, T in moments.items()})
    cameras = "".join(
        f"<camera id='{i}' sensor_id='0' component_id='0' label='{name}'><transform>{metashape_transform(T)}"
        f"</transform></camera><camera id='{20 + i}' sensor_id='1' label='r{name}' master_id='{i}'/>"
        for i, (name, T) in enumerate(moments.items())
    )
    calibration = metashape_calibration(OFF_CENTRE)
    second = f"</sensor><sensor id='1' type='frame' master_id='0'>{calibration}{sensor}</sensor></sensors>"
    text = metashape_document(calibration, cameras).replace("</sensor></sensors>", second)
    (root / "cameras.xml").write_text(text)


def test_the_second_camera_of_a_rig_of_metashape_is_placed_by_the_first(tmp_path: Path) -> None:
    R, t = Rotation.from_euler("y", -8, degrees=True).as_matrix(), np.array([0.35, -0.1, 0.2])
    numbers = " ".join(repr(float(v)) for v in R.reshape(-1))
    rig_of_metashape(tmp_path, f"<rotation>{numbers}</rotation><location>{t[0]} {t[1]} {t[2]}</location>")
    scene = load_scene(tmp_path)
    assert (len(scene.views), scene.skipped) == (16, ())
    T_left_right = np.eye(4)
    T_left_right[:3, :3], T_left_right[:3, 3] = R, t * CHUNK[0]  # lengths are the chunk's
    for view in scene.views:
        T_world_cam = np.linalg.inv(poses(8)[Path(view.name).name.removeprefix("r")])
        if view.name.startswith("right/"):
            T_world_cam = T_world_cam @ T_left_right
        np.testing.assert_allclose(np.linalg.inv(view.camera.T_cam_world), T_world_cam, atol=1e-9)


def test_a_camera_of_a_rig_whose_mounting_is_not_in_the_file_is_skipped_with_that_reason(tmp_path: Path) -> None:
    rig_of_metashape(tmp_path, "")
    scene = load_scene(tmp_path)
    assert len(scene.views) == 8
    assert scene.skipped[0] == "ra_0.jpg: its sensor has no rotation and location in its multi-camera system"
    text = (tmp_path / "cameras.xml").read_text()
    (tmp_path / "cameras.xml").write_text(text.replace("master_id='0'/>", "master_id='77'/>"))
    assert load_scene(tmp_path).skipped[0] == "ra_0.jpg: not aligned in Metashape"


def test_images_of_meshroom_are_found_at_the_paths_in_the_file(tmp_path: Path) -> None:
    write_images(tmp_path / "elsewhere", poses())
    data = alicevision_scene(OFF_CENTRE, (1, 2, 8), structure=False)
    for view in data["views"]:
        view["path"] = str(tmp_path / "elsewhere" / view["path"].rsplit("\\", 1)[-1])
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "cameras.sfm").write_text(json.dumps(data))
    scene = load_scene(tmp_path / "capture")
    assert [v.name for v in scene.test] == ["a_0.jpg", "a_8.jpg"]
    assert scene.points is None


def test_folders_distinguish_images_of_equal_name(tmp_path: Path) -> None:
    small_opensfm(tmp_path)
    (tmp_path / "images" / "left").mkdir()
    (tmp_path / "images" / "a_0.jpg").rename(tmp_path / "images" / "left" / "a_0.jpg")
    (tmp_path / "images" / "right").mkdir()
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "images" / "right" / "a_0.jpg")
    with pytest.raises(DataError, match=r"must name one image, got a_0\.jpg, which may be .*left.*right.*keep"):
        load_scene(tmp_path)
    path = tmp_path / "reconstruction.json"
    path.write_text(path.read_text().replace('"a_0.jpg"', '"D:/left/a_0.jpg"'))
    assert "left/a_0.jpg" in {view.name for view in load_scene(tmp_path).views}
