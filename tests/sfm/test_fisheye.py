"""Fisheye images with unknown lens: detection by image circle, by names, and by matches."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.wide_captures import errors, write_photographs
from PIL import Image

from gs2d.core.camera import look_at
from gs2d.core.json_files import read_json
from gs2d.data import load_scene
from gs2d.data.image_files import read_mask
from gs2d.data.readers.colmap import read_cameras, read_images
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.sfm import as_fisheye
from gs2d.sfm.fisheye import Circle, circle_of, small_if_dark
from gs2d.sfm.lens_probe import probe
from gs2d.sfm.photo_masks import copy_masks
from gs2d.sfm.photos import Photo, find_photos, read_photos
from gs2d.training.events import Event, Notice

SIZE = (400, 300)
F = 150.0


# -- the circle --------------------------------------------------------------------------------------------------------
def mottled(size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    """Return an image without dark areas, uint8 [H, W, 3]."""
    return np.random.default_rng(seed).integers(40, 255, (size[1], size[0], 3)).astype(np.uint8)


def round_picture(x: float, y: float, radius: float, size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    """Return a fisheye image: noise inside a circle (px), and traces of stray light outside."""
    v, u = np.mgrid[: size[1], : size[0]] + 0.5
    light = np.clip(radius - np.hypot(u - x, v - y) + 0.5, 0, 1)[..., None]
    stray = np.random.default_rng(seed + 1).integers(0, 8, (size[1], size[0], 3))
    return np.rint(light * mottled(size, seed) + (1 - light) * stray).astype(np.uint8)


def found(*pictures: np.ndarray) -> Circle | None:
    return circle_of([small_if_dark(picture) for picture in pictures])


@pytest.mark.parametrize(
    ("x", "y", "radius"),
    [(200, 150, 149), (200, 150, 200), (215, 142, 130), (195, 153, 212)],
    ids=["in the height", "in the width", "off the middle", "beyond the width"],
)
def test_the_image_circle_is_detected(x: float, y: float, radius: float) -> None:
    circle = found(*(round_picture(x, y, radius, seed=seed) for seed in range(3)))
    assert circle is not None
    assert (circle.x * 400, circle.y * 300, circle.radius * 400) == pytest.approx((x, y, radius), abs=2)
    inside = circle.inside(*SIZE)
    v, u = np.mgrid[:300, :400] + 0.5
    assert not inside[np.hypot(u - x, v - y) > radius].any()
    assert inside[np.hypot(u - x, v - y) < 0.95 * radius].all()


def test_other_dark_areas_are_no_circle() -> None:
    """A frame, a statue rotating before black velvet, and a round plate smaller than any fisheye's circle."""
    framed = np.zeros((300, 400, 3), np.uint8)
    framed[40:-40, 60:-60] = mottled()[40:-40, 60:-60]
    statues = []
    for seed in range(4):
        statue = np.zeros((300, 400, 3), np.uint8)
        statue[30:290, 150 - 10 * seed : 230 + 5 * seed] = 120
        statue[60:120, 120:260] = 90
        statues.append(statue)
    assert found(framed) is None
    assert found(*statues) is None
    assert found(round_picture(200, 150, 90)) is None


def photos_of(root: Path, images: dict[str, np.ndarray]) -> list[Photo]:
    for name, image in images.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(root / name)
    return list(read_photos(find_photos(root)[0], root, threads=1))


def test_pixels_outside_the_circle_are_masked(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "photos", {f"{i}.png": round_picture(200, 150, 149, seed=i) for i in range(3)})
    own = np.full((300, 400), 255, np.uint8)
    own[150:] = 0
    Image.fromarray(own).save(tmp_path / "own.png")
    circle = Circle(0.5, 0.5, 149 / 400)
    circles = {"0.png": circle, "1.png": circle}
    assert copy_masks(photos, [tmp_path / "own.png", None, None], tmp_path / "masks", 200, circles) == 2
    both, alone = (read_mask(tmp_path / "masks" / f"{i}.png.png") for i in range(2))
    assert both.shape == alone.shape == (150, 200)
    assert (alone == circle.inside(200, 150)).all()
    assert (both == alone & (np.arange(150) < 75)[:, None]).all()


