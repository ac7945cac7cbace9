"""Real captures: sparse points project to their observations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gs2d.data import Scene, load_scene
from gs2d.data.image_files import read_image
from gs2d.data.readers.colmap import model_folder, read_images, read_points
from gs2d.data.undistort import colmap_intrinsics

Shared = Callable[[str], Path]


def observations(root: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For each image of the COLMAP model: its observed points [M, 3] world units and where it saw them [M, 2] px."""
    folder, kind = model_folder(root)
    points = read_points(folder, kind)
    row = {int(i): r for r, i in enumerate(points.ids)}
    out = {}
    for image in read_images(folder, kind, observations=True):
        observed = image.point_ids >= 0
        rows = [row[int(i)] for i in image.point_ids[observed]]
        out[image.name] = points.xyz[rows], image.observations[observed]
    return out


def errors_px(scene: Scene, root: Path, shift: float = 0.0) -> np.ndarray:
    by_image = observations(root)
    out = []
    for view in scene.views:
        points, pixels = by_image[view.name]
        projected, depth = view.camera.project(points)
        assert (depth > 0).all()
        out.append(np.linalg.norm(projected + shift - pixels, axis=1))
    return np.concatenate(out)


@pytest.mark.parametrize(
    ("name", "views", "points", "mean_px"),
    [
        ("colmap_mouse", 56, 4443, 0.633),
        ("strecha_fountain_P11", 11, 5407, 0.361),
        ("dtu_scan24", 49, 10101, 0.647),
    ],
)
def test_sparse_points_project_to_their_observations(
    shared: Shared, name: str, views: int, points: int, mean_px: float
) -> None:
    """Within the error that the data set's README states; DTU's cameras are our decomposition of its matrices."""
    root = shared(name)
    scene = load_scene(root)
    assert len(scene.views) == views
    assert len(scene.points) == points
    mean = errors_px(scene, root).mean()
    assert mean < 1.0
    assert mean == pytest.approx(mean_px, rel=0.15)
    assert errors_px(scene, root, shift=0.5).mean() > mean  # half a pixel of convention would show


def test_a_simple_radial_lens_explains_the_observations_in_the_distorted_photographs(shared: Shared) -> None:
    root = shared("sceaux_castle")
    scene = load_scene(root)
    k = colmap_intrinsics("camera", "SIMPLE_RADIAL", 1200, 902, (1258.0276749330969, 600, 451, -0.15530969337120304))
    bent, straight = [], []
    for name, (points, pixels) in observations(root).items():
        camera = next(view.camera for view in scene.views if view.name == name)
        projected, _ = camera.project(points)
        plane = (projected - (k.cx, k.cy)) / (k.fx, k.fy)
        bent.append(np.linalg.norm(k.lens.distort(plane) * (k.fx, k.fy) + (k.cx, k.cy) - pixels, axis=1))
        straight.append(np.linalg.norm(projected - pixels, axis=1))
    assert np.concatenate(bent).mean() == pytest.approx(0.355, rel=0.15)
    assert np.concatenate(straight).mean() > 2.0


def test_undistorted_photographs_show_each_point_where_the_pinhole_camera_sees_it(shared: Shared) -> None:
    """7 x 7 patches of the raw photograph at the observation and of the undistorted one at the projection."""
    root = shared("sceaux_castle")
    view = load_scene(root).train[0]
    raw, image = read_image(view.path).astype(float), view.image().astype(float)
    points, pixels = observations(root)[view.name]
    projected, _ = view.camera.project(points)
    moved = np.linalg.norm(projected - pixels, axis=1)
    inside = (np.minimum(projected, pixels) > 5).all(axis=1) & (np.maximum(projected, pixels) < (1195, 897)).all(axis=1)

    def patch(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
        x, y = np.floor(at).astype(int)  # the pixel that the point lies in
        values = picture[y - 3 : y + 4, x - 3 : x + 4].mean(axis=2).ravel()
        return (values - values.mean()) / (values.std() + 1e-9)

    chosen = np.flatnonzero(inside & (moved > 5))
    assert len(chosen) > 50
    right = np.mean([patch(raw, pixels[i]) @ patch(image, projected[i]) / 49 for i in chosen])
    wrong = np.mean([patch(raw, pixels[i]) @ patch(raw, projected[i]) / 49 for i in chosen])
    assert right > 0.75
    assert wrong < 0.3


def test_the_bottle_s_depth_maps_agree_with_its_cameras(shared: Shared) -> None:
    """Back-projected ground-truth depth of test view 0, seen from test view 1, falls on that view's silhouette."""
    root = shared("rendered_bottle")
    scene = load_scene(root)
    views = {view.name: view for view in scene.test}
    a, b = views["test/r_0.png"], views["test/r_1.png"]
    depth = np.load(root / "depth_test/r_0.npy").astype(np.float64)
    row, column = np.nonzero(depth)
    z = depth[row, column]
    c = a.camera
    x_cam = np.stack([(column + 0.5 - c.cx) / c.fx * z, (row + 0.5 - c.cy) / c.fy * z, z], axis=1)
    world = (x_cam - c.T_cam_world[:3, 3]) @ c.rotation
    assert np.abs(world).max() < 0.95  # the mesh's bounds are within 0.9
    pixels, _ = b.camera.project(world)
    j, i = pixels.astype(int).T
    assert (b.alpha()[i, j] > 0).mean() > 0.999
