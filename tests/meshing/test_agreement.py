"""Consensus of images in a texture: obstacles, highlights, exposures, and memory use."""

from __future__ import annotations

import numpy as np

from gs2d.core.camera import Camera, look_at
from gs2d.meshing.agreement import agree
from gs2d.meshing.raycast import cast_camera
from gs2d.meshing.texture import ColorSource, bake
from texture_shapes import Paint, flat_atlas, grid_plane, join, listed, photograph

SIZE = 128


def stripes(places: np.ndarray) -> np.ndarray:
    """Return fine waves on slowly changing colours."""
    wave = np.sin(12 * places[:, :1]) * np.sin(10 * places[:, 1:2])
    return np.asarray(0.45 + 0.12 * places * (1, -1, 0) + 0.15 * wave * (1.0, 0.8, 0.4))


def cameras(count: int) -> list[Camera]:
    """Return cameras in a ring above the plane."""
    found = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        eye = np.array([1.2 * np.cos(angle), 1.2 * np.sin(angle), 3.0])
        found.append(look_at(eye, np.zeros(3), np.array([0.0, 1, 0]), width=SIZE, height=SIZE, fx=1.25 * SIZE))
    return found


def photographs(count: int, gains: tuple[float, ...] = (), paint: Paint = stripes) -> list[ColorSource]:
    """Render the plane from each camera."""
    plane, seen = grid_plane(16), cameras(count)
    return [photograph(plane, camera, paint, gain) for camera, gain in zip(seen, gains or (1.0,) * count, strict=True)]


def with_plate(image: ColorSource, height: float, color: tuple[int, int, int]) -> ColorSource:
    """Add a plate in front of the plane that is not part of the mesh."""
    plate = join([grid_plane(2, side=0.9)])
    plate = type(plate)(plate.vertices + np.float32([0.2, 0.1, height]), plate.faces)
    hidden = cast_camera(plate.vertices.astype(np.float64), plate.faces, image.camera).face >= 0
    changed = image.image.copy()
    changed[hidden, :3] = color
    assert 0.02 < hidden.mean() < 0.6
    return ColorSource(image.camera, changed)


def errors(images: list[ColorSource]) -> np.ndarray:
    """Return absolute texel errors [t, 3] on a scale of 255, without the plane's border."""
    texture = bake(flat_atlas(grid_plane(16)), listed(images), SIZE, threads=1).mesh.texture
    row, column = np.indices((SIZE, SIZE)).reshape(2, -1)
    places = np.stack([(column + 0.5) / SIZE * 2 - 1, 1 - (row + 0.5) / SIZE * 2, np.zeros(SIZE * SIZE)], axis=1)
    inner = np.abs(places).max(axis=1) < 0.95
    return np.abs(texture.reshape(-1, 3)[inner] - 255 * stripes(places[inner]))


def test_an_obstacle_in_two_of_eight_images_is_rejected() -> None:
    images = photographs(8)
    clean = errors(images)
    images[2] = with_plate(images[2], 1.0, (210, 190, 40))
    images[3] = with_plate(images[3], 1.0, (200, 200, 60))
    found = errors(images)
    assert found.mean() < clean.mean() + 0.5
    assert found.max() < clean.max() + 6


def test_the_nearest_image_alone_does_not_determine_the_colour() -> None:
    images = photographs(6)
    near = look_at(np.array([0, 0, 1.9]), np.zeros(3), np.array([0.0, 1, 0]), width=SIZE, height=SIZE, fx=1.25 * SIZE)
    images.append(with_plate(photograph(grid_plane(16), near, stripes), 0.4, (30, 200, 30)))
    assert errors(images).max() < 30


def test_a_moving_highlight_is_removed() -> None:
    images = []
    for image in photographs(8):
        x, y = image.camera.center[:2] / 2

        def shiny(places: np.ndarray, x: float = x, y: float = y) -> np.ndarray:
            spot = np.exp(-((places[:, :1] - x) ** 2 + (places[:, 1:2] - y) ** 2) / 0.02)
            return stripes(places) + 0.6 * spot

        images.append(photograph(grid_plane(16), image.camera, shiny))
    assert np.quantile(errors(images), 0.999) < 20  # one image is off by 150


def test_exposures_are_estimated_from_a_chain_of_overlaps() -> None:
    """Images share points only with their neighbours; in the third image an obstacle covers a third of them."""
    truth, gains = np.random.default_rng(0).uniform(50, 160, (600, 3)), np.array([0.7, 0.9, 1.2, 1.0, 1.3])
    samples = [np.zeros((600, 4), np.uint8) for _ in gains]
    for k, (table, gain) in enumerate(zip(samples, gains, strict=True)):
        part = slice(100 * k, 100 * k + 200)
        table[part, :3], table[part, 3] = np.rint(gain * truth[part]), 255
    samples[2][250:320, :3] = (30, 200, 20)
    _, found = agree(samples)
    np.testing.assert_allclose(found / found[0], np.repeat((gains / gains[0])[:, None], 3, axis=1), rtol=0.03)


def test_image_borders_leave_no_seam() -> None:
    """Each image shows only part of the plane, at its own exposure; the uniform wall would reveal any step."""
    gains, images = (0.8, 1.2, 0.9, 1.15), []
    wall = photographs(4, gains, lambda places: np.full_like(places, 0.5))
    for k, image in enumerate(wall):
        valid = np.ones((SIZE, SIZE), bool)
        (valid if k % 2 else valid.T)[:, : SIZE // 2 + 8 * k - 12] = False
        images.append(ColorSource(image.camera, image.image, valid))
    texture = bake(flat_atlas(grid_plane(16)), listed(images), SIZE, threads=1).mesh.texture[8:-8, 8:-8].astype(int)
    assert max(np.abs(np.diff(texture, axis=k)).max() for k in (0, 1)) <= 2  # exposures differ by 50
    assert np.ptp(texture) <= 8
