"""Which files of a folder are images, how they are copied into the capture, and which share a camera. No COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from gs2d.core.camera import look_at
from gs2d.data.image_files import HEIF, read_image
from gs2d.errors import DataError
from gs2d.sfm.colmap_worker import up_direction
from gs2d.sfm.compare import near_pairs, neighbour_pairs, similar_pairs
from gs2d.sfm.copies import copy_images
from gs2d.sfm.photos import Photo, camera_groups, chronological_order, find_photos, read_photos, turn

DETAILS = ExifTags.IFD.Exif


def image(
    path: Path,
    *,
    size: tuple[int, int] = (24, 16),
    orientation: int = 1,
    model: str = "",
    focal: float = 0,
    time: str = "",
) -> None:
    """Write a JPEG or PNG with EXIF; its left half is red and its top is bright."""
    width, height = size
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[:, : width // 2, 0] = 200
    pixels[: height // 2] += 50
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if model:
        exif[ExifTags.Base.Model] = model
    if focal:
        exif.get_ifd(DETAILS)[ExifTags.Base.FocalLength] = focal
    if time:
        exif.get_ifd(DETAILS)[ExifTags.Base.DateTimeOriginal] = time
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif, **({"quality": 95} if path.suffix in (".jpg", ".JPG") else {}))


def photos_of(root: Path) -> list[Photo]:
    return list(read_photos(find_photos(root)[0], root, threads=1))


def test_photographs_in_subfolders_are_sorted_naturally(tmp_path: Path) -> None:
    for name in ("b/frame_10.jpg", "b/frame_2.jpg", "a 1.JPG", "c.png", ".hidden.jpg", ".git/d.jpg", "__MACOSX/e.jpg"):
        image(tmp_path / name)
    found, notes, warning = find_photos(tmp_path)
    assert warning == ""
    assert [path.relative_to(tmp_path).as_posix() for path in found] == [
        "a 1.JPG", "b/frame_2.jpg", "b/frame_10.jpg", "c.png"
    ]  # fmt: skip
    assert notes == ()


def test_names_in_the_capture_are_unique_without_white_space(tmp_path: Path) -> None:
    for name in ("a b.png", "a_b.png", "c.tif", "c.tif.png", "d\udcff.png"):
        image(tmp_path / name)
    names = {photo.label: photo.name for photo in photos_of(tmp_path)}
    assert names == {
        "a b.png": "a_b.png",
        "a_b.png": "_a_b.png",
        "c.tif": "c.tif.png",
        "c.tif.png": "_c.tif.png",
        "d\udcff.png": "d?.png",
    }


@pytest.mark.skipif(bool(HEIF), reason="a package for HEIC is installed")
def test_other_files_are_reported_with_a_remedy(tmp_path: Path) -> None:
    for i in range(3):
        image(tmp_path / f"{i}.jpg")
    for name in ("x.HEIC", "y.heic", "z.CR2", "clip.MOV", "notes.txt", "masks/0.jpg.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"?")
    found, notes, warning = find_photos(tmp_path)
    assert len(found) == 3
    assert warning == (
        "3 of 6 photographs cannot be read and are ignored: 2 HEIC (x.HEIC ...): pip install pi-heif (its wheel holds "
        "LGPL code), or convert them to JPEG (magick mogrify -format jpg *.heic); 1 CR2 (z.CR2): raw files are not "
        "supported; export JPEG or PNG from your photo program"
    )
    video, other = notes
    assert video == "clip.MOV was ignored: a video; use it as the input, or copy frames of it here"
    assert other == "notes.txt was ignored: no photographs"


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ((), "photographs"),
        (("0.jpg", "1.jpg"), "photographs"),
        pytest.param(("a.HEIC",), "pi-heif", marks=pytest.mark.skipif(bool(HEIF), reason="a package for HEIC is here")),
        (("a.CR2",), "raw files"),
        (("a.mp4",), "video"),
    ],
)
def test_a_folder_without_photographs_is_a_one_line_error(
    tmp_path: Path, names: tuple[str, ...], expected: str
) -> None:
    for name in names:
        image(tmp_path / name) if name.endswith(".jpg") else (tmp_path / name).write_bytes(b"?")
    with pytest.raises(DataError, match=expected) as caught:
        find_photos(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientations_match_pillow(tmp_path: Path, orientation: int) -> None:
    image(tmp_path / "a.png", orientation=orientation)
    with Image.open(tmp_path / "a.png") as file:
        expected = np.asarray(ImageOps.exif_transpose(file))
    got = turn(Image.fromarray(read_image(tmp_path / "a.png")), orientation)
    np.testing.assert_array_equal(np.asarray(got), expected)


def stage(root: Path, folder: Path, *, max_size: int | None = None, link: bool = False) -> list[str]:
    return list(copy_images(photos_of(root), folder, max_size=max_size, link=link, threads=1))


def test_upright_photographs_are_copied_unchanged(tmp_path: Path) -> None:
    root = tmp_path / "photos"
    for name in ("0.jpg", "sub/1.png", "2.jpg"):
        image(root / name)
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in root.rglob("*.*")}
    assert stage(root, tmp_path / "images") == ["copied"] * 3
    for path, (content, _) in before.items():
        assert (tmp_path / "images" / path.relative_to(root)).read_bytes() == content
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in root.rglob("*.*")} == before


def test_a_rotated_photograph_is_stored_upright_with_its_focal_length(tmp_path: Path) -> None:
    root = tmp_path / "photos"
    image(root / "0.jpg", size=(64, 48), orientation=6, model="phone", focal=4.25)
    image(root / "1.jpg", size=(64, 48), orientation=3)
    image(root / "2.png", size=(64, 48), orientation=8)
    assert stage(root, tmp_path / "images") == ["turned"] * 3
    for name, size in (("0.jpg", (48, 64)), ("1.jpg", (64, 48)), ("2.png", (48, 64))):
        with Image.open(root / name) as theirs, Image.open(tmp_path / "images" / name) as ours:
            assert ours.size == size
            assert ExifTags.Base.Orientation not in ours.getexif()
            assert ours.info.get("icc_profile") == theirs.info.get("icc_profile")
            upright = np.asarray(ImageOps.exif_transpose(theirs), float)
            assert np.abs(np.asarray(ours, float) - upright).mean() < 1.0  # one more JPEG compression, at quality 95
            if name == "0.jpg":
                assert ours.getexif()[ExifTags.Base.Model] == "phone"
                assert float(ours.getexif().get_ifd(DETAILS)[ExifTags.Base.FocalLength]) == 4.25


def test_photographs_of_one_folder_size_camera_and_focal_length_share_a_camera(tmp_path: Path) -> None:
    image(tmp_path / "0.jpg", model="A", focal=5)
    image(tmp_path / "1.jpg", model="A", focal=5)
    image(tmp_path / "2.jpg", model="A", focal=9)  # zoomed
    image(tmp_path / "3.jpg", model="B", focal=5)
    image(tmp_path / "4.jpg", size=(16, 24), model="A", focal=5, orientation=6)  # upright it is 24 x 16, like the first
    image(tmp_path / "5.jpg", size=(16, 24), model="A", focal=5)
    image(tmp_path / "sub/6.jpg", model="A", focal=5)
    photos = photos_of(tmp_path)
    sizes = [photo.size for photo in photos]
    assert camera_groups(photos, sizes, "auto") == [[0, 1, 4], [2], [3], [5], [6]]
    assert camera_groups(photos, sizes, "each") == [[i] for i in range(7)]
    with pytest.raises(DataError, match="--cameras"):
        camera_groups(photos, sizes, "one")
    assert camera_groups(photos[:4], sizes[:4], "one") == [[0, 1, 2, 3]]


# -- which way is up ---------------------------------------------------------------------------------------------------
def rotations(eyes: np.ndarray, target: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Return level cameras at ``eyes`` that look at ``target``, in a world rotated by ``world`` [3, 3]."""
    up = np.array([0.0, 0.0, 1.0])
    cameras = [look_at(eye, target, up, width=9, height=9, fx=9) for eye in eyes]
    return np.stack([camera.rotation @ world.T for camera in cameras])


