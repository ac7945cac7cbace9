"""Prepared images equal decoded ones; files are checked, and an interrupted preparation continues."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import small_colmap
from gs2d.data import Scene, View, load_scene
from gs2d.data.prepared import (
    AHEAD,
    Stored,
    delete_unused,
    missing_views,
    prepare,
    prepared_scene,
    read_prepared,
    write_prepared,
)
from gs2d.errors import DataError


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Distorted lenses and some masks."""
    root = tmp_path / "capture"
    model = small_colmap(root, count=6)
    camera = next(iter(model.cameras))
    name, width, height, params = model.cameras[camera]
    assert name == "PINHOLE"
    model.cameras[camera] = ("OPENCV", width, height, (*params, 0.3, 0.02, 0.0, 0.001))
    model.write(root / "sparse/0")
    (root / "masks").mkdir()
    for k in range(3):
        Image.fromarray((np.arange(30 * 40).reshape(30, 40) % (k + 7) > 1).astype(np.uint8) * 255).save(
            root / f"masks/{k}.png.png"
        )
    return root


def loaded(capture: Path, downscale: int = 1) -> Scene:
    return load_scene(capture, downscale=downscale, test_every=3)


def stored(view: View) -> Stored:
    assert isinstance(view.decode, Stored)
    return view.decode


def ready(capture: Path, folder: Path, downscale: int = 1) -> Scene:
    scene = prepared_scene(loaded(capture, downscale), folder)
    folder.mkdir(exist_ok=True)
    assert len(list(prepare(missing_views(scene), 2))) == len(scene.views)
    return scene


def assert_same_pictures(one: Scene, other: Scene) -> None:
    for a, b in zip(one.views, other.views, strict=True):
        np.testing.assert_array_equal(a.image(), b.image())
        for what in ("mask", "valid", "object_mask"):
            first, second = getattr(a, what)(), getattr(b, what)()
            assert (first is None) == (second is None)
            if first is not None:
                np.testing.assert_array_equal(first, second)
                assert first.dtype == second.dtype == bool


@pytest.mark.parametrize("downscale", [1, 2])
def test_prepared_images_and_masks_equal_decoded_ones(capture: Path, tmp_path: Path, downscale: int) -> None:
    scene = ready(capture, tmp_path / "prepared", downscale)
    assert scene.ahead == AHEAD
    assert missing_views(scene) == []
    for path in (capture / "images").iterdir():  # nothing but the prepared files is read
        path.rename(path.with_suffix(".gone"))
    pictures = [view.image().copy() for view in scene.views]
    for path in (capture / "images").iterdir():
        path.rename(path.with_suffix(".png"))
    for view, picture in zip(loaded(capture, downscale).views, pictures, strict=True):
        np.testing.assert_array_equal(view.image(), picture)
    scene.forget()
    assert_same_pictures(scene, loaded(capture, downscale))
    assert any(view.valid() is not None for view in scene.views)  # the lens leaves corners unknown


def test_an_interrupted_preparation_continues_and_a_changed_photograph_is_prepared_again(
    capture: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "prepared"
    scene = ready(capture, folder)
    first, second = (stored(view).file for view in scene.views[:2])
    first.unlink()
    times = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    (folder / ".abc.prepared.77.gs2d.tmp").write_bytes(b"half")
    changed = scene.views[1].path
    assert changed is not None
    Image.fromarray(np.full((30, 40, 3), 77, np.uint8)).save(changed)
    again = prepared_scene(loaded(capture), folder)
    missing = missing_views(again)
    assert [view.name for view in missing] == [scene.views[0].name, scene.views[1].name]
    delete_unused(again, folder)
    assert not second.exists()
    list(prepare(missing, 1))
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir() if path in times and path != first} == {
        path: time for path, time in times.items() if path not in (first, second)
    }
    assert len(list(folder.iterdir())) == len(scene.views)
    assert_same_pictures(again, loaded(capture))


def test_a_damaged_file_is_ignored_and_the_photograph_is_decoded(capture: Path, tmp_path: Path) -> None:
    scene = ready(capture, tmp_path / "prepared")
    expected = [view.image().copy() for view in loaded(capture).views]
    for at, view in enumerate(scene.views):
        file = stored(view).file
        data = bytearray(file.read_bytes())
        data[len(data) * (at + 2) // 10] ^= 4
        file.write_bytes(data if at % 2 else data[: len(data) * (at + 1) // 8])
        assert read_prepared(file) is None
    for view, picture in zip(scene.views, expected, strict=True):
        np.testing.assert_array_equal(view.image(), picture)


def test_a_photograph_that_does_not_decode_is_an_error_of_one_line(capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "prepared"
    folder.mkdir()
    scene = prepared_scene(loaded(capture), folder)
    broken = scene.views[-1].path
    assert broken is not None
    broken.write_bytes(broken.read_bytes()[:-40])
    with pytest.raises(DataError, match=f"image {broken} does not decode: .*; replace or remove the file"):
        list(prepare(missing_views(scene), 2))
    assert not any(path.name.endswith(".gs2d.tmp") for path in folder.iterdir())


def test_views_of_third_party_readers_are_unchanged(capture: Path, tmp_path: Path) -> None:
    scene = loaded(capture)
    view = scene.train[0]
    picture = view._image()
    own = replace(scene, train=(replace(view, decode=lambda: picture), *scene.train[1:]))
    assert prepared_scene(own, tmp_path).train[0] is own.train[0]
    write_prepared(tmp_path / "x.prepared", picture)
    assert read_prepared(tmp_path / "x.prepared") is not None