# -- evidence in matches -----------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def pycolmap(colmap: None) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


class _Database:
    """Matches between images of random points through a lens, with 0.3 px noise and a tenth of outliers."""

    def __init__(self, pycolmap: Any, model: str, params: tuple[float, ...], *, count: int = 4) -> None:
        rng = np.random.default_rng(0)
        lens = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=list(params))
        points = rng.normal(size=(900, 3))
        points *= rng.uniform(2, 5, (900, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
        self._seen, self._pycolmap = [], pycolmap
        for i in range(count):
            eye = np.array([0.8 * i - 1.2, 0.3 * np.sin(2 * i), 0.2 * i])
            ahead = eye + np.array([0.3 * i - 0.4, 3.0, 0.0])
            T = look_at(eye, ahead, np.array([0, 0, 1.0]), width=8, height=8, fx=8).T_cam_world
            at = [lens.img_from_cam(T[:3, :3] @ p + T[:3, 3]) for p in points]
            places = np.array([np.full(2, np.nan) if p is None else p for p in at]) + rng.normal(0, 0.3, (900, 2))
            inside = ((places > 0) & (places < SIZE)).all(axis=1)
            self._seen.append(np.where(inside[:, None], places, np.nan))
        self._rng = rng

    def read_all_images(self) -> list[Any]:
        return [SimpleNamespace(image_id=i + 1, camera_id=1) for i in range(len(self._seen))]

    def read_two_view_geometry_num_inliers(self) -> tuple[list[int], list[int]]:
        pairs = [(i, j) for j in range(len(self._seen)) for i in range(j)]
        numbers = [self._pycolmap.image_pair_to_pair_id(i + 1, j + 1) for i, j in pairs]
        return numbers, [len(self.read_matches(i + 1, j + 1)) for i, j in pairs]

    def read_matches(self, first: int, second: int) -> np.ndarray:
        both = np.flatnonzero(np.isfinite(self._seen[first - 1] + self._seen[second - 1]).all(axis=1))
        other = both.copy()
        other[::10] = np.roll(both, 7)[::10]
        return np.stack([both, other], axis=1).astype(np.uint32)

    def read_keypoints(self, image: int) -> np.ndarray:
        return np.nan_to_num(self._seen[image - 1]).astype(np.float32)


@pytest.mark.parametrize(
    ("model", "params", "focal"),
    [
        ("SIMPLE_RADIAL_FISHEYE", (F, 200, 150, 0.02), F),  # 153 degrees from left to right
        ("SIMPLE_FISHEYE", (240.0, 200, 150), 240.0),  # 119 degrees from corner to corner
        ("SIMPLE_PINHOLE", (300.0, 200, 150), None),
        ("SIMPLE_RADIAL", (330.0, 200, 150, -0.1), None),  # a phone
    ],
)
def test_matches_determine_a_fisheye_and_its_focal_length(
    pycolmap: Any, model: str, params: tuple[float, ...], focal: float | None
) -> None:
    camera = pycolmap.Camera(model="SIMPLE_FISHEYE", width=SIZE[0], height=SIZE[1], params=[F, 200, 150], camera_id=1)
    result = probe(pycolmap, _Database(pycolmap, model, params), camera, reach=250.0, seed=0)
    assert result is not None
    assert 0.5 < result.plain <= 0.95
    assert result.is_fisheye is (focal is not None)
    if focal is not None:
        assert result.focal == pytest.approx(focal, rel=0.12)
        assert result.bent > 0.85


@pytest.mark.parametrize(
    ("model", "params", "placed", "error", "is_doubted"),
    [
        (
            "SIMPLE_RADIAL",
            (330.0, 200, 150, -0.05),
            10,
            0.6,
            False,
        ),  # an ordinary camera: no test needed, no time lost
        ("SIMPLE_RADIAL", (330.0, 200, 150, 0.1), 5, 0.6, False),
        ("SIMPLE_RADIAL", (330.0, 200, 150, -0.05), 4, 0.6, True),
        ("SIMPLE_RADIAL", (330.0, 200, 150, -0.05), 10, 1.1, True),
        ("SIMPLE_RADIAL", (330.0, 200, 150, -0.2), 10, 0.6, True),  # the lens moves the corner by 11 %
        ("SIMPLE_RADIAL", (90.0, 200, 150, -0.01), 10, 0.6, True),  # 132 degrees
    ],
)
def test_placed_images_can_raise_doubts_about_a_camera(
    pycolmap: Any, model: str, params: tuple[float, ...], placed: int, error: float, is_doubted: bool
) -> None:
    lens = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=list(params), camera_id=1)
    piece = SimpleNamespace(
        cameras={1: lens},
        camera={1: lens}.__getitem__,
        images={i: SimpleNamespace(has_pose=i < placed, camera_id=1) for i in range(10)},
        compute_mean_reprojection_error=lambda: error,
    )
    assert as_fisheye._is_doubted(piece, 1, 10) is is_doubted
    assert as_fisheye._is_doubted(piece, 2, 10)
    assert as_fisheye._is_doubted(None, 1, 10)


# -- whole searches ----------------------------------------------------------------------------------------------------
def searched(root: Path, **options: Any) -> tuple[dict[str, Any], list[str]]:
    notices: list[str] = []

    def note(event: Event) -> None:
        notices.extend([event.text] if isinstance(event, Notice) else [])

    poses = PosesOptions(photos=root / "photos", out=root / "capture", threads=2, feature_size=320, **options)
    return find_poses(poses, note), notices


@pytest.mark.slow
def test_round_photographs_of_185_degrees_are_placed_masked_and_cut_into_faces(colmap: None, tmp_path: Path) -> None:
    """Measured at 16 of 800 px: an error of 0.4 mm in a room of 4 m."""
    truth = write_photographs(tmp_path / "photos", "fisheye", count=8, width=480, angle=185, fits="height", off=(8, -6))
    made, notices = searched(tmp_path)
    off = errors(tmp_path / "capture", truth)
    assert off["placed"] == 8
    assert off["centres_worst_m"] < 0.01
    assert off["turned_worst_degrees"] < 0.3
    assert made["lens"]["chosen"].endswith("_FISHEYE")
    assert made["lens"]["fisheyes"][0]["why"] == "circle"
    assert read_json(tmp_path / "capture/poses.json")["lens"] == made["lens"]
    assert any("(round images)" in line for line in notices)
    assert made["masks"] == 8  # the command may overwrite these
    assert searched(tmp_path, overwrite=True)[0]["lens"] == made["lens"]
    (camera,) = read_cameras(tmp_path / "capture/sparse/0", "bin").values()
    assert camera.params[1:3] == pytest.approx((248, 174), abs=1.5)
    for image in read_images(tmp_path / "capture/sparse/0", "bin", observations=True):
        assert image.observations is not None
        assert np.hypot(*(image.observations - camera.params[1:3]).T).max() < 180
    scene = load_scene(tmp_path / "capture", test_every=0)
    assert {view.name.split("_")[1] for view in scene.views} == {
        f"{f}.jpg" for f in ("front", "right", "left", "up", "down")
    }


@pytest.mark.slow
@pytest.mark.parametrize("camera_model", ["auto", "OPENCV_FISHEYE"])
def test_full_frame_fisheyes_are_detected_by_matches(colmap: None, tmp_path: Path, camera_model: str) -> None:
    truth = write_photographs(tmp_path / "photos", "fisheye", count=8, width=480, angle=150, fits="diagonal")
    made, _ = searched(tmp_path, camera_model=camera_model)
    off = errors(tmp_path / "capture", truth)
    assert off["placed"] == 8
    assert off["centres_worst_m"] < 0.01
    assert off["turned_worst_degrees"] < 0.3
    assert made["lens"]["fisheyes"][0]["why"] == ("doubt" if camera_model == "auto" else "asked")
    assert made["cameras"][0]["focal_px"] == pytest.approx(224, rel=0.02)
    assert not (tmp_path / "capture/masks").exists()
