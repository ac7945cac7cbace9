"""Sky is detected only above the horizon; smooth object parts and everything below the horizon are not sky."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.meshing.sky import sky_pixels

HEIGHT, WIDTH, ROOF = 90, 120, 40  # the sky is above this row


def castle(*, sky: float = 0.9, noise: float = 0.004, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """Return a bright, noisy sky that fades sideways, above a textured wall with a tower."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.1, 0.7, (height, width, 1)).repeat(3, axis=2)
    fading = sky * np.linspace(1, 0.7, width)[None, :, None] * np.array([0.9, 0.95, 1.0])
    tower = (np.arange(width) > width // 2 - 6) & (np.arange(width) < width // 2 + 6)
    end = np.where(tower, height * ROOF // HEIGHT - 14, height * ROOF // HEIGHT)
    above = np.arange(height)[:, None] < end
    image[above] = np.broadcast_to(fading, image.shape)[above]
    return np.clip(image + rng.normal(0, noise, image.shape), 0, 1).astype(np.float32)


def sky_in(image: np.ndarray, points: np.ndarray, valid: np.ndarray | None = None, horizon: float = 1.0) -> np.ndarray:
    """Return ``sky_pixels``; ``horizon`` is the row, as a fraction of the height, above which rays rise."""
    above = np.arange(len(image))[:, None] < horizon * len(image) + np.zeros((1, image.shape[1]))
    return sky_pixels(image, points, above, valid)


def points_on(mask: np.ndarray, every: int = 7) -> np.ndarray:
    """Return pixel centres [M, 2] inside a mask."""
    rows, columns = np.nonzero(mask)
    return np.stack([columns, rows], axis=1)[::every] + 0.5


def wall_points(image: np.ndarray) -> np.ndarray:
    """Return points on the wall and on the tower."""
    return points_on(np.arange(len(image))[:, None] > ROOF + 1 + np.zeros((1, WIDTH)))


@pytest.mark.parametrize("sky", [0.9, 0.03])
def test_sky_without_points_is_detected_up_to_the_roofs(sky: float) -> None:
    image = castle(sky=sky)
    found = sky_in(image, wall_points(image))
    assert found[: ROOF - 16].all()
    assert found[:ROOF, : WIDTH // 2 - 8].mean() > 0.97  # sky extends to the roof line
    assert found[ROOF + 1 :].mean() < 0.005  # wall pixels that happen to be equally bright
    assert found[ROOF - 10 : ROOF, WIDTH // 2 - 4 : WIDTH // 2 + 4].mean() < 0.1  # the tower


def test_smooth_parts_of_objects_are_not_sky() -> None:
    image = castle()
    image[ROOF + 10 : ROOF + 45, 20:100] = 0.9  # a smooth plate within the wall
    image[-12:, :14] = 0.9  # and a small one at the image border
    found = sky_in(image, wall_points(castle())[:40])
    assert found[: ROOF - 16].all()
    assert found[ROOF + 1 :].mean() < 0.005


def test_a_smooth_floor_or_table_below_the_horizon_is_not_sky() -> None:
    image = castle()[::-1]  # the smooth area is at the bottom, and touches the image border
    points = points_on(np.arange(HEIGHT)[:, None] < HEIGHT - ROOF + np.zeros((1, WIDTH)))
    assert sky_in(image, points)[-ROOF + 16 :].all()  # without a horizon it would be sky
    assert not sky_in(image, points, horizon=0.5).any()
    level = castle()
    found = sky_in(level, wall_points(level), horizon=0.2)
    assert found[: int(0.2 * HEIGHT)].all()
    assert not found[int(0.2 * HEIGHT) :].any()


def test_image_noise_is_no_texture() -> None:
    image = castle(noise=0.012)
    assert sky_in(image, wall_points(image))[: ROOF - 16].mean() > 0.95
