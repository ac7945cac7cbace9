"""The demo capture: ray caster, solids, images and files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

from gs2d.contrib.demo import demo_capture as toy
from gs2d.contrib.demo import shapes
from gs2d.contrib.demo.demo_capture import demo_cameras, write_demo_capture
from gs2d.contrib.demo.demo_scene import ToyScene, build_scene
from gs2d.contrib.demo.shading import occluded
from gs2d.core.camera import Camera, look_at
from gs2d.data import load_scene
from gs2d.errors import DiskError
from gs2d.io.meshes import read_mesh
from gs2d.meshing.raycast import cast_camera

TRAIN, TEST, SIZE = 3, 2, 48


@pytest.fixture(scope="module")
def scene() -> ToyScene:
    return build_scene(0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    write_demo_capture(folder, seed=0, train_views=TRAIN, test_views=TEST, size=SIZE, threads=1)
    return folder


def unit_camera(size: int = 64) -> Camera:
    """At the origin, looking along +z; a pixel is 2/size wide at depth 1."""
    return Camera(size, size, size / 2, size / 2, size / 2, size / 2, np.eye(4))


def pixel_rays(camera: Camera) -> np.ndarray:
    """Directions [H*W, 3] of unit z, camera axes."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1).reshape(-1, 3)


# -- the ray caster ----------------------------------------------------------------------------------------------------
def test_depth_of_a_tilted_plane_is_the_closed_form() -> None:
    # The plane z = 3 + 0.5 x. A ray (dx, dy, 1) meets it at z = 3 / (1 - 0.5 dx).
    corners = np.array([[x, y, 3 + 0.5 * x] for x in (-5.0, 9.0) for y in (-9.0, 9.0)])
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    camera = unit_camera()
    hits = cast_camera(corners, faces, camera)
    rays = pixel_rays(camera)
    assert (hits.face >= 0).all()
    np.testing.assert_allclose(hits.depth.ravel(), 3 / (1 - 0.5 * rays[:, 0]), rtol=1e-6)
    points = np.einsum("rk,rki->ri", hits.weights.reshape(-1, 3), corners[faces][hits.face.ravel()])
    np.testing.assert_allclose(points, rays * hits.depth.reshape(-1, 1), atol=1e-5)


def test_depth_of_a_sphere_is_the_closed_form_up_to_its_facets() -> None:
    ball = shapes.ball(1.0, rows=90, around=180)
    camera = look_at(np.array([3.0, 2.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0]), width=80, height=80, fx=100.0)
    hits = cast_camera(ball.vertices, ball.faces, camera)
    # |o + t d| = 1 in camera axes, where the sphere's centre is m = T (0,0,0,1) and d has unit z.
    m, d = camera.T_cam_world[:3, 3], pixel_rays(camera)
    dd, dm = (d * d).sum(1), d @ m
    under_root = dm**2 - dd * (m @ m - 1)
    expected = (dm - np.sqrt(np.maximum(under_root, 0))) / dd
    inner = under_root > 0.2  # away from the silhouette; facets are up to 2 (pi/90)^2/8 = 3e-4 deep
    assert inner.sum() > 1500
    assert (hits.face.ravel()[inner] >= 0).all()  # no ray slips between triangles
    behind = hits.depth.ravel()[inner] - expected[inner]  # facets lie inside the sphere, never in front of it
    assert behind.min() > -1e-6
    assert behind.max() < 8e-4
    assert (hits.face.ravel()[under_root < 0] == -1).all()


def test_the_shadow_of_a_ball_is_the_cylinder_below_it() -> None:
    ball = shapes.ball(0.5, rows=60, around=120)
    direction = np.array([0.0, 0.6, 0.8])
    rng = np.random.default_rng(1)
    points = np.stack([*rng.uniform(-2, 2, (2, 3000)), np.full(3000, -1.0)], axis=1)
    points[2000:, 2] = 1.0  # past the ball: never in shadow
    blocked = occluded(ball.vertices, ball.faces, points, direction)
    distance = np.linalg.norm(np.cross(points, direction), axis=1)  # of the shadow ray's line from the centre
    clear = np.abs(distance - 0.5) > 2e-3
    np.testing.assert_array_equal(blocked[clear], ((distance < 0.5) & (points[:, 2] < 0))[clear])
    assert blocked.sum() > 50


# -- the solids --------------------------------------------------------------------------------------------------------
def signed_volume(patch: shapes.Patch) -> float:
    a, b, c = (patch.vertices[patch.faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def assert_closed(patch: shapes.Patch) -> None:
    """Every directed edge occurs once, and once the other way."""
    vertices, faces = shapes.merge_vertices(patch.vertices, patch.faces)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]) @ [len(vertices), 1]
    reverse = np.concatenate([faces[:, [1, 0]], faces[:, [2, 1]], faces[:, [0, 2]]]) @ [len(vertices), 1]
    assert len(np.unique(edges)) == len(edges)
    np.testing.assert_array_equal(np.sort(edges), np.sort(reverse))


