"""Sky, black cloth and white desks are no surface; smooth parts of a thing are."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.core.camera import look_at
from gs2d.meshing.bare import bare_pixels
from gs2d.meshing.depth_maps import RenderedView, Spool, depth_map
from gs2d.meshing.extract import extract

HEIGHT, WIDTH, ROOF = 90, 120, 40  # the sky is above this row
NO_POINTS = np.zeros((0, 2))


def castle(*, sky: float = 0.9, noise: float = 0.004, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """A bright, noisy sky that fades towards the side, above a textured wall with a tower."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.1, 0.7, (height, width, 1)).repeat(3, axis=2)
    fading = sky * np.linspace(1, 0.7, width)[None, :, None] * np.array([0.9, 0.95, 1.0])
    tower = (np.arange(width) > width // 2 - 6) & (np.arange(width) < width // 2 + 6)
    end = np.where(tower, height * ROOF // HEIGHT - 14, height * ROOF // HEIGHT)
    above = np.arange(height)[:, None] < end
    image[above] = np.broadcast_to(fading, image.shape)[above]
    return np.clip(image + rng.normal(0, noise, image.shape), 0, 1).astype(np.float32)


def points_on(mask: np.ndarray, every: int = 7) -> np.ndarray:
    """Pixel centres [M, 2] in a mask."""
    rows, columns = np.nonzero(mask)
    return np.stack([columns, rows], axis=1)[::every] + 0.5


def wall_points(image: np.ndarray) -> np.ndarray:
    """Points on what is below the sky, and on the tower."""
    return points_on(np.arange(len(image))[:, None] > ROOF + 1 + np.zeros((1, WIDTH)))


@pytest.mark.parametrize("sky", [0.9, 0.03])
def test_a_sky_without_points_is_bare_up_to_the_roofs(sky: float) -> None:
    image = castle(sky=sky)
    bare = bare_pixels(image, wall_points(image))
    assert bare[: ROOF - 16].all()
    assert bare[:ROOF, : WIDTH // 2 - 8].mean() > 0.97  # the seam along the roof belongs to it
    assert bare[ROOF + 1 :].mean() < 0.005  # pixels of the wall that happen to be as bright
    assert bare[ROOF - 10 : ROOF, WIDTH // 2 - 4 : WIDTH // 2 + 4].mean() < 0.1  # the tower


def test_where_sparse_points_lie_nothing_is_bare() -> None:
    image = castle()
    everywhere = points_on(np.ones((HEIGHT, WIDTH), bool), every=23)
    assert not bare_pixels(image, everywhere).any()
    half = everywhere[everywhere[:, 0] > WIDTH / 2]
    bare = bare_pixels(image, half)
    assert bare[:ROOF, : WIDTH // 3].mean() > 0.95
    assert bare[:, 2 * WIDTH // 3 :].mean() < 0.005


def test_texture_is_not_bare_even_where_no_point_was_found() -> None:
    assert not bare_pixels(castle(noise=0.02), NO_POINTS).any()


def test_smooth_parts_of_a_thing_are_not_bare() -> None:
    image = castle()
    image[ROOF + 10 : ROOF + 45, 20:100] = 0.9  # a smooth plate within the wall
    image[-12:, :14] = 0.9  # and a small one at the rim
    bare = bare_pixels(image, wall_points(castle())[:40])
    assert bare[: ROOF - 16].all()
    assert bare[ROOF + 1 :].mean() < 0.005


def test_the_rim_is_that_of_what_the_photograph_shows() -> None:
    image, valid = castle(), np.ones((HEIGHT, WIDTH), bool)
    valid[:9], valid[:, :6], valid[:, -6:] = False, False, False
    image[~valid] = 0.0
    bare = bare_pixels(image, wall_points(image), valid)
    assert bare[16 : ROOF - 16, 14:-14].all()
    assert bare[ROOF + 1 :, 6:-6].mean() < 0.005


def test_large_photographs_are_looked_at_small() -> None:
    image = castle(height=5 * HEIGHT, width=5 * WIDTH + 3)  # shrunk by two
    points = points_on(np.arange(5 * HEIGHT)[:, None] > 5 * ROOF + 5 + np.zeros((1, 5 * WIDTH + 3)), every=97)
    bare = bare_pixels(image, points)
    assert bare.shape == image.shape[:2]
    assert bare[: 5 * ROOF - 20, : 2 * WIDTH].all()
    assert bare[5 * ROOF + 4 :].mean() < 0.005


def wall_frames() -> list[RenderedView]:
    """Two cameras before a wall of which the left half shows nothing that could be matched."""
    made = []
    for x in (-0.2, 0.2):
        camera = look_at(np.array([x, 0, 0]), np.array([x, 0, 2.0]), np.array([0, -1.0, 0]), width=40, height=30, fx=40)
        bare = np.zeros((30, 40), bool)
        bare[:, :20] = True
        made.append(RenderedView(camera, np.full((30, 40), 2.0), None, None, bare))
    return made


def test_depth_of_bare_pixels_is_left_out_of_a_mesh_where_that_is_asked_for() -> None:
    whole = extract(wall_frames(), voxel=0.05, threads=1).mesh
    found = extract(wall_frames(), voxel=0.05, threads=1, with_bare=False).mesh
    assert np.ptp(whole.vertices[:, 0]) > 1.9
    assert np.ptp(found.vertices[:, 0]) < 1.5
    assert len(found.faces) < 0.75 * len(whole.faces)


def test_bare_pixels_outlive_the_temporary_file() -> None:
    with Spool.of(wall_frames()) as spool:
        for item, frame in zip(spool, wall_frames(), strict=True):
            assert item.bare is not None
            np.testing.assert_array_equal(item.bare, frame.bare)
            assert (item.depth == 2).all()
        spool.leave_out_bare()
        assert all((item.depth[:, :20] == 0).all() and (item.depth[:, 20:] == 2).all() for item in spool)
    assert depth_map(wall_frames()[0]).bare is not None
