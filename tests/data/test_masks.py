"""Masks of captures: folders of common tools, and the meaning of black pixels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import small_blender, small_colmap, small_dtu, small_nerfstudio
from foreign_writers import small_alicevision, small_metashape, small_opensfm
from gs2d.data import Scene, load_scene
from gs2d.errors import DataError

HALF = np.where(np.arange(40) < 20, 255, 0).astype(np.uint8)[None].repeat(30, axis=0)  # the left half is kept


def write(path: Path, pixels: np.ndarray = HALF) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def masked_names(scene: Scene) -> list[str]:
    return [view.name for view in scene.views if view.mask() is not None and not view.mask()[:, 25:].any()]


@pytest.mark.parametrize(
    ("make", "mask", "view"),
    [
        (small_colmap, "masks/3.png.png", "3.png"),
        (small_colmap, "masks/3_mask.png", "3.png"),
        (small_colmap, "images/3_mask.png", "3.png"),
        (small_nerfstudio, "masks/f_03.png", "images/f_03.png"),
        (small_nerfstudio, "masks/images/f_03.png.png", "images/f_03.png"),
        (small_nerfstudio, "images/f_03_mask.png", "images/f_03.png"),
        (small_blender, "masks/train/r_1.png", "train/r_1.png"),
        (small_opensfm, "masks/a_1.jpg.png", "a_1.jpg"),
        (small_metashape, "masks/IMG_1_mask.png", "IMG_1.jpg"),
        (small_metashape, "masks/IMG_1.png", "IMG_1.jpg"),
        (small_alicevision, "masks/IMG_1.png", "IMG_1.jpg"),
    ],
)
def test_masks_are_found_in_the_folders_of_common_tools(
    tmp_path: Path, make: Callable[[Path], object], mask: str, view: str
) -> None:
    make(tmp_path)
    names = [view.name for view in load_scene(tmp_path).views]
    if view not in names:  # the writers name photographs as their tools do
        view = sorted(names)[1]
        mask = mask.replace(Path(mask).name.split("_mask")[0].split(".")[0], Path(view).stem)
    write(tmp_path / mask)
    scene = load_scene(tmp_path)
    assert masked_names(scene) == [view]
    assert scene.masks.found == 1
    assert any(f"masks: 1 of {len(names)} views have one in" in note for note in scene.notes)
    assert sorted(view.name for view in scene.views) == sorted(names)


@pytest.mark.parametrize("masked", ["ignore", "empty", "off"])
def test_an_ineffective_masked_option_is_reported(tmp_path: Path, masked: str) -> None:
    small_dtu(tmp_path / "scan")
    small_colmap(tmp_path / "bare")
    scene, plain = load_scene(tmp_path / "scan", masked=masked), load_scene(tmp_path / "scan")
    line = (
        f"masks: --masked {masked} has no effect: format dtu has silhouettes, which only limit the surface "
        "(--masks DIR sets masks)"
    )
    assert set(scene.notes) - set(plain.notes) == {line}
    assert not any("has no effect" in note for note in plain.notes)
    for view, same in zip(scene.views, plain.views, strict=True):
        assert view.alpha() is None
        assert view.mask() is None
        silhouette, before = view.object_mask(), same.object_mask()
        assert silhouette is not None
        assert before is not None
        assert np.array_equal(silhouette, before)
    notes = [note for note in load_scene(tmp_path / "bare", masked=masked).notes if note.startswith("masks:")]
    none = f"masks: none of 9 views has one in masks (a/b.jpg.png for a/b.jpg): --masked {masked} has no effect"
    assert notes == ([] if masked == "off" else [none])  # without masks, `off` changes nothing


def test_empty_makes_an_alpha_channel_of_the_mask_in_every_view(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    write(tmp_path / "masks" / "3.png")
    scene = load_scene(tmp_path, masked="empty")
    views = {view.name: view for view in scene.views}
    alpha, whole = views["3.png"].alpha(), views["4.png"].alpha()
    assert alpha is not None
    assert whole is not None
    assert (alpha[:, :20] == 1).all()
    assert (alpha[:, 20:] == 0).all()
    assert (whole == 1).all()
    assert views["3.png"].mask() is None
    assert (views["3.png"].target((0.25, 0.5, 0.75))[:, 20:] == (0.25, 0.5, 0.75)).all()
    outside = views["3.png"].object_mask()
    assert outside is not None
    assert not outside[:, 20:].any()
    assert any("(white = keep, the rest is empty)" in note for note in scene.notes)


def test_masks_of_another_size_are_scaled_and_of_another_shape_refused(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    write(tmp_path / "masks" / "3.png", HALF.repeat(2, axis=0).repeat(2, axis=1))
    assert masked_names(load_scene(tmp_path)) == ["3.png"]
    write(tmp_path / "masks" / "3.png", HALF[:, :30])
    with pytest.raises(DataError, match="aspect"):
        load_scene(tmp_path)


def test_a_folder_without_matching_masks_and_an_invalid_option_are_errors(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    (tmp_path / "none").mkdir()
    with pytest.raises(DataError, match=r"png\.png"):
        load_scene(tmp_path, masks=tmp_path / "none")
    with pytest.raises(DataError, match="must be the folder"):
        load_scene(tmp_path, masks=tmp_path / "missing")
    with pytest.raises(DataError, match="masked"):
        load_scene(tmp_path, masked="black")
