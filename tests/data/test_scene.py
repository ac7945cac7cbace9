"""Views, image cache, and detection of formats."""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture_writers import ring, small_blender, small_colmap, small_dtu, small_nerfstudio, tree_hash
from foreign_writers import small_alicevision, small_metashape, small_opensfm
from gs2d.data import DecodedImage, ImageCache, View, detect_format, load_scene
from gs2d.errors import DataError

WRITERS: dict[str, Callable[[Path], object]] = {
    "blender": small_blender,
    "nerfstudio": small_nerfstudio,
    "dtu": small_dtu,
    "colmap": small_colmap,
    "opensfm": small_opensfm,
    "metashape": small_metashape,
    "alicevision": small_alicevision,
}


def image(value: int) -> DecodedImage:
    return DecodedImage(np.full((10, 10, 3), value, np.uint8))


@pytest.mark.parametrize("format", WRITERS)
def test_the_format_is_detected_and_nothing_is_written(tmp_path: Path, format: str) -> None:
    WRITERS[format](tmp_path)
    before = tree_hash(tmp_path)
    assert detect_format(tmp_path) == format
    scene = load_scene(tmp_path, downscale=2)
    for view in scene.views:
        view.image(), view.mask(), view.alpha(), view.object_mask()
    assert scene.format == format
    assert scene.name == tmp_path.name
    assert tree_hash(tmp_path) == before


def test_a_missing_folder_a_file_an_empty_folder_and_an_unknown_layout_are_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(DataError, match="folder"):
        load_scene(tmp_path / ("a" * 300))
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(DataError, match="capture"):
        load_scene(empty)
    (tmp_path / "note.txt").write_text("hello")
    with pytest.raises(DataError, match="photographs"):
        load_scene(tmp_path / "note.txt")
    with pytest.raises(DataError, match=r"transforms_train\.json"):
        load_scene(tmp_path)


def test_images_are_decoded_on_demand_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    small_blender(tmp_path)
    path = tmp_path / "train/r_2.png"
    path.write_bytes(path.read_bytes()[:400])  # the header is whole, the pixels are not
    scene = load_scene(tmp_path)
    scene.train[0].image()
    with pytest.raises(DataError, match=r"r_2\.png does not decode"):
        scene.train[2].image()
    with pytest.raises(DataError, match=r"r_2\.png does not decode"):
        list(scene.preload())
    path.write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"r_2\.png must be an image"):
        load_scene(tmp_path)


def test_an_image_whose_size_changed_since_loading_is_an_error(tmp_path: Path) -> None:
    small_blender(tmp_path)
    scene = load_scene(tmp_path)
    small_blender(tmp_path, width=80, height=60)
    with pytest.raises(DataError, match="change"):
        scene.train[0].image()


def test_the_cache_drops_the_least_recently_used_and_never_exceeds_its_bound() -> None:
    cache = ImageCache(650)  # two pictures of 300 bytes
    made: list[int] = []

    def get(value: int) -> int:
        def decode() -> DecodedImage:
            made.append(value)
            return image(value)

        return int(cache.get(value, decode).image[0, 0, 0])

    assert [get(v) for v in (1, 2, 1, 3, 1, 2)] == [1, 2, 1, 3, 1, 2]
    assert made == [1, 2, 3, 2]  # 2 was older than 1 when 3 came
    assert (cache.nbytes, len(cache)) == (600, 2)
    tiny = ImageCache(299)
    tiny.get(1, lambda: image(1))
    assert (tiny.nbytes, len(tiny)) == (0, 0)


def test_dropped_images_come_from_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def get(cache: ImageCache, value: int) -> DecodedImage:
        def decode() -> DecodedImage:
            made.append(value)
            return replace(image(value), mask=np.full((10, 10), value % 2 == 0))

        return cache.get(value, decode)

    cache = ImageCache(900, spills=True)  # two images with masks
    first = [get(cache, value) for value in range(5)]
    again = [get(cache, value) for value in range(5)]
    assert made == [0, 1, 2, 3, 4]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.mask, other.mask)
        assert not other.image.flags.writeable
    cache.clear()
    get(cache, 0)
    assert made == [0, 1, 2, 3, 4]

    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    cache = ImageCache(0, spills=True)
    get(cache, 7)
    get(cache, 7)
    assert made[5:] == [7, 7]


@pytest.mark.parametrize("spills", [False, True])
def test_the_cache_is_safe_for_threads(spills: bool) -> None:
    cache = ImageCache(300 * 5, spills=spills)
    wrong: list[int] = []

    def work(seed: int) -> None:
        for value in np.random.default_rng(seed).integers(0, 20, 500).tolist():
            if cache.get(value, lambda v=value: image(v)).image[0, 0, 0] != value:
                wrong.append(value)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert not wrong
    assert cache.nbytes == 300 * len(cache) <= cache.max_bytes


def test_target_composites_straight_alpha_over_the_background() -> None:
    """Alpha 51/255 = 0.2 of red over blue: (0.2, 0, 0.8)."""
    image = np.zeros((30, 40, 4), np.uint8)
    image[..., 0], image[..., 3] = 255, 51
    target = View.from_arrays("a", ring(2)[0], image).target((0.0, 0.0, 1.0))
    assert target.dtype == np.float32
    np.testing.assert_allclose(target[3, 4], (0.2, 0.0, 0.8), atol=1e-6)
    opaque = View.from_arrays("a", ring(2)[0], image[..., :3])
    np.testing.assert_array_equal(opaque.target((0, 0, 1))[0, 0], (1, 0, 0))
    assert opaque.alpha() is None
    assert opaque.object_mask() is None


def test_extent_is_1_1_times_the_largest_distance_of_a_training_camera(tmp_path: Path) -> None:
    """A full ring of radius 4 has its mean on the axis: every camera is 4 away."""
    small_nerfstudio(tmp_path, count=8)
    assert load_scene(tmp_path, test_every=0).extent == pytest.approx(4.4)


def move_away(root: Path, index: int, factor: float) -> None:
    """Put one camera of a transforms.json so many times as far from the origin."""
    meta = json.loads((root / "transforms.json").read_text())
    for row in meta["frames"][index]["transform_matrix"][:3]:
        row[3] *= factor
    (root / "transforms.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("index", [4, 8])  # a training view, a test view
@pytest.mark.parametrize("factor", [1e3, 1e100])
def test_a_view_with_an_outlying_camera_is_named_and_left_out(tmp_path: Path, index: int, factor: float) -> None:
    small_nerfstudio(tmp_path, count=20)
    name = f"images/f_{index:02d}.png"
    right = load_scene(tmp_path)
    move_away(tmp_path, index, factor)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.train] == [v.name for v in right.train if v.name != name]
    assert [view.name for view in scene.test] == [v.name for v in right.test if v.name != name]
    assert scene.extent == pytest.approx(right.extent, rel=0.1)
    np.testing.assert_allclose(scene.bounds, right.bounds, atol=0.5)
    (line,) = scene.skipped
    assert line.startswith(f"{name} is left out: its camera is ")