def test_every_part_of_the_scene_is_closed_faces_outwards_and_lies_in_its_box(scene: ToyScene) -> None:
    by_name = {part.name: part.patch for part in scene.parts}
    solids = {**by_name, "plinth": shapes.join([by_name.pop("plinth"), by_name.pop("rim")])}
    solids.pop("rim")
    for patch in solids.values():
        assert_closed(patch)
        assert signed_volume(patch) > 0
        a, b, c = (patch.vertices[patch.faces[:, k]] for k in range(3))
        agreement = (np.cross(b - a, c - a) * patch.normals[patch.faces[:, 0]]).sum(axis=1)
        assert (agreement > 0).all()
    assert np.abs(scene.patch.vertices).max() < 1.3


# -- the pictures ------------------------------------------------------------------------------------------------------
def read(capture: Path, name: str) -> np.ndarray:
    return np.asarray(Image.open(capture / name))


def test_the_capture_loads_as_a_blender_scene_with_the_cameras_that_rendered_it(capture: Path) -> None:
    loaded = load_scene(capture)
    assert loaded.format == "blender"
    assert (len(loaded.train), len(loaded.test)) == (TRAIN, TEST)
    expected = demo_cameras(0, TRAIN, TEST, SIZE)
    for views, cameras in ((loaded.train, expected["train"]), (loaded.test, expected["test"])):
        for view, camera in zip(views, cameras, strict=True):  # fewer than 11 views: names sort as numbers
            np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-12)
            np.testing.assert_allclose(view.camera.K, camera.K, rtol=1e-12)
            assert view.image().shape == (SIZE, SIZE, 4)


def test_rendered_alpha_is_the_projection_of_the_mesh_on_disk(capture: Path) -> None:
    mesh = read_mesh(capture / "mesh_gt.ply")
    meta = json.loads((capture / "transforms_test.json").read_text())
    T_world_cam = np.array(meta["frames"][1]["transform_matrix"]) @ np.diag([1, -1, -1, 1])
    focal = SIZE / 2 / np.tan(meta["camera_angle_x"] / 2)
    camera = Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, np.linalg.inv(T_world_cam))
    scale = 16  # another program's polygons, fine enough to average to coverage
    pixels = camera.project(mesh.vertices.astype(np.float64))[0] * scale
    canvas = Image.new("L", (SIZE * scale, SIZE * scale))
    draw = ImageDraw.Draw(canvas)
    for triangle in pixels[mesh.faces]:
        draw.polygon([tuple(p - 0.5) for p in triangle], fill=255)
    coverage = np.asarray(canvas, dtype=np.float64).reshape(SIZE, scale, SIZE, scale).mean(axis=(1, 3)) / 255
    alpha = read(capture, "test/r_1.png")[:, :, 3] / 255
    assert 0.15 < alpha.mean() < 0.6
    # PIL draws the borders of polygons half a fine pixel too wide, twice for a wire: up to 1/16 of a pixel too much.
    assert np.abs(coverage - alpha).max() < 0.3
    assert np.abs(coverage - alpha).mean() < 0.01
    assert ((coverage > 0.5) & (alpha > 0.5)).sum() / ((coverage > 0.5) | (alpha > 0.5)).sum() > 0.97


# -- the files ---------------------------------------------------------------------------------------------------------
def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(capture: Path, tmp_path: Path) -> None:
    reports: list[tuple[int, int]] = []
    write_demo_capture(
        tmp_path / "again",
        seed=0,
        train_views=TRAIN,
        test_views=TEST,
        size=SIZE,
        threads=3,
        on_progress=lambda done, total: reports.append((done, total)),
    )
    first, second = contents(capture), contents(tmp_path / "again")
    assert sorted(first) == [
        "mesh_gt.ply",
        "mesh_gt_seen.npy",
        *[f"test/r_{k}.png" for k in range(TEST)],
        *[f"train/r_{k}.png" for k in range(TRAIN)],
        "transforms_test.json",
        "transforms_train.json",
    ]
    assert first == second
    assert reports == [(k + 1, TRAIN + TEST) for k in range(TRAIN + TEST)]


def test_an_unfinished_capture_is_not_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(path: Path, image: np.ndarray) -> None:
        raise DiskError(f"cannot write {path}: No space left on device")

    monkeypatch.setattr(toy, "write_image", full_disk)
    monkeypatch.setattr(toy, "bake", lambda scene, threads: None)
    monkeypatch.setattr(
        toy, "render_image", lambda *_: toy.SyntheticImage(np.zeros((16, 16, 4), np.uint8), np.zeros(1, dtype=bool))
    )
    (tmp_path / "transforms_train.json").write_text("{}")  # of an earlier capture in the same folder
    with pytest.raises(DiskError, match="No space left"):
        write_demo_capture(tmp_path, train_views=1, test_views=0, size=16)
    assert not (tmp_path / "transforms_train.json").exists()
