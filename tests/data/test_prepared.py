"""Prepared photographs: the same pictures, from files that are checked, resumed and made by several processes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import small_colmap
from gs2d.data import Scene, View, load_scene
from gs2d.data import prepare as preparing
from gs2d.data.prepare import prepare
from gs2d.data.prepared import (
    AHEAD,
    Stored,
    forget_others,
    missing_views,
    prepared_scene,
    read_prepared,
    write_prepared,
)
from gs2d.errors import DataError


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Bent lenses, masks, one picture with alpha."""
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
def test_prepared_pictures_and_masks_are_those_of_the_photographs_bit_for_bit(
    capture: Path, tmp_path: Path, downscale: int
) -> None:
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


def test_what_was_broken_off_is_gone_on_with_and_a_changed_photograph_is_prepared_again(
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
    forget_others(again, folder)
    assert not second.exists()
    list(prepare(missing, 1))
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir() if path in times and path != first} == {
        path: time for path, time in times.items() if path not in (first, second)
    }
    assert len(list(folder.iterdir())) == len(scene.views)
    assert_same_pictures(again, loaded(capture))


def test_a_damaged_file_is_as_none_and_the_photograph_is_read_instead(capture: Path, tmp_path: Path) -> None:
    scene = ready(capture, tmp_path / "prepared")
    expected = [view.image().copy() for view in loaded(capture).views]
    for at, view in enumerate(scene.views):
        file = stored(view).file
        data = bytearray(file.read_bytes())
        data[len(data) * (at + 1) // 8] ^= 4  # the first ones in the header, the last in the pixels
        file.write_bytes(data if at % 2 else data[: -at - 1])
        assert read_prepared(file, stored(view).key) is None
    for view, picture in zip(scene.views, expected, strict=True):
        np.testing.assert_array_equal(view.image(), picture)


def test_several_processes_write_the_same_files(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = ready(capture, tmp_path / "here")
    monkeypatch.setattr(preparing, "MANY_PIXELS", 0)
    there = ready(capture, tmp_path / "there")
    files = [[stored(view).file.read_bytes() for view in scene.views] for scene in (here, there)]
    assert files[0] == files[1]


def test_a_photograph_that_does_not_decode_in_a_process_is_one_line_and_the_others_stay(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparing, "MANY_PIXELS", 0)
    folder = tmp_path / "prepared"
    folder.mkdir()
    scene = prepared_scene(loaded(capture), folder)
    broken = scene.views[-1].path
    assert broken is not None
    broken.write_bytes(broken.read_bytes()[:-40])
    with pytest.raises(DataError, match=f"image {broken} does not decode: .*; replace or remove the file"):
        list(prepare(missing_views(scene), 2))
    assert not any(path.name.endswith(".gs2d.tmp") for path in folder.iterdir())


def test_a_reader_from_elsewhere_keeps_its_views_as_they_are(capture: Path, tmp_path: Path) -> None:
    scene = loaded(capture)
    view = scene.train[0]
    picture = view._image()
    own = replace(scene, train=(replace(view, decode=lambda: picture), *scene.train[1:]))
    assert prepared_scene(own, tmp_path).train[0] is own.train[0]
    assert write_prepared(tmp_path / "x.prepared", "k", picture) > 0
