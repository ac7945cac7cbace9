"""Depth and normal maps from files, and observations of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import small_colmap, small_nerfstudio
from gs2d.data import load_scene
from gs2d.data.prior_maps import read_depth, read_normals, sample, shrink
from gs2d.data.scene import View
from gs2d.errors import DataError


def write_depth(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        Image.fromarray(values).save(path)


def slope(height: int = 30, width: int = 40) -> np.ndarray:
    """A different whole number in each pixel."""
    return (1000 + np.arange(height * width)).reshape(height, width).astype(np.uint16)


def view_of(root: Path, index: int = 0, **options: int) -> View:
    return load_scene(root, test_every=0, **options).train[index]


# -- where maps are found -------------------------------------------------------------------------------------------
def test_depth_maps_are_found_by_image_name_in_the_folder_depths(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    for name in ("0.png", "1.npy", "2.png.tif"):
        write_depth(tmp_path / "depths" / name, slope())
    scene = load_scene(tmp_path, test_every=0)
    found = [view.maps.files.depth.name if view.maps else None for view in scene.train]
    assert found[:4] == ["0.png", "1.npy", "2.png.tif", None]
    assert "depth maps: 3 of 9 views have one in depths (--depth-prior uses them)" in scene.notes
    assert (scene.train[0].maps.depth().values == slope()).all()


def test_transforms_json_names_maps_and_their_unit(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path, meta={"depth_unit_scale_factor": 0.01}, frame={"depth_file_path": "d/one.png"})
    write_depth(tmp_path / "d" / "one.png", slope())
    files = view_of(tmp_path).maps.files
    assert (files.depth, files.unit, files.metric) == (tmp_path / "d" / "one.png", 0.01, True)


# -- files ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float32, np.uint8])
def test_depths_of_8_16_and_32_bits_are_not_scaled(tmp_path: Path, kind: type) -> None:
    values = np.array([[1, 2, 3], [4, 5, 250]]).astype(kind)
    for suffix in (".npy", ".tif"):
        write_depth(tmp_path / f"d{suffix}", values)
        assert (read_depth(tmp_path / f"d{suffix}") == values).all()


def broken_files(folder: Path) -> dict[str, Path]:
    Image.fromarray(np.full((4, 5, 3), (9, 9, 8), np.uint8)).save(folder / "colour.png")
    Image.fromarray(np.zeros((4, 5), np.uint16)).save(folder / "zero.png")
    np.save(folder / "nan.npy", np.full((4, 5), np.nan))
    np.save(folder / "words.npy", np.array([["a"]]))
    np.save(folder / "flat.npy", np.ones(5))
    (folder / "text.npy").write_text("no array")
    (folder / "text.png").write_text("no picture")
    return {path.stem + path.suffix: path for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("colour.png", "colour-coded"),
        ("zero.png", "depths"),
        ("nan.npy", "must hold depths above 0"),
        ("words.npy", "numbers"),
        ("flat.npy", "array"),
        ("text.npy", "numbers"),
        ("text.png", "must be an image, got"),
    ],
)
def test_invalid_depth_files_are_named(tmp_path: Path, name: str, message: str) -> None:
    path = broken_files(tmp_path)[name]
    with pytest.raises(DataError, match=message) as caught:
        read_depth(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_map_of_another_aspect_ratio_is_an_error(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    write_depth(tmp_path / "depths" / "0.png", slope(40, 30))
    with pytest.raises(DataError, match="aspect ratio of its image"):
        view_of(tmp_path).maps.depth()


# -- on the pixels of the photograph --------------------------------------------------------------------------------
def test_every_marker_of_unknown_depth_becomes_zero(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    values = slope().astype(np.float32)
    values[0, 0], values[1, 1], values[2, 2], values[3, 3] = 0, -1, np.nan, np.inf
    write_depth(tmp_path / "depths" / "0.npy", values)
    found = view_of(tmp_path).maps.depth()
    assert (found.values[range(4), range(4)] == 0).all()
    assert (found.values > 0).sum() == 30 * 40 - 4
    assert not found.whole


def test_a_block_becomes_the_median_of_its_known_values() -> None:
    values = np.array([[1, 9, 0, 0], [2, 3, 0, 7]], dtype=np.float32)
    assert (shrink(values, 2) == [[2, 0]]).all()  # of 1 2 3 9 the lower middle; one of four is too few
    assert (shrink(np.array([[5, 0], [9, 0]], np.float32), 2) == [[5]]).all()
    assert shrink(np.ones((5, 7), np.float32), 2).shape == (3, 4)


def test_downscaled_maps_match_downscaled_images(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    write_depth(tmp_path / "depths" / "0.png", slope())
    view = view_of(tmp_path, downscale=4)
    found = view.maps.depth().values
    assert found.shape == (7, 10)
    assert (found == shrink(slope().astype(np.float32), 4)[:7]).all()


def test_smaller_maps_are_interpolated_where_neighbours_agree_and_only_there() -> None:
    values = np.array([[100, 102, 200, 0]] * 2, dtype=np.float32)
    x = np.array([1.0, 1.75, 2.25, 3.0])  # centres are at 0.5, 1.5, 2.5, 3.5
    positions = np.stack([x, np.ones(4)], axis=-1)[None]
    found = sample(values, positions, np.ones((1, 4), dtype=bool))[0]
    assert found.tolist() == [101, 102, 200, 0]  # between; an edge: the nearest; an edge; a hole
    assert (sample(values, positions, np.zeros((1, 4), dtype=bool)) == 0).all()


def test_maps_are_undistorted_with_their_images(tmp_path: Path) -> None:
    bent = {"k1": -0.1, "camera_model": "OPENCV"}
    small_nerfstudio(tmp_path, count=3, meta=bent, frame={"depth_file_path": "d.npy"})
    height, width = 30, 40
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    write_depth(tmp_path / "d.npy", (1000 + 10 * x + y).astype(np.float32))  # a plane in distorted pixels
    view = view_of(tmp_path)
    found, mask = view.maps.depth().values, view.mask()
    k = view.camera
    u, v = (x - k.cx) / k.fx, (y - k.cy) / k.fy
    bend = 1 - 0.1 * (u * u + v * v)
    expected = 1000 + 10 * (u * bend * k.fx + k.cx) + (v * bend * k.fy + k.cy)
    valid = np.ones_like(found, dtype=bool) if mask is None else mask
    assert np.allclose(found[valid], expected[valid], atol=1e-2)
    if mask is not None:
        assert (found[~mask] == 0).all()


# -- normals --------------------------------------------------------------------------------------------------------
def test_normals_are_decoded_to_unit_vectors_and_black_is_unknown(tmp_path: Path) -> None:
    rgb = np.zeros((1, 4, 3), np.uint8)
    rgb[0, 0], rgb[0, 1], rgb[0, 2] = (128, 128, 255), (255, 128, 128), (128, 128, 128)
    Image.fromarray(rgb).save(tmp_path / "n.png")
    found = read_normals(tmp_path / "n.png")[0]
    assert np.allclose(found[:2], [[0, 0, 1], [1, 0, 0]], atol=0.01)
    assert np.allclose(np.linalg.norm(found[:2], axis=1), 1)
    assert (found[2:] == 0).all()  # grey is no direction, black is unknown
    np.save(tmp_path / "n.npy", np.array([[[0, 0.6, 0.8], [np.nan, 0, 1]]]).transpose(2, 0, 1))
    assert np.allclose(read_normals(tmp_path / "n.npy"), [[[0, 0.6, 0.8], [0, 0, 0]]])


# -- points ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_points_are_assigned_to_the_images_that_observe_them(tmp_path: Path, kind: str) -> None:
    model = small_colmap(tmp_path, kind=kind)
    ids = [5, 2, 99]
    model.points = [(i, (i, 0.0, 1.0), (1, 2, 3), 0.25 * i, []) for i in ids]
    observations = {0: [(1.0, 2.0, 5), (3.0, 4.0, 2), (3.1, 4.0, 2)], 1: [(1.0, 1.0, 2), (0.0, 0.0, -1), (9.0, 9.0, 7)]}
    model.images = [(*image[:4], observations.get(k, [])) for k, image in enumerate(model.images)]
    model.write(tmp_path / "sparse/0", kind)
    observed = load_scene(tmp_path, test_every=0).observe()
    assert observed.points.tolist() == [[5, 0, 1], [2, 0, 1], [99, 0, 1]]
    assert observed.error.tolist() == [1.25, 0.5, 24.75]
    assert observed.track.tolist() == [1, 2, 0]  # photographs, not observations; point 7 does not exist
    names = [image[3] for image in model.images]
    assert sorted(observed.by_view[names[0]].tolist()) == [0, 1]
    assert observed.by_view[names[1]].tolist() == [1]
    assert observed.by_view[names[2]].tolist() == []
