"""Blender, nerfstudio and instant-ngp data sets."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from capture_writers import opengl_camera_to_world, ring, small_blender, small_nerfstudio, write_image_of
from gs2d.data import load_scene
from gs2d.errors import DataError


def edit(path: Path, change: Any) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def test_blender_cameras_alpha_and_split(tmp_path: Path) -> None:
    cameras = small_blender(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.format == "blender"
    assert [v.name for v in scene.train] == [f"train/r_{i}.png" for i in range(4)]
    assert [v.name for v in scene.test] == ["test/r_0.png", "test/r_1.png"]
    for view, camera in zip(scene.views, cameras, strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-12)
        np.testing.assert_allclose((view.camera.fx, view.camera.fy), 35.0)
        assert (view.camera.cx, view.camera.cy) == (20.0, 15.0)
    view = scene.train[0]
    assert view.image().shape == (30, 40, 4)
    np.testing.assert_array_equal(view.alpha(), view.image()[:, :, 3] / np.float32(255))
    np.testing.assert_array_equal(view.object_mask(), view.image()[:, :, 3] >= 128)


def test_opengl_axes_become_opencv_axes(tmp_path: Path) -> None:
    """A camera at (0, 0, 4) with the identity looks along -z with y up: worked by hand."""
    second = np.eye(4)
    second[:3, 3] = (1, 0, 4)
    first = np.eye(4)
    first[2, 3] = 4
    frames = []
    for name, M in (("a", first), ("b", second)):
        write_image_of(tmp_path / f"{name}.png")
        frames.append({"file_path": name, "transform_matrix": M.tolist()})
    meta = {"camera_angle_x": 2 * math.atan(20 / 35), "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(meta))
    camera = load_scene(tmp_path, test_every=0).train[0].camera
    pixels, depth = camera.project(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]]))
    # f = 35: one unit to the right at depth 4 is 35/4 px to the right; one unit up is 35/4 px up (smaller row).
    np.testing.assert_allclose(pixels, [[20, 15], [28.75, 15], [20, 6.25], [20, 15]])
    np.testing.assert_allclose(depth, [4, 4, 4, 2])


def test_without_a_test_file_every_eighth_frame_is_test_and_val_is_not_used(tmp_path: Path) -> None:
    small_blender(tmp_path, train=9, test=0)
    (tmp_path / "transforms_val.json").write_text("not even JSON")
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.test] == ["train/r_0.png", "train/r_8.png"]
    assert len(scene.train) == 7


def test_the_split_of_a_capture_wins(tmp_path: Path) -> None:
    small_blender(tmp_path)
    scene = load_scene(tmp_path, test_every=2)
    assert (len(scene.train), len(scene.test)) == (4, 2)


def test_shared_intrinsics_with_an_off_centre_principal_point(tmp_path: Path) -> None:
    cameras = small_nerfstudio(tmp_path)
    scene = load_scene(tmp_path, test_every=0)
    assert scene.format == "nerfstudio"
    for view, camera in zip(scene.train, cameras, strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-12)
        c = view.camera
        assert (c.fx, c.fy, c.cx, c.cy) == (35.0, 36.0, 18.5, 16.25)
    assert [v.name for v in load_scene(tmp_path).test] == ["images/f_00.png", "images/f_08.png"]


@pytest.mark.parametrize(
    ("keys", "fx", "fy"),
    [
        ({"camera_angle_x": 2 * math.atan(20 / 30)}, 30.0, 30.0),
        ({"camera_angle_x": 2 * math.atan(20 / 30), "camera_angle_y": 2 * math.atan(15 / 25)}, 30.0, 25.0),
        ({"fl_x": 33.0, "camera_angle_x": 0.1, "camera_angle_y": 0.2}, 33.0, 33.0),
        ({"fl_y": 31.0}, 31.0, 31.0),
    ],
)
def test_focal_lengths_in_pixels_take_precedence_over_angles(
    tmp_path: Path, keys: dict[str, float], fx: float, fy: float
) -> None:
    small_nerfstudio(tmp_path)

    def change(meta: dict[str, Any]) -> None:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del meta[key]
        meta.update(keys)

    edit(tmp_path / "transforms.json", change)
    c = load_scene(tmp_path).train[0].camera
    np.testing.assert_allclose((c.fx, c.fy, c.cx, c.cy, c.width, c.height), (fx, fy, 20, 15, 40, 30))


def test_frames_without_a_file_are_skipped_and_reported(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path)
    (tmp_path / "images/f_04.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == 8
    assert scene.skipped == ("images/f_04.png: listed in transforms.json, but there is no such file",)


def test_sparse_points_of_a_ply_and_a_mask_are_read(tmp_path: Path) -> None:
    small_nerfstudio(
        tmp_path, meta={"ply_file_path": "points.ply", "applied_transform": np.eye(4)[:3].tolist()},
        frame={"mask_path": "mask.png"},
    )  # fmt: skip
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 4 5 6\n-1 -2 -3 7 8 9\n"
    )
    mask = np.full((30, 40), 255, np.uint8)
    mask[:, :7] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.points.points, [[1, 2, 3], [-1, -2, -3]])
    np.testing.assert_array_equal(scene.points.colors, [[4, 5, 6], [7, 8, 9]])
    np.testing.assert_array_equal(scene.train[0].mask(), mask > 0)
    assert any("applied_transform" in note for note in scene.notes)


def test_distorted_frames_are_undistorted_and_reported(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path, meta={"camera_model": "OPENCV", "k1": -0.3, "p1": 0.01})
    view = load_scene(tmp_path, test_every=0).train[0]
    from gs2d.data.image_files import read_image

    assert not np.array_equal(view.image(), read_image(view.path))
    assert any("9 of 9 views are undistorted" in note for note in load_scene(tmp_path).details)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda frame: frame["transform_matrix"][0].__setitem__(3, 10**400), "out of range"),
        (lambda frame: frame["transform_matrix"][0].__setitem__(3, math.nan), "frame 1 .*: transform_matrix .* NaN"),
        (lambda frame: frame.update(fl_x=math.inf), "frame 1 .*: fl_x must be a finite number, got 'inf'"),
    ],
)
def test_a_frame_whose_pose_or_camera_is_not_finite_is_skipped_and_named(
    tmp_path: Path, change: Any, reason: str
) -> None:
    small_nerfstudio(tmp_path)
    edit(tmp_path / "transforms.json", lambda meta: change(meta["frames"][1]))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 8
    assert len(scene.skipped) == 1
    assert re.match(f"images/f_01.png: .*{reason}", scene.skipped[0])


def test_letter_case_of_transforms_json_and_its_files_may_differ(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path, meta={"ply_file_path": "points.ply"}, frame={"mask_path": "mask.png"})
    (tmp_path / "transforms.json").rename(tmp_path / "Transforms.JSON")
    (tmp_path / "Points.PLY").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "1 2 3\n"
    )
    Image.fromarray(np.full((30, 40), 255, np.uint8)).save(tmp_path / "Mask.png")
    scene = load_scene(tmp_path)
    assert scene.points is not None
    assert (len(scene.views), len(scene.points), scene.masks.found) == (9, 1, 9)


def _drop(*path: Any) -> Any:
    def change(meta: dict[str, Any]) -> None:
        for key in path[:-1]:
            meta = meta[key]
        del meta[path[-1]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_drop("frames"), "object"),
        (_drop("frames", 3, "transform_matrix"), "file_path"),
        (_drop("frames", 3, "file_path"), 'frame 3 must have the key "file_path"'),
        (lambda m: (m.pop("fl_x"), m.pop("fl_y")), "camera_angle_x"),
        (lambda m: m.update(fl_x="35"), "fl_x"),
        (lambda m: m.update(fl_x=-35.0), "positive"),
        (lambda m: m.update(fl_x=10**400), "fl_x"),
        (lambda m: m.update(fl_x=1e12), "length"),
        (lambda m: m["frames"][1]["transform_matrix"].pop(), None),
        (lambda m: m["frames"][1].update(transform_matrix=[[1, 2], [3]]), "must be a 4x4 matrix"),
        (lambda m: m["frames"][1].update(transform_matrix=(2 * np.eye(4)).tolist()), "remove scale or mirroring"),
        (lambda m: m["frames"][1].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "remove scale or mirror"),
        (lambda m: m["frames"].__setitem__(1, 5), "object"),
        (lambda m: m.update(camera_model="OMNIDIRECTIONALSTEREO_L"), "is not supported"),
        (lambda m: m.update(camera_model="PINHOLE", k1=0.1), "distortion"),
        (lambda m: m.update(train_filenames="images/f_00.png"), "train_filenames"),
        (lambda m: [f.update(file_path="gone") for f in m["frames"]], "skipped"),
    ],
)
def test_a_wrong_json_is_one_line_that_names_frame_and_key(tmp_path: Path, change: Any, message: str | None) -> None:
    small_nerfstudio(tmp_path)
    edit(tmp_path / "transforms.json", change)
    if message is None:  # [3, 4] is a pose too
        assert len(load_scene(tmp_path).views) == 9
        return
    with pytest.raises(DataError, match=message) as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)


def test_two_frames_of_one_file_are_an_error(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path)
    edit(tmp_path / "transforms.json", lambda m: m["frames"].append(m["frames"][2]))
    with pytest.raises(DataError, match=r"f_02\.png"):
        load_scene(tmp_path)


def test_cameras_with_equal_centres_are_an_error(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path)
    same = opengl_camera_to_world(ring(3)[0])
    edit(tmp_path / "transforms.json", lambda m: [f.update(transform_matrix=same) for f in m["frames"]])
    with pytest.raises(DataError, match="different centres"):
        load_scene(tmp_path)


def moved(root: Path, offset: float) -> None:
    """The ring of cameras (extent 4.4) moved along x."""
    small_nerfstudio(root)
    edit(
        root / "transforms.json",
        lambda m: [f["transform_matrix"][0].__setitem__(3, f["transform_matrix"][0][3] + offset) for f in m["frames"]],
    )


def test_a_capture_too_far_from_its_origin_for_32_bits_is_an_error(tmp_path: Path) -> None:
    # 2^-23 of 1e6 is 0.12: a 37th of the extent, where 1e-3 of it is allowed.
    moved(tmp_path, 1e6)
    with pytest.raises(DataError, match="subtract"):
        load_scene(tmp_path)
    moved(tmp_path / "farther", 1e300)
    with pytest.raises(DataError, match="within"):
        load_scene(tmp_path / "farther")
