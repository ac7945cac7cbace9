"""Masks of images without poses: found, rotated with the images, and passed to COLMAP."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gs2d.data import load_scene
from gs2d.data.image_files import read_mask
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.sfm.copies import copy_masks, masks_of
from gs2d.sfm.photos import Photo, find_photos, read_photos
from gs2d.sfm.workspace import hidden_workspace
from gs2d.training.events import Event, Notice
from room_photos import turn_file, write_room


def write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def photos(root: Path) -> list[Photo]:
    return list(read_photos(find_photos(root)[0], root, threads=1))


def folder_of(root: Path, names: tuple[str, ...] = ("a.png", "b.png", "c.png")) -> Path:
    for name in names:
        write(root / name, np.full((16, 24, 3), 90, np.uint8))
    return root


@pytest.mark.parametrize(
    "place",
    ["photos/masks/a.png.png", "photos/masks/a.png", "masks/a.png", "photos/a_mask.png", "photos/masks/a_mask.png"],
)
def test_masks_of_common_tools_are_found(tmp_path: Path, place: str) -> None:
    root = folder_of(tmp_path / "photos")
    write(tmp_path / place, np.full((16, 24), 255, np.uint8))
    found = photos(root)
    assert [photo.name for photo in found] == ["a.png", "b.png", "c.png"]
    masks, line = masks_of(found, root, None)
    assert masks == [tmp_path / place, None, None]
    assert line.startswith("masks: 1 of 3 views have one in ")
    assert line.endswith("; the other 2 are whole")


def test_masks_are_rotated_and_downscaled_with_their_photograph(tmp_path: Path) -> None:
    write_room(tmp_path / "photos", 3)
    turn_file(tmp_path / "photos" / "001.jpg", 6)  # stored rotated
    for name in ("000", "001", "002"):
        with Image.open(tmp_path / "photos" / f"{name}.jpg") as image:
            pixels = np.asarray(image.resize((150, 200)))  # not square, so that the orientation is detectable
            exif = image.getexif()
        Image.fromarray(pixels).save(tmp_path / "photos" / f"{name}.jpg", exif=exif)
        mask = np.zeros((200, 150), np.uint8)
        mask[:50] = 255  # the top of the stored pixels
        write(tmp_path / "photos" / "masks" / f"{name}.jpg.png", mask)
    found = photos(tmp_path / "photos")
    assert found[1].size == (200, 150)
    masks, _ = masks_of(found, tmp_path / "photos", None)
    assert copy_masks(found, masks, tmp_path / "out", 100) == 3
    straight, turned = (read_mask(tmp_path / "out" / f"{name}.jpg.png") for name in ("000", "001"))
    assert straight.shape == (100, 75)
    assert straight[:25].all()
    assert not straight[25:].any()
    assert turned.shape == (75, 100)  # orientation 6: the stored top is the right side
    assert turned[:, 75:].all()
    assert not turned[:, :75].any()


def features(database: Path) -> np.ndarray:
    """Return all feature positions in px, read as gs2d reads them, so that COLMAP can still open the file."""
    with contextlib.closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as connection:
        rows = connection.execute("SELECT cols, data FROM keypoints WHERE rows > 0").fetchall()
    return np.concatenate([np.frombuffer(data, np.float32).reshape(-1, cols)[:, :2] for cols, data in rows])


def test_masked_pixels_give_no_features(colmap: None, tmp_path: Path) -> None:
    write_room(tmp_path / "photos", 6)
    mask = np.full((200, 200), 255, np.uint8)
    mask[:, :40] = 0
    for i in range(6):
        write(tmp_path / "masks" / f"{i:03}.png", mask)
    found_features: list[np.ndarray] = []
    lines: list[str] = []

    def watch(event: Event) -> None:
        database = hidden_workspace(tmp_path / "capture") / "database.db"
        if getattr(event, "name", "") == "placing cameras" and not found_features:
            found_features.append(features(database))
        if isinstance(event, Notice):
            lines.append(event.text)

    options = {"photos": tmp_path / "photos", "out": tmp_path / "capture", "masks": tmp_path / "masks", "threads": 1}
    options["camera_model"] = "SIMPLE_PINHOLE"  # no step that adjusts the lens
    found = find_poses(PosesOptions(**options), watch)  # type: ignore[arg-type]
    assert found["placed"] == 6
    assert found["masks"] == 6
    assert (found_features[0][:, 0] >= 40).all()
    assert (found_features[0][:, 0] < 60).any()
    assert any(line.startswith("masks: 6 of 6 views have one in ") for line in lines)
    scene = load_scene(tmp_path / "capture", test_every=0)
    assert scene.masks.found == 6
    assert scene.train[0].mask() is not None
    found_features.clear()
    find_poses(PosesOptions(**options, match_masked=True, overwrite=True), watch)  # type: ignore[arg-type]
    assert (found_features[0][:, 0] < 40).any()
