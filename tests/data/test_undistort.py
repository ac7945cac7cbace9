"""Lens models and undistortion."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import small_colmap
from gs2d.data import load_scene
from gs2d.data.camera_models import Lens
from gs2d.data.faces import panorama
from gs2d.data.undistort import Intrinsics, colmap_intrinsics, source_positions, undistort_image

WIDTH, HEIGHT, F, CX, CY = 160, 120, 110.0, 77.0, 63.5
MODELS = {
    "SIMPLE_RADIAL": (F, CX, CY, -0.15),
    "RADIAL": (F, CX, CY, 0.1, -0.05),
    "OPENCV": (F, F + 3, CX, CY, 0.08, -0.1, 0.01, -0.006),
    "FULL_OPENCV": (F, F + 3, CX, CY, 0.3, 0.1, 0.004, 0.002, 0.02, 0.4, 0.05, 0.01),
    "SIMPLE_RADIAL_FISHEYE": (F, CX, CY, 0.05),
    "RADIAL_FISHEYE": (F, CX, CY, 0.05, -0.02),
    "OPENCV_FISHEYE": (F, F + 3, CX, CY, 0.05, -0.02, 0.01, -0.003),
    "FOV": (F, F + 3, CX, CY, 0.7),
}


def test_perspective_distortion_worked_by_hand() -> None:
    """r2 = 0.3125; s = 1.03125; x' = 0.515625 + 2 (0.01) 0.125 + 0.02 (0.3125 + 0.5); y' = 0.2578125 + ..."""
    lens = Lens("perspective", (0.1,), (), (0.01, 0.02))
    np.testing.assert_allclose(lens.distort(np.array([0.5, 0.25])), [0.534375, 0.2671875], rtol=1e-14)


def test_parameters_of_each_colmap_model_are_in_colmap_s_order() -> None:
    def of(model: str, *params: float) -> Intrinsics:
        return colmap_intrinsics("camera 1", model, 40, 30, params)

    assert of("SIMPLE_PINHOLE", 1, 2, 3) == Intrinsics(40, 30, 1, 1, 2, 3)
    assert of("PINHOLE", 1, 2, 3, 4) == Intrinsics(40, 30, 1, 2, 3, 4)
    assert of("SIMPLE_RADIAL", 1, 2, 3, 9) == Intrinsics(40, 30, 1, 1, 2, 3, Lens("perspective", (9,)))
    assert of("RADIAL", 1, 2, 3, 8, 9).lens == Lens("perspective", (8, 9))
    assert of("OPENCV", 1, 2, 3, 4, 5, 6, 7, 8).lens == Lens("perspective", (5, 6), (), (7, 8))
    full = of("FULL_OPENCV", 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12)
    assert full == Intrinsics(40, 30, 1, 2, 3, 4, Lens("perspective", (5, 6, 9), (10, 11, 12), (7, 8)))
    assert of("SIMPLE_RADIAL_FISHEYE", 1, 2, 3, 9) == Intrinsics(40, 30, 1, 1, 2, 3, Lens("fisheye", (9,)))
    assert of("RADIAL_FISHEYE", 1, 2, 3, 8, 9).lens == Lens("fisheye", (8, 9))
    assert of("OPENCV_FISHEYE", 1, 2, 3, 4, 5, 6, 7, 8) == Intrinsics(40, 30, 1, 2, 3, 4, Lens("fisheye", (5, 6, 7, 8)))
    assert of("FOV", 1, 2, 3, 4, 0.5).lens == Lens("fov", (0.5,))
    # A lens without distortion needs no undistortion, unless it is a fisheye.
    assert of("OPENCV", 1, 2, 3, 4, 0, 0, 0, 0).lens is None
    assert of("OPENCV_FISHEYE", 1, 2, 3, 4, 0, 0, 0, 0).lens == Lens("fisheye", (0, 0, 0, 0))


def ideal_pixels_of_sensor(k: Intrinsics) -> np.ndarray:
    """Where each pixel centre of the distorted image would be in a pinhole image [H, W, 2] (damped fixed point)."""
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    distorted = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy], axis=-1)
    ideal = distorted.copy()
    for _ in range(300):
        ideal += 0.7 * (distorted - k.lens.distort(ideal))
    assert np.abs(k.lens.distort(ideal) - distorted).max() < 1e-6
    return ideal * (k.fx, k.fy) + (k.cx, k.cy)


@pytest.mark.parametrize("model", MODELS)
def test_a_distorted_grid_becomes_straight(tmp_path: Path, model: str) -> None:
    """The photograph shows 128 + 100 sin(2 pi x / 24) of the ideal x in red, of y in green.

    Slopes reach 26 levels a pixel, so half a pixel of offset would cost 13; bilinear sampling of a wave of
    24 px costs (2 pi / 24)^2 / 8 = 0.9 % of its amplitude.
    """
    k = colmap_intrinsics("camera 7", model, WIDTH, HEIGHT, MODELS[model])
    ideal = ideal_pixels_of_sensor(k)
    waves = 128 + 100 * np.sin(2 * math.pi * ideal / 24)
    photo = np.concatenate([waves, np.zeros((HEIGHT, WIDTH, 1))], axis=2).round().astype(np.uint8)
    small_colmap(tmp_path, count=3, cameras={7: (model, WIDTH, HEIGHT, MODELS[model])})
    for i in range(3):
        Image.fromarray(photo).save(tmp_path / f"images/{i}.png")

    view = load_scene(tmp_path, test_every=0).train[0]
    image, mask = view.image().astype(float), view.mask()
    assert (view.camera.width, view.camera.height, view.camera.fx, view.camera.cx) == (WIDTH, HEIGHT, F, CX)
    mask = np.ones((HEIGHT, WIDTH), bool) if mask is None else mask
    assert mask.mean() > 0.6
    x = np.broadcast_to(np.arange(WIDTH) + 0.5, (HEIGHT, WIDTH))
    y = np.broadcast_to((np.arange(HEIGHT) + 0.5)[:, None], (HEIGHT, WIDTH))
    expected = 128 + 100 * np.sin(2 * math.pi * np.stack([x, y], axis=-1) / 24)
    assert np.abs(image[..., :2] - expected)[mask].max() < 4.0
    assert np.abs(image[..., :2] - expected)[mask].mean() < 0.9
    assert np.abs(photo[..., :2] - expected)[mask].mean() > 5.0  # it was bent before

    # The line x = 72 (a rising zero of the wave): its place in each row, by interpolation, has no bend.
    rows = [r for r in range(5, HEIGHT - 5) if mask[r, 70:75].all()]
    near_plane_policy = []
    for row in rows:
        values = image[row, 69:75, 0] - 128
        at = int(np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))[0])
        near_plane_policy.append(69.5 + at + values[at] / (values[at] - values[at + 1]))
    assert len(rows) > 60
    assert np.abs(np.array(near_plane_policy) - 72.0).max() < 0.06


def test_pixels_outside_the_photograph_are_invalid_and_black(tmp_path: Path) -> None:
    """Pincushion n1 = +0.3: the ideal corner (0.7, 0.5) is imaged at 1.22 times its radius, outside the sensor."""
    k = Intrinsics(140, 100, 100.0, 100.0, 70.0, 50.0, Lens("perspective", (0.3,)))
    positions, valid = source_positions(k)
    assert not valid[0, 0]
    assert not valid[-1, -1]
    assert valid[50, 70]
    # On the middle row y is about 0; x = 0.595 is imaged at 0.595 (1 + 0.3 0.354) = 0.658 (inside 0.7), x = 0.665 at
    # 0.753 (outside).
    assert valid[50, 129]
    assert not valid[50, 136]
    image = np.full((100, 140, 3), 200, np.uint8)
    out = undistort_image(image, positions, valid)
    assert (out[valid] == 200).all()
    assert (out[~valid] == 0).all()


def test_a_folding_polynomial_is_cut_at_its_maximum() -> None:
    """r (1 - 0.2 r^2) grows until 1 - 0.6 r^2 = 0, r = 1.29099; beyond it the picture would repeat."""
    lens = Lens("perspective", (-0.2,))
    turn = 1 / math.sqrt(0.6)
    rays = np.array([[turn * (1 - 1e-5), 0, 1], [turn * (1 + 1e-5), 0, 1], [0, 0, -1]])
    assert lens.project(rays)[1].tolist() == [True, False, False]
    assert Lens("perspective", (0.2,)).project(np.array([1e6, 0, 1]))[1]
    assert Lens("fisheye", (0.0,) * 4).project(np.array([1e6, 0, -1]))[1]
    k = Intrinsics(400, 20, 100.0, 100.0, 200.0, 10.0, lens)
    _, valid = source_positions(k)
    np.testing.assert_array_equal(np.flatnonzero(valid[10])[[0, -1]], [200 - 129, 199 + 129])


@pytest.mark.parametrize("model", [*MODELS, "PINHOLE", "EQUIRECTANGULAR", "sheared"])
def test_the_rays_of_all_pixels_lead_back_to_them(model: str) -> None:
    k = Intrinsics(160, 80, 42.0, 42.0, CX, CY, Lens("fisheye", (0.02, -0.03), tangential=(0.001, -0.002), skew=0.01))
    if model == "EQUIRECTANGULAR":
        k = panorama(160, 80, "a panorama")
    elif model != "sheared":  # a fisheye whose polynomial folds back before the corners
        k = colmap_intrinsics("camera 1", model, WIDTH, HEIGHT, MODELS.get(model, (F, F, CX, CY)))
    rays = k.rays()
    shown = (rays != 0).any(axis=-1)
    assert 0.5 < shown.mean() < 1 if model == "sheared" else shown.all()
    points, visible = (k.lens or Lens("perspective")).project(rays[shown])
    pixels = np.stack(np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5), axis=-1)[shown]
    assert visible.all()
    np.testing.assert_allclose(points * (k.fx, k.fy) + (k.cx, k.cy), pixels, atol=1e-4)


def test_masks_are_undistorted_with_their_image(tmp_path: Path) -> None:
    """A half-plane mask x < 80 px of the photograph becomes the half plane of the ideal position."""
    params = (F, F, 80.0, 60.0, 0.4, 0.0, 0.0, 0.0)
    small_colmap(tmp_path, count=3, cameras={7: ("OPENCV", WIDTH, HEIGHT, params)})
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :100] = 255
    (tmp_path / "masks").mkdir()
    for i in range(3):
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(tmp_path / f"images/{i}.png")
        Image.fromarray(mask).save(tmp_path / f"masks/{i}.png")
    got = load_scene(tmp_path, test_every=0).train[0].mask()
    lens = Lens("perspective", (0.4,))
    x = (np.arange(WIDTH) + 0.5 - 80) / F
    columns = lens.distort(np.stack([x, np.full(WIDTH, 0.5 / F)], axis=-1))[:, 0] * F + 80
    np.testing.assert_array_equal(got[60], (columns >= 0.5) & (columns <= 99.5))  # all taps are white up to 99.5
