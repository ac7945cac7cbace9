"""360-degree panoramas without poses: detection, pose estimation, and training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.wide_captures import (
    HIGH,
    LOW,
    errors,
    photograph,
    walk,
    walls,
    write_photographs,
)
from PIL import Image

from gs2d.cli import run
from gs2d.config.recipe import DenseStart
from gs2d.core.camera import Camera
from gs2d.core.json_files import read_json
from gs2d.core.similarity import apply, umeyama
from gs2d.data import load_scene
from gs2d.data.readers.colmap import read_cameras
from gs2d.errors import DataError
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.sfm.photos import Photo, camera_groups, find_photos, panorama_groups, read_photos
from gs2d.training.events import Event, Notice
from gs2d.training.start.plane_sweep import sweep_views
from gs2d.training.start.start_points import start_points

WIDTH = 768
WHOLE = (
    '<rdf:Description GPano:ProjectionType="equirectangular" GPano:CroppedAreaImageWidthPixels="128" '
    'GPano:FullPanoWidthPixels="128" GPano:CroppedAreaImageHeightPixels="64" GPano:FullPanoHeightPixels="64"/>'
)


def photos_of(root: Path, images: dict[str, tuple[np.ndarray, str]]) -> list[Photo]:
    for name, (image, xmp) in images.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(root / name, quality=92, **({"xmp": xmp.encode()} if xmp else {}))
    return list(read_photos(find_photos(root)[0], root, threads=1))


def groups_of(photos: list[Photo], camera_model: str = "auto") -> tuple[list[bool], list[str]]:
    groups = camera_groups(photos, [photo.size for photo in photos], "auto")
    return panorama_groups(photos, groups, camera_model)


def test_panoramas_are_recognised_by_their_metadata(tmp_path: Path) -> None:
    flat = np.random.default_rng(0).integers(0, 255, (64, 128, 3)).astype(np.uint8)
    images = {"a/1.jpg": (flat, WHOLE), "b/1.jpg": (flat, ""), "c/1.jpg": (flat[:50], "")}
    photos = photos_of(tmp_path, images)
    found, lines = groups_of(photos)
    assert found == [True, False, False]
    assert lines[0] == "1 photographs are 360-degree panoramas: each has one pose, and is trained as several faces"
    assert lines[1].startswith("1 photographs have an aspect ratio of 2:1, but no XMP tag")
    assert groups_of(photos, "OPENCV") == ([False] * 3, [])
    assert groups_of(photos[:2], "EQUIRECTANGULAR")[0] == [True, True]
    with pytest.raises(DataError, match="panorama"):
        groups_of(photos, "EQUIRECTANGULAR")


@pytest.fixture(scope="module")
def panoramas(colmap: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray], list[str]]:
    """Return a capture of seven panoramas, their true poses, and the command's output."""
    root = tmp_path_factory.mktemp("panoramas")
    truth = write_photographs(root / "photos", "panorama", count=7, width=WIDTH)
    (root / "photos" / "masks").mkdir()
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[-60:] = 0  # the person holding the camera
    for name in truth:
        Image.fromarray(mask).save(root / "photos" / "masks" / f"{name}.png")
    notices: list[str] = []

    def note(event: Event) -> None:
        notices.extend([event.text] if isinstance(event, Notice) else [])

    find_poses(PosesOptions(photos=root / "photos", out=root / "capture", threads=2), note)
    return root, truth, notices


def test_poses_of_panoramas_are_estimated(
    panoramas: tuple[Path, dict[str, np.ndarray], list[str]],
) -> None:
    """Measured: 0.3 mm in a room of 4 m, 0.02 degrees."""
    root, truth, notices = panoramas
    assert "7 photographs are 360-degree panoramas: each has one pose, and is trained as several faces" in notices
    found = errors(root / "capture", truth)
    assert found["placed"] == 7
    assert found["centres_worst_m"] < 0.003
    assert found["turned_worst_degrees"] < 0.1
    (camera,) = read_cameras(root / "capture/sparse/0", "bin").values()
    assert (camera.model, camera.params) == ("EQUIRECTANGULAR", (WIDTH, WIDTH / 2))


@pytest.mark.slow
def test_panoramas_and_photographs_of_a_room_are_placed_together(colmap: None, tmp_path: Path) -> None:
    truth = write_photographs(tmp_path / "photos" / "around", "panorama", count=6, width=WIDTH)
    truth = {f"around/{name}": pose for name, pose in truth.items()}
    patterns = walls()
    for i, pose in enumerate(walk(6, tilt=3, turn=25, seed=1)):
        camera = Camera(400, 300, 300.0, 300.0, 200.0, 150.0, pose)
        name = f"plain/{i:03}.jpg"

        def rays(u: np.ndarray, v: np.ndarray, c: Camera = camera) -> np.ndarray:
            return np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy, np.ones_like(u)], axis=-1)

        (tmp_path / "photos" / "plain").mkdir(exist_ok=True)
        Image.fromarray(photograph(patterns, pose, rays, (400, 300))).save(tmp_path / "photos" / name, quality=95)
        truth[name] = pose
    made = find_poses(PosesOptions(photos=tmp_path / "photos", out=tmp_path / "capture", threads=2))
    assert {camera["model"] == "EQUIRECTANGULAR" for camera in made["cameras"]} == {True, False}
    found = errors(tmp_path / "capture", truth)
    assert found["placed"] == 12
    assert found["centres_worst_m"] < 0.01
    assert found["turned_worst_degrees"] < 0.3


def test_training_starts_from_points_on_the_walls(
    panoramas: tuple[Path, dict[str, np.ndarray], list[str]],
) -> None:
    root, truth, _ = panoramas
    scene = load_scene(root / "capture", test_every=0)
    sweep = sweep_views(scene, DenseStart())
    whole = [view.name.split("_")[0] for view in scene.train]
    assert all(whole[j] != whole[i] for i, others in enumerate(sweep.neighbours) for j in others)
    found = start_points(scene, sweep, DenseStart()).points
    assert len(found) > 3 * read_json(root / "capture/poses.json")["points"]
    mine = {view.name: view.camera.center for view in scene.train}
    names = sorted(truth)
    centers = np.stack([mine[name.replace(".", "_front.")] for name in names])
    there = np.stack([-truth[name][:3, :3].T @ truth[name][:3, 3] for name in names])
    places = apply(umeyama(centers, there), found)
    off = np.abs(np.concatenate([places - LOW, places - HIGH], axis=1)).min(axis=1)
    assert (off < 0.03).mean() > 0.9


@pytest.mark.slow
def test_panoramas_become_a_run(colmap: None, tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos", "panorama", count=6, width=384)
    words = ["--threads", "2", "--quality", "draft", "--schedule-scale", "0.002", "--test-every", "3", "--quiet"]
    assert run(["reconstruct", str(tmp_path / "photos"), "--out", str(tmp_path / "run"), *words]) == 0
    (stage,) = read_json(tmp_path / "run/metrics.json")["stages"]
    assert stage["test"]["psnr"] > 15
