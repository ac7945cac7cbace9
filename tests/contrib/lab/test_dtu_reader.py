"""DTU scans in the layout of IDR and NeuS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture_writers import SCALE_MAT, ColmapModel, ring, small_dtu, write_image_of
from gs2d.contrib.lab.dtu_reader import decompose_projection, dtu_silhouettes
from gs2d.data import load_scene
from gs2d.errors import DataError


@pytest.mark.parametrize(
    ("digits", "images", "archive"), [(3, "image", "cameras_sphere.npz"), (6, "images", "cameras.npz")]
)
def test_cameras_masks_and_metric_frame(tmp_path: Path, digits: int, images: str, archive: str) -> None:
    """The writer takes half a pixel from cx, cy (centres at whole numbers) and flips the sign of view 1."""
    cameras = small_dtu(tmp_path, digits=digits, images=images, archive=archive)
    scene = load_scene(tmp_path)
    assert scene.format == "dtu"
    assert (len(scene.train), len(scene.test)) == (5, 0)  # the protocol trains on all views
    for index, (view, camera) in enumerate(zip(scene.train, cameras, strict=True)):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-9)
        np.testing.assert_allclose(view.camera.K, camera.K, atol=1e-8)
        expected = np.zeros((30, 40), bool)
        expected[10:20, 5 : 20 + index] = True
        np.testing.assert_array_equal(view.object_mask(), expected)
        assert view.mask() is None  # the background is trained
    np.testing.assert_array_equal(scene.T_metric_scene, SCALE_MAT)
    assert len(load_scene(tmp_path, test_every=2).test) == 3


def test_a_singular_matrix_or_one_with_skew_is_an_error() -> None:
    camera = ring(3)[1]
    with pytest.raises(DataError, match="full rank"):
        decompose_projection(np.zeros((4, 4)), "view 0")
    with pytest.raises(DataError, match="full rank"):
        decompose_projection(np.full((4, 4), np.nan), "view 0")
    K = camera.K
    K[0, 1] = 2.0
    with pytest.raises(DataError, match="no skew, got 2 px"):
        decompose_projection(K @ camera.T_cam_world[:3], "view 0")


def test_sparse_points_are_used_only_if_their_cameras_stand_where_the_scene_s_do(tmp_path: Path) -> None:
    cameras = small_dtu(tmp_path)
    model = ColmapModel(cameras={1: ("PINHOLE", 40, 30, (35.0, 35.0, 20.0, 15.0))})
    model.images = [(i + 1, c.T_cam_world, 1, f"{i:06d}.png", []) for i, c in enumerate(cameras)]
    model.points = [(1, (0.1, 0.2, 0.3), (1, 2, 3), 0.1, [])]
    model.write(tmp_path / "sparse/0")
    np.testing.assert_array_equal(load_scene(tmp_path).points.points, [[0.1, 0.2, 0.3]])
    moved = [(i, T + np.array([[0, 0, 0, 0.5]] * 3 + [[0] * 4]), k, n, o) for i, T, k, n, o in model.images]
    ColmapModel(model.cameras, moved, model.points).write(tmp_path / "sparse/0")
    scene = load_scene(tmp_path)
    assert scene.points is None
    assert any("other coordinates" in note for note in scene.notes)


def test_numbered_images_keep_their_camera_when_one_is_missing(tmp_path: Path) -> None:
    cameras = small_dtu(tmp_path)
    (tmp_path / "image/000002.png").unlink()
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.train] == ["000000.png", "000001.png", "000003.png", "000004.png"]
    np.testing.assert_allclose(scene.train[2].camera.center, cameras[3].center, atol=1e-9)
    assert scene.train[2].object_mask()[15].sum() == 18  # columns 5 to 22 of view 3
    assert scene.skipped == ("view 2: no image",)


def test_wrong_archives_are_errors(tmp_path: Path) -> None:
    small_dtu(tmp_path)
    path = tmp_path / "cameras_sphere.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[:300])
    with pytest.raises(DataError, match=r"cameras_sphere\.npz"):
        load_scene(tmp_path)
    np.savez(path, world_mat_0=np.eye(4))
    with pytest.raises(DataError, match="world_mat_i"):
        load_scene(tmp_path)
    np.savez(path, world_mat_0=np.eye(3), scale_mat_0=np.eye(4))
    with pytest.raises(DataError, match="world_mat_0"):
        load_scene(tmp_path)
    matrices = {f"{k}_mat_{i}": np.eye(4) for k in ("world", "scale") for i in (0, 1)}
    np.savez(path, **{**matrices, "scale_mat_1": 2 * np.eye(4)})
    with pytest.raises(DataError, match="finite"):
        load_scene(tmp_path)


def test_an_alpha_channel_is_a_silhouette_and_the_background_stays(tmp_path: Path) -> None:
    small_dtu(tmp_path)
    pixels = write_image_of(tmp_path / "image/000000.png", alpha=True)
    for path in (tmp_path / "mask").iterdir():
        path.unlink()
    view = load_scene(tmp_path).train[0]
    np.testing.assert_array_equal(view.image(), pixels[..., :3])
    np.testing.assert_array_equal(view.object_mask(), pixels[..., 3] >= 128)
    assert view.alpha() is None


def preprocessed(root: Path) -> list:
    """As 2DGS prepares DTU: photographs undistorted to 38x28 with alpha, a model for them, masks of 40x30."""
    cameras = small_dtu(root, images="images", archive="cameras.npz")
    model = ColmapModel(cameras={1: ("PINHOLE", 38, 28, (35.0, 35.0, 17.0, 15.5))})
    model.images = [(i + 1, c.T_cam_world, 1, f"{i:06d}.png", []) for i, c in enumerate(cameras)]
    model.points = [(1, (0.1, 0.2, 0.3), (1, 2, 3), 0.1, [])]
    model.write(root / "sparse/0")
    for i in range(len(cameras)):
        write_image_of(root / f"images/{i:06d}.png", 38, 28, seed=i, alpha=True)
    return cameras


def test_photographs_of_another_size_take_the_cameras_of_their_model(tmp_path: Path) -> None:
    cameras = preprocessed(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.points is not None
    np.testing.assert_array_equal(scene.T_metric_scene, SCALE_MAT)
    for view, camera in zip(scene.train, cameras, strict=True):
        assert (view.camera.width, view.camera.height) == (38, 28)
        assert (view.camera.cx, view.camera.cy, view.camera.fx) == (17.0, 15.5, 35.0)
        np.testing.assert_allclose(view.camera.center, camera.center, atol=1e-9)
        assert view.object_mask().shape == (28, 38)  # of the alpha channel: the mask files are of the originals
    assert any("5 of 5 views come from sparse/0" in note for note in scene.notes)


def test_masks_are_given_at_their_own_size_with_the_cameras_of_the_archive(tmp_path: Path) -> None:
    cameras = preprocessed(tmp_path)
    found = dtu_silhouettes(tmp_path)
    assert [s.path.name for s in found] == [f"{i:03d}.png" for i in range(5)]
    for silhouette, camera in zip(found, cameras, strict=True):
        assert (silhouette.camera.width, silhouette.camera.height) == (40, 30)
        np.testing.assert_allclose(silhouette.camera.K, camera.K, atol=1e-8)
        np.testing.assert_allclose(silhouette.camera.T_cam_world, camera.T_cam_world, atol=1e-9)
    for path in (tmp_path / "mask").iterdir():
        path.unlink()
    assert dtu_silhouettes(tmp_path) == ()


def test_of_two_archives_the_one_in_the_frame_of_the_model_is_read(tmp_path: Path) -> None:
    """cameras_sphere.npz comes first, unless sparse/0 was made in the frame of cameras.npz."""
    preprocessed(tmp_path)
    other = dict(np.load(tmp_path / "cameras.npz"))
    wide = np.diag([2.0, 2, 2, 1])
    other |= {name: matrix @ wide for name, matrix in other.items() if name.startswith("scale_mat")}
    np.savez(tmp_path / "cameras_sphere.npz", **other)
    np.testing.assert_array_equal(load_scene(tmp_path).T_metric_scene, SCALE_MAT)
    (tmp_path / "cameras.npz").unlink()
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.T_metric_scene, SCALE_MAT @ wide)
    assert any("other coordinates" in note for note in scene.notes)