def turned_world(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def test_up_is_estimated_from_tilted_cameras() -> None:
    """All cameras look down by 45 degrees from one side: the mean of their up vectors leans by more than 20."""
    angles = np.linspace(0, np.pi, 9)
    eyes = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(9, 2.0)], axis=1)
    world = turned_world(1)
    views = rotations(eyes, np.zeros(3), world)
    up, mean = up_direction(views), -views[:, 1].mean(axis=0)
    assert up is not None
    truth = world @ [0, 0, 1]
    assert np.degrees(np.arccos(min(1.0, up @ truth))) < 0.5
    assert np.degrees(np.arccos(mean @ truth / np.linalg.norm(mean))) > 20.0


# -- which pairs are matched -------------------------------------------------------------------------------------------
def test_each_image_is_paired_with_consecutive_and_distant_ones() -> None:
    """Overlap 3: offsets 1, 2, 3 and 2^0, 2^1, 2^2, i.e. 1, 2, 3, 4."""
    assert neighbour_pairs(6, 3) == {(i, j) for i in range(6) for j in range(i + 1, 6) if j - i <= 4}


def test_similar_images_are_paired() -> None:
    """Six images of one object and six of another, interleaved: images are paired within each group."""
    rng = np.random.default_rng(0)
    things = rng.integers(0, 255, (2, 200, 128))
    images = [np.clip(things[i % 2] + rng.normal(0, 9, (200, 128)), 0, 255).astype(np.uint8) for i in range(12)]
    pairs = similar_pairs(lambda i: images[i], 12, neighbours=3)
    assert len(pairs) >= 12
    assert all(i % 2 == j % 2 and i < j for i, j in pairs)
    assert similar_pairs(lambda i: images[i], 12, neighbours=3) == pairs


