"""Alignment: known similarities are found again, through outliers, noise and wrong pairs."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.contrib.lab.alignment import icp, ransac_similarity, rotation_degrees, voxel_downsample
from gs2d.core.similarity import similarity_scale, umeyama
from gs2d.errors import DataError
from oracle_scenes import moved, rotation, similarity

KNOWN = similarity(2.5, rotation((1, -2, 0.5), 130), (4, -7, 0.3))


def cube(count: int = 50, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


def waves(count: int, seed: int) -> np.ndarray:
    """A surface without symmetry."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    return np.column_stack([x, y, 0.4 * np.sin(2 * x + 0.5) * np.cos(1.5 * y) + 0.2 * x * y])


# correspondences


def test_a_known_similarity_is_found_to_rounding() -> None:
    points = cube()
    np.testing.assert_allclose(umeyama(points, moved(KNOWN, points)), KNOWN, atol=1e-12)
    assert similarity_scale(KNOWN) == pytest.approx(2.5)
    assert rotation_degrees(KNOWN) == pytest.approx(130)


def test_a_mirror_image_is_never_the_answer() -> None:
    points = cube()
    assert np.linalg.det(umeyama(points, points * (1, 1, -1.0))[:3, :3]) > 0


def test_centres_that_do_not_correspond_are_an_error() -> None:
    with pytest.raises(DataError, match="only . of 40 corresponding points agree within 0.5; are both lists"):
        ransac_similarity(cube(40), 100 * cube(40, seed=9), threshold=0.5, iterations=512)


# thinning


def test_voxels_hold_the_mean_of_their_points_and_start_half_a_voxel_before_the_first() -> None:
    """Smallest coordinate 0, voxel 1: cells are [-0.5, 0.5), [0.5, 1.5)."""
    points = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.6, 0, 0], [1.4, 0.2, 0], [3, 0, 0]])
    np.testing.assert_allclose(voxel_downsample(points, 1.0), [[0.2, 0, 0], [1.0, 0.1, 0], [3, 0, 0]])
    assert voxel_downsample(np.zeros((0, 3)), 1.0).shape == (0, 3)


# iterative closest points


def test_clouds_out_of_reach_of_each_other_are_not_moved() -> None:
    result = icp(waves(500, 0), waves(500, 0) + 10, threshold=0.1, iterations=30)
    np.testing.assert_array_equal(result.T_target_source, np.eye(4))
    assert (result.fraction, result.rms, result.rms_before) == (0, None, None)
    nothing = icp(waves(5, 0), np.zeros((0, 3)), threshold=0.1, iterations=30)
    assert nothing.fraction == 0
