"""Pinhole faces of panoramas and wide fisheyes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import gs2d
from capture_writers import ColmapModel, opengl_camera_to_world, ring
from gs2d.core.camera import Camera
from gs2d.data import Scene, load_scene
from gs2d.data.camera_models import CAMERA_MODELS, CameraModel, Lens
from gs2d.data.faces import FACES, field_of_view
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

WIDTH = 256
FISHEYE = (0.02, -0.003, 0.0005, 0.0)


def sky(rays: np.ndarray) -> np.ndarray:
    """Colour [..., 3] in [0, 255] of rays of the world [..., 3]: smooth, and nowhere the same."""
    d = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    waves = np.sin(np.stack([3 * d[..., 0] + d[..., 1], 2 * d[..., 1] - d[..., 2], 3 * d[..., 2] + 0.5], axis=-1))
    return np.asarray(127 + 100 * waves)


def photographed(camera: Camera) -> np.ndarray:
    """Draw the sky as a pinhole camera sees it, uint8 [H, W, 3]."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    return np.rint(sky(rays @ camera.rotation)).astype(np.uint8)


def write_panorama(path: Path, camera: Camera, width: int = WIDTH) -> None:
    """Draw the sky around a camera: nerfstudio's formula, a column a longitude, the middle ahead."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
    latitude = (0.5 - (np.arange(width // 2) + 0.5) / (width // 2)) * math.pi  # up is positive
    a, b = np.meshgrid(longitude, latitude)
    rays = np.stack([np.sin(a) * np.cos(b), -np.sin(b), np.cos(a) * np.cos(b)], axis=-1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(sky(rays @ camera.rotation)).astype(np.uint8)).save(path)


def panoramas(root: Path, count: int = 9, **meta: object) -> list[Camera]:
    cameras = ring(count)
    frames = []
    for index, camera in enumerate(cameras):
        write_panorama(root / "images" / f"{index}.png", camera)
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": opengl_camera_to_world(camera)})
    data = {"camera_model": "EQUIRECTANGULAR", "w": WIDTH, "h": WIDTH // 2, **meta, "frames": frames}
    (root / "transforms.json").write_text(json.dumps(data))
    return cameras


def assert_faces_agree(scene: Scene, most: float) -> None:
    """Each pixel that a face shows has the colour that a pinhole camera with the face's pose and focal length sees."""
    for view in scene.views:
        valid = view.valid()
        shown = np.ones(view.image().shape[:2], dtype=bool) if valid is None else valid
        difference = np.abs(view.image().astype(float) - photographed(view.camera))[shown]
        assert shown.any(), view.name
        assert difference.max() <= most, view.name


def test_the_faces_of_a_panorama_equal_pinhole_images(tmp_path: Path) -> None:
    cameras = panoramas(tmp_path)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 54
    assert (
        "9 equirectangular photographs are cut into 54 pinhole faces of 90 degrees, so that nothing is lost"
        in scene.notes
    )
    assert all(view.whole is not None for view in scene.views)
    view = scene.train[0]
    assert (view.camera.width, view.camera.height, view.camera.fx) == (82, 82, 41.0)  # as fine as the panorama's middle
    assert all(view.valid() is None for view in scene.views)
    assert_faces_agree(scene, 2.0)  # levels: bilinear samples of rounded pixels
    by_name = {view.name: view for view in scene.views}
    for index, camera in enumerate(cameras):
        for face in FACES:
            np.testing.assert_allclose(by_name[f"images/{index}_{face}.png"].camera.center, camera.center, atol=1e-12)
        np.testing.assert_allclose(by_name[f"images/{index}_front.png"].camera.rotation, camera.rotation, atol=1e-12)
        np.testing.assert_allclose(by_name[f"images/{index}_right.png"].camera.forward, camera.rotation[0], atol=1e-12)
        np.testing.assert_allclose(by_name[f"images/{index}_down.png"].camera.forward, camera.rotation[1], atol=1e-12)