def flight(lines: int, shots: int) -> list[tuple[float, float, float]]:
    """Return drone positions: lines 30 m apart, flown back and forth, an image every 12 m, at a height of 80 m."""
    along = [12.0 * k for k in range(shots)]
    return [(x, 30.0 * line, 80.0) for line in range(lines) for x in (along if line % 2 == 0 else along[::-1])]


def test_near_images_are_on_the_same_and_adjacent_lines() -> None:
    places = flight(9, 20)
    pairs = near_pairs(places, 12)
    middle = 4 * 20 + 10  # on the fifth line
    others = {i if j == middle else j for i, j in pairs if middle in (i, j)}
    assert {other // 20 for other in others} == {3, 4, 5}
    assert max(np.linalg.norm(np.subtract(places[middle], places[other])) for other in others) < 45
    assert all(i < j for i, j in pairs)


def test_images_are_ordered_by_time_if_all_have_one(tmp_path: Path) -> None:
    """The counter in the names restarted at 0001, as in cameras after 9999."""
    for name, second in (("DSC_9998", 1), ("DSC_9999", 2), ("DSC_0001", 3), ("DSC_0002", 4)):
        image(tmp_path / f"{name}.jpg", time=f"2026:05:01 10:00:0{second}")
    photos = photos_of(tmp_path)
    order, by = chronological_order(photos)
    assert [photos[i].name for i in order] == ["DSC_9998.jpg", "DSC_9999.jpg", "DSC_0001.jpg", "DSC_0002.jpg"]
    assert by == "time"
    image(tmp_path / "DSC_0003.jpg")
    assert chronological_order(photos_of(tmp_path)) == ([0, 1, 2, 3, 4], "name")
