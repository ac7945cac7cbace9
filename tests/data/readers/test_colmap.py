"""COLMAP data sets."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import ColmapModel, ring, small_colmap, write_image_of
from gs2d.data import load_scene
from gs2d.data.image_files import read_image
from gs2d.data.readers.colmap import read_cameras, read_images, read_points
from gs2d.errors import DataError


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_cameras_points_and_images_match_the_model(tmp_path: Path, kind: str) -> None:
    model = small_colmap(tmp_path, kind=kind)
    scene = load_scene(tmp_path, test_every=0)
    assert scene.format == "colmap"
    assert [view.name for view in scene.train] == [f"{i}.png" for i in range(9)]
    for view, (index, camera) in zip(scene.train, reversed(list(enumerate(ring(9)))), strict=True):
        c = view.camera
        assert (c.width, c.height, c.fx, c.fy, c.cx, c.cy) == (40, 30, 35.0, 36.0, 18.5, 16.25)
        np.testing.assert_allclose(c.T_cam_world, camera.T_cam_world, atol=1e-12)
        np.testing.assert_array_equal(view.image(), read_image(tmp_path / "images" / view.name))
        assert f"{8 - index}.png" == view.name
    assert scene.points is not None
    np.testing.assert_array_equal(scene.points.points, [p[1] for p in model.points])
    np.testing.assert_array_equal(scene.points.colors, [p[2] for p in model.points])
    assert scene.points.points.dtype == np.float64
    assert scene.points.colors.dtype == np.uint8


@pytest.mark.parametrize("where", ["sparse/0", "sparse"])
def test_the_model_may_be_in_sparse_0_or_sparse(tmp_path: Path, where: str) -> None:
    small_colmap(tmp_path, where=where)
    assert len(load_scene(tmp_path).views) == 9


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_the_largest_model_is_read_and_a_note_gives_the_sizes_of_the_others(tmp_path: Path, kind: str) -> None:
    model = small_colmap(tmp_path, kind=kind)
    replace(model, images=model.images[:2]).write(tmp_path / "sparse/10", kind)
    model.write(tmp_path / "sparse/2", kind)
    replace(model, images=model.images[:2]).write(tmp_path / "sparse/0", kind)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 9
    first = f"gs2d train {tmp_path / 'sparse/0'}"
    assert scene.notes[0] == (
        f"using the model sparse/2 with 9 images; 0 has 2, 10 has 2. To use another one, give its folder: {first}"
    )
    with pytest.raises(DataError, match="images"):
        load_scene(tmp_path / "sparse/0")
    model.write(tmp_path / "sparse/0", kind)  # of two that are as large the first
    assert "using the model sparse/0" in load_scene(tmp_path).notes[0]


def test_images_in_sub_folders_keep_their_whole_name(tmp_path: Path) -> None:
    cameras = ring(4)
    model = ColmapModel(cameras={1: ("SIMPLE_PINHOLE", 40, 30, (35.0, 20.0, 15.0))})
    names = ["left/a.png", "left/b c.png", "right/a.png", "right/b c.png"]
    for index, name in enumerate(names):
        model.images.append((index + 1, cameras[index].T_cam_world, 1, name, []))
        write_image_of(tmp_path / "images" / name, seed=index)
    for kind in ("bin", "txt"):
        model.write(tmp_path / kind / "sparse", kind)
        (tmp_path / kind / "images").symlink_to(tmp_path / "images")
        scene = load_scene(tmp_path / kind, test_every=0)
        assert [view.name for view in scene.train] == names
        assert not np.array_equal(scene.train[0].image(), scene.train[2].image())
        assert scene.points is None


def test_images_missing_on_disk_are_skipped_and_reported(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    (tmp_path / "images/3.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == 8
    assert scene.skipped == ("3.png: no such file in images",)


def test_downscale_filters_the_image_and_keeps_rays(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    full, half = load_scene(tmp_path, test_every=0), load_scene(tmp_path, test_every=0, downscale=4)
    a, b = full.train[2], half.train[2]
    assert (b.camera.width, b.camera.height) == (10, 7)  # 40 / 4; 30 / 4 = 7, two rows are cut
    assert (b.camera.fx, b.camera.cx, b.camera.cy) == (35 / 4, 18.5 / 4, 16.25 / 4)
    block = a.image()[4:8, 8:12].reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(b.image()[1, 2], block, atol=0.5)


def test_images_n_is_used_for_downscale_n_with_its_own_size(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    # 30 / 4 = 7.5: whoever made images_4 rounded up, so fy scales by 8/30 while fx scales by 10/40.
    images = [write_image_of(tmp_path / "images_4" / f"{i}.png", 10, 8, seed=50 + i) for i in range(9)]
    scene = load_scene(tmp_path, downscale=4, test_every=0)
    view = scene.train[3]
    np.testing.assert_array_equal(view.image(), images[3])
    c = view.camera
    np.testing.assert_allclose((c.width, c.height, c.fx, c.fy), (10, 8, 35 / 4, 36 * 8 / 30))
    np.testing.assert_allclose((c.cx, c.cy), (18.5 / 4, 16.25 * 8 / 30))
    assert any("images_4" in note for note in scene.notes)


def test_images_n_of_a_wrong_size_is_an_error(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    for i in range(9):
        write_image_of(tmp_path / "images_4" / f"{i}.png", 20, 15)
    with pytest.raises(DataError, match="camera"):
        load_scene(tmp_path, downscale=4)


def test_another_image_size_rescales_the_camera_and_another_aspect_ratio_is_an_error(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    write_image_of(tmp_path / "images/2.png", 80, 60)
    c = load_scene(tmp_path, test_every=0).train[2].camera
    assert (c.width, c.height, c.fx, c.fy, c.cx, c.cy) == (80, 60, 70.0, 72.0, 37.0, 32.5)
    write_image_of(tmp_path / "images/2.png", 30, 40)
    with pytest.raises(DataError, match="rotated"):
        load_scene(tmp_path)


def test_exif_orientation_is_ignored_as_colmap_ignores_it(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6  # "rotate by 90 degrees to view"
    stored = np.zeros((30, 40, 3), np.uint8)
    stored[:, :20] = 255
    Image.fromarray(stored).save(tmp_path / "images/4.png", exif=exif)
    view = load_scene(tmp_path, test_every=0).train[4]
    with Image.open(tmp_path / "images/4.png") as file:
        assert file.getexif()[0x0112] == 6
    np.testing.assert_array_equal(view.image(), stored)


def test_masks_select_the_used_pixels(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    mask = np.zeros((30, 40), np.uint8)
    mask[8:, :] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/1.png.png")
    Image.fromarray(mask).save(tmp_path / "masks/2.png")
    Image.fromarray(mask).resize((80, 60), Image.Resampling.NEAREST).save(tmp_path / "masks/3.png")
    scene = load_scene(tmp_path, test_every=0)
    assert scene.train[0].mask() is None
    for index in (1, 2, 3):
        np.testing.assert_array_equal(scene.train[index].mask(), mask > 0)
    # Rows 6 to 8 of the full size make row 2 of a third: a pixel counts only where all of it counts.
    third = load_scene(tmp_path, test_every=0, downscale=3).train[1].mask()
    np.testing.assert_array_equal(third[:, 0], [False] * 3 + [True] * 7)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_truncated_binary_file_is_an_error_with_name_and_size(tmp_path: Path, name: str) -> None:
    small_colmap(tmp_path, count=3)
    folder = tmp_path / "sparse/0"
    whole = (folder / f"{name}.bin").read_bytes()
    read = {"cameras": read_cameras, "images": read_images, "points3D": read_points}[name]
    for size in (*range(0, len(whole), 3), len(whole) - 1):
        (folder / f"{name}.bin").write_bytes(whole[:size])
        with pytest.raises(DataError, match=rf"{name}\.bin is truncated .*got .*{size}"):
            read(folder, "bin")
    (folder / f"{name}.bin").write_bytes(whole + b"\0")
    with pytest.raises(DataError, match="must end after its last"):
        read(folder, "bin")


def test_an_absurd_count_is_an_error_and_not_a_huge_allocation(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    path = tmp_path / "sparse/0/points3D.bin"
    path.write_bytes(struct.pack("<Q", 1 << 60) + path.read_bytes()[8:])
    with pytest.raises(DataError, match="points"):
        load_scene(tmp_path)
    huge_track = struct.pack("<QQ3d3BdQ", 1, 1, 0, 0, 0, 0, 0, 0, 0, 1 << 63)
    path.write_bytes(huge_track)
    with pytest.raises(DataError, match="truncated"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("name", "line", "expected"),
    [
        ("cameras", "1 PINHOLE 40 thirty 1 1 1 1", "CAMERA_ID"),
        ("images", "1 1 0 0 0 0 0 0 7", "IMAGE_ID"),
        ("points3D", "1 0 0", "POINT3D_ID"),
    ],
)
def test_a_wrong_line_of_a_text_model_is_named(tmp_path: Path, name: str, line: str, expected: str) -> None:
    small_colmap(tmp_path, kind="txt")
    (tmp_path / "sparse/0" / f"{name}.txt").write_text(line + "\n")
    with pytest.raises(DataError, match=expected):
        load_scene(tmp_path)


@pytest.mark.parametrize("drop", [slice(None), slice(-1, None), slice(1, 6, 2), slice(2, 3)])
def test_images_txt_may_lack_the_empty_lines_of_images_without_points(tmp_path: Path, drop: slice) -> None:
    model = small_colmap(tmp_path, kind="txt")
    path = tmp_path / "sparse/0/images.txt"
    head, *lines = path.read_text().splitlines()
    empty = [index for index in range(1, len(lines), 2) if not lines[index]]
    assert len(empty) == 3
    gone = set(empty[drop])
    path.write_text("\n".join([head, *(line for index, line in enumerate(lines) if index not in gone)]))
    images = read_images(path.parent, "txt", observations=True)
    assert [image.name for image in images] == [image[3] for image in model.images]
    assert [len(image.observations) for image in images] == [len(image[4]) for image in model.images]  # type: ignore[arg-type]
    assert len(load_scene(tmp_path).views) == 9


@pytest.mark.parametrize("written", ["nan", "-nan(ind)", "1.#QNAN", "-1.#IND", "inf"])
@pytest.mark.parametrize("what", ["pose", "camera"])
def test_an_image_whose_pose_or_camera_is_not_finite_is_skipped_and_named(
    tmp_path: Path, what: str, written: str
) -> None:
    small_colmap(tmp_path, kind="txt")
    images, cameras = (tmp_path / "sparse/0" / name for name in ("images.txt", "cameras.txt"))
    if what == "pose":
        images.write_text(re.sub(r"\S+ 7 8\.png", lambda _: f"{written} 7 8.png", images.read_text()))
    else:
        cameras.write_text(cameras.read_text() + f"9 PINHOLE 40 30 {written} 36 18.5 16.25\n")
        images.write_text(images.read_text().replace(" 7 8.png", " 9 8.png"))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views if view.name == "8.png"] == []
    assert len(scene.views) == 8
    assert len(scene.skipped) == 1
    assert scene.skipped[0].startswith("8.png: ")
    assert "finite" in scene.skipped[0]
    if what == "pose":
        with pytest.raises(DataError, match="finite"):
            read_images(images.parent, "txt")


def test_a_model_without_observations_has_its_points_projected_into_the_images(tmp_path: Path) -> None:
    model = small_colmap(tmp_path)
    scene = load_scene(tmp_path)
    assert "the capture does not say" in scene.unobserved()
    assert scene.observed(guessed=False) is None
    observed = scene.observed()
    assert observed is not None
    inside = [view.camera.project(observed.points)[0] for view in scene.views]
    near = [((uv > 0) & (uv < (40, 30))).all(axis=1) for uv in inside]
    for view, fits in zip(scene.views, near, strict=True):
        rows = observed.by_view[view.name]
        assert 0 < len(rows) <= fits.sum()
        assert fits[rows].all()
    model.images[0] = (*model.images[0][:4], [(1.0, 2.0, 3)])
    model.write(tmp_path / "sparse/0")
    scene = load_scene(tmp_path)
    assert scene.unobserved() == ""
    assert scene.observed(guessed=False).by_view["8.png"].tolist() == [2]  # type: ignore[union-attr]


def test_an_unsupported_camera_model_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    cameras = {7: ("RAD_TAN_THIN_PRISM_FISHEYE", 40, 30, tuple([35.0, 36.0, 20.0, 15.0] + [0.01] * 12))}
    small_colmap(tmp_path, cameras=cameras)
    with pytest.raises(DataError, match="RAD_TAN_THIN_PRISM_FISHEYE"):
        load_scene(tmp_path)
    path = tmp_path / "sparse/0/cameras.bin"
    raw = bytearray(path.read_bytes())
    raw[12:16] = struct.pack("<i", 99)
    path.write_bytes(bytes(raw))
    with pytest.raises(DataError, match="image_undistorter"):
        load_scene(tmp_path)


def test_an_image_of_a_camera_that_is_not_listed_is_an_error(tmp_path: Path) -> None:
    small_colmap(tmp_path, cameras={3: ("PINHOLE", 40, 30, (35.0, 36.0, 18.5, 16.25))})
    with pytest.raises(DataError, match="camera"):
        load_scene(tmp_path)


def test_a_capture_without_images_is_an_error(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="skipped"):
        load_scene(tmp_path)
    (tmp_path / "images").rmdir()
    with pytest.raises(DataError, match="must have its images"):
        load_scene(tmp_path)


def test_points_that_are_not_finite_are_left_out_and_reported(tmp_path: Path) -> None:
    model = small_colmap(tmp_path)
    model.points[3] = (4, (np.nan, 0, 0), (1, 2, 3), 0.5, [])
    model.write(tmp_path / "sparse/0")
    scene = load_scene(tmp_path)
    assert len(scene.points) == 19
    assert np.isfinite(scene.points.points).all()
    assert any("1 of 20 sparse points" in note for note in scene.notes)


@pytest.mark.parametrize("word", ["nan", "1e300", "-1", "256"])
def test_invalid_colours_of_points_are_one_line(tmp_path: Path, word: str) -> None:
    path = tmp_path / "points3D.txt"
    path.write_text(f"1 0.5 0.5 0.5 10 {word} 30 0.1 1 1\n")
    with pytest.raises(DataError, match=r"points3D\.txt"):
        read_points(tmp_path, "txt")
    path.write_text("nan 0.5 0.5 0.5 10 20 30 0.1 1 1\n")
    with pytest.raises(DataError, match="not a valid int64"):
        read_points(tmp_path, "txt")