def test_faces_of_one_panorama_are_all_test_views_or_none(tmp_path: Path) -> None:
    panoramas(tmp_path)
    scene = load_scene(tmp_path, test_every=4)
    wholes = [{view.name.rsplit("_", 1)[0] for view in views} for views in (scene.train, scene.test)]
    assert wholes[1] == {"images/0", "images/4", "images/8"}
    assert not wholes[0] & wholes[1]
    assert len(scene.test) == 18


def test_masks_and_downscaled_faces_agree(tmp_path: Path) -> None:
    panoramas(tmp_path)
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[3 * WIDTH // 8 :] = 0  # the tripod: below 45 degrees
    for index in range(9):
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(mask).save(tmp_path / "masks" / f"{index}.png")
    scene = load_scene(tmp_path, downscale=2)
    assert scene.masks.found == 9
    kept = {view.name.rsplit("_", 1)[1]: view.mask() for view in scene.train}
    assert kept["up.png"] is None
    below = kept["down.png"]
    assert below is not None
    assert not below[15:26, 15:26].any()
    assert below.mean() < 0.35  # the corners look up to 54.7 degrees from the axis
    assert_faces_agree(scene, 3.0)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_panoramas_of_a_colmap_model_are_split_into_faces(tmp_path: Path, kind: str) -> None:
    model = ColmapModel(cameras={1: ("EQUIRECTANGULAR", WIDTH, WIDTH // 2, (WIDTH, WIDTH // 2))})
    for index, camera in enumerate(ring(4)):
        write_panorama(tmp_path / "images" / f"{index}.png", camera)
        model.images.append((index + 1, camera.T_cam_world, 1, f"{index}.png", []))
    model.write(tmp_path / "sparse/0", kind)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 24
    assert_faces_agree(scene, 4.0)
    for size, words in (((WIDTH, 9.0), "must have the size"), ((0, 0), "twice as wide as high, got 0x0")):
        width, height = (WIDTH, WIDTH // 2) if size[0] else (0, 0)
        model.cameras[1] = ("EQUIRECTANGULAR", width, height, size)
        model.write(tmp_path / "sparse/0", kind)
        with pytest.raises(DataError, match=words):
            load_scene(tmp_path)


def write_fisheyes(root: Path, k: Intrinsics, params: tuple[float, ...], model: str = "OPENCV_FISHEYE") -> None:
    """A COLMAP model of fisheyes of the sky; what no ray reaches is black."""
    found = ColmapModel(cameras={1: (model, k.width, k.height, (k.fx, k.fy, k.cx, k.cy, *params))})
    for index, camera in enumerate(ring(9)):
        rows, columns = np.mgrid[: k.height, : k.width] + 0.5
        x, y = (columns - k.cx) / k.fx, (rows - k.cy) / k.fy
        radius = np.hypot(x, y)
        t = np.linspace(0, math.pi, 20000)
        reach = t * (1 + FISHEYE[0] * t**2 + FISHEYE[1] * t**4 + FISHEYE[2] * t**6)
        angle = np.interp(radius, reach, t)
        side = np.sin(angle) / np.maximum(radius, 1e-9)
        rays = np.stack([x * side, y * side, np.cos(angle)], axis=-1)
        (root / "images").mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(sky(rays @ camera.rotation)).astype(np.uint8)).save(root / "images" / f"{index}.png")
        found.images.append((index + 1, camera.T_cam_world, 1, f"{index}.png", [(1.0, 1.0, 1)]))
    found.points.append((1, np.zeros(3), (9, 9, 9), 0.5, [(i + 1, 0) for i in range(9)]))
    found.write(root / "sparse/0")


def test_a_wide_fisheye_is_split_into_faces_and_a_narrow_one_undistorted(tmp_path: Path) -> None:
    wide = Intrinsics(200, 200, 62.0, 62.0, 100.0, 100.0, Lens("fisheye", FISHEYE))
    assert field_of_view(wide) == pytest.approx(179, abs=4)
    write_fisheyes(tmp_path / "wide", wide, FISHEYE)
    scene = load_scene(tmp_path / "wide")
    assert len(scene.views) == 45  # nothing behind
    assert any("9 fisheye photographs are cut into 45 pinhole faces" in note for note in scene.notes)
    assert_faces_agree(scene, 3.0)
    sides = [view for view in scene.views if view.name.endswith("_left.png")]
    assert all(0.3 < np.mean(view.valid()) < 0.7 for view in sides)
    assert scene.observe is not None
    observed = scene.observe()
    in_front = observed.in_view(scene.train[0].name, scene.train[0].camera, min_track=1)
    names = {view.name for view in scene.views if len(observed.in_view(view.name, view.camera, min_track=1).depth)}
    assert names == {f"{index}_front.png" for index in range(9)}  # they look at the point
    assert len(in_front.depth) == int(scene.train[0].name.endswith("front.png"))
    assert {name for name in observed.by_view if "_" in name and len(observed.by_view[name])} == names
    assert scene.observe() is observed
    scene.forget()
    assert scene.observe() is not observed
    narrow = Intrinsics(200, 200, 120.0, 120.0, 100.0, 100.0, Lens("fisheye", FISHEYE))
    assert field_of_view(narrow) < 120
    write_fisheyes(tmp_path / "narrow", narrow, FISHEYE)
    assert len(load_scene(tmp_path / "narrow").views) == 9


def test_a_registered_camera_model_is_cut_into_faces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stereographic fisheyes, 170 degrees across, from transforms.json."""
    monkeypatch.setattr(CAMERA_MODELS, "_objects", dict(CAMERA_MODELS._objects))

    @gs2d.register_camera_model("stereographic")
    class Stereographic(CameraModel):
        is_wide = True
        parameters = ("k",)

        def project(self, lens: Lens, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            ahead = np.linalg.norm(rays, axis=-1) + rays[..., 2]
            return 2 * lens.radial[0] * rays[..., :2] / ahead[..., None], ahead > 1e-9

    size, focal, frames = 200, 54.5, []
    for index, camera in enumerate(ring(9)):
        rows, columns = np.mgrid[:size, :size] + 0.5
        x, y = (columns - size / 2) / focal, (rows - size / 2) / focal
        rays = np.stack([x, y, 1 - (x * x + y * y) / 4], axis=-1)  # of a unit sphere, scaled
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(np.rint(sky(rays @ camera.rotation)).astype(np.uint8)).save(tmp_path / f"images/{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": opengl_camera_to_world(camera)})
    meta = {"camera_model": "stereographic", "k": 1.0, "fl_x": focal, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    scene = load_scene(tmp_path)
    assert len(scene.views) > 9
    assert any("9 stereographic photographs are cut into" in note for note in scene.notes)
    assert_faces_agree(scene, 3.0)
    (tmp_path / "transforms.json").write_text(json.dumps(meta | {"camera_model": "unheard-of"}))
    with pytest.raises(DataError, match="register_camera_model"):
        load_scene(tmp_path)


def test_faces_that_the_mask_of_a_round_fisheye_hides_are_left_out(tmp_path: Path) -> None:
    """The picture goes on beyond the circle, as far as the ray behind; one of nine photographs has no mask."""
    k = Intrinsics(320, 200, 45.0, 45.0, 160.0, 100.0, Lens("fisheye", FISHEYE))
    write_fisheyes(tmp_path, k, FISHEYE)
    v, u = np.mgrid[:400, :640] + 0.5
    circle = np.hypot(u - 320, v - 200) < 160  # of twice the size, 102 degrees from the axis
    (tmp_path / "masks").mkdir()
    for index in range(8):
        Image.fromarray(circle.astype(np.uint8) * np.uint8(255)).save(tmp_path / "masks" / f"{index}.png")
    scene = load_scene(tmp_path, test_every=0)
    behind = [view.name for view in scene.views if view.name.endswith("_back.png")]
    assert behind == ["8_back.png"]
    assert len(scene.views) == 8 * 5 + 6
    assert len([view for view in load_scene(tmp_path, test_every=0, masked="off").views if "_back" in view.name]) == 9
