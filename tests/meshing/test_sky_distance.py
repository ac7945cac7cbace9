"""Images tell the sky, which is infinitely far away, from a ceiling; if they do not tell, it is not sky."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.meshing.sky_distance import SmoothArea, at_infinity, smooth_area

WIDTH, HEIGHT, FOCAL, CEILING = 200, 150, 180.0, 3.0


def cameras() -> list[Camera]:
    """Return cameras that stand in a row and look up in several directions; z is up."""
    eyes = [np.array([0.5 * index - 2, 0.3 * (index % 3), 1.0]) for index in range(9)]
    ahead = [np.array([0.4 * (index % 3 - 1), 1.0, 1.2]) for index in range(9)]
    up = np.array([0.0, 0.0, 1.0])
    return [
        look_at(eye, eye + direction, up, width=WIDTH, height=HEIGHT, fx=FOCAL)
        for eye, direction in zip(eyes, ahead, strict=True)
    ]


def areas(*, ceiling: bool, shading: float = 0.1, noise: float = 0.01, falloff: float = 0.3) -> list[SmoothArea]:
    """Return images full of sky or ceiling, with faint shading, other exposures, and dark corners."""
    rng = np.random.default_rng(0)
    images = []
    for index, camera in enumerate(cameras()):
        rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
        rays = np.stack([(columns - camera.cx) / FOCAL, (rows - camera.cy) / FOCAL, np.ones_like(rows)], axis=-1)
        world = rays @ camera.rotation
        depth = (CEILING - camera.center[2]) / world[..., 2]
        place = camera.center + depth[..., None] * world if ceiling else world / world[..., 2:]
        brightness = 0.6 * (1 + shading * np.sin(1.5 * place[..., 0]) * np.cos(1.1 * place[..., 1]))
        square = ((columns - camera.cx) ** 2 + (rows - camera.cy) ** 2) / camera.cx**2
        brightness *= (0.8 + 0.05 * index) * (1 - falloff * square / 2)
        image = np.clip(brightness[..., None] + rng.normal(0, noise, (HEIGHT, WIDTH, 3)), 0, 1)
        # sparse points at the rim of the ceiling; beside the sky they are those of a roof
        pixels = np.stack([rng.uniform(1, WIDTH - 1, 30), np.full(30, HEIGHT - 1.5)], axis=1)
        column, row = pixels.astype(int).T
        images.append(smooth_area(camera, image, np.ones((HEIGHT, WIDTH), bool), pixels, depth[row, column]))
    return images


@pytest.mark.parametrize("falloff", [0.0, 0.5])
def test_shading_tells_the_sky_from_a_ceiling(falloff: float) -> None:
    assert at_infinity(areas(ceiling=False, falloff=falloff))
    assert not at_infinity(areas(ceiling=True, falloff=falloff))


def test_too_few_images_show_no_sky() -> None:
    assert not at_infinity([])
    assert not at_infinity(areas(ceiling=False)[:1])


def test_blocks_average_the_image_and_take_the_depth_of_the_nearest_point() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 0.5)
    image[::2] = 0.3
    sky = np.arange(HEIGHT)[:, None] < 101 + np.zeros((1, WIDTH))
    area = smooth_area(cameras()[0], image, sky, np.array([[10.0, 120.0], [180.0, 20.0]]), np.array([2.0, 5.0]))
    assert area.factor == 2
    np.testing.assert_allclose(area.brightness, np.log(0.4))
    assert area.inside[:50].all()
    assert not area.inside[50:].any()  # a block that is partly sky is not
    assert area.depth[60, 5] == area.depth[70, 20] == 2
    assert area.depth[5, 95] == 5
