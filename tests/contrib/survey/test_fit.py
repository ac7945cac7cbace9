"""Robust fit of positions, with up from the cameras."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gs2d.contrib.survey.fit import cameras_up, fit_places
from gs2d.core.camera import Camera, look_at
from gs2d.errors import DataError

SCALE = 3.7
TURN = Rotation.from_euler("xyz", (20, -35, 110), degrees=True).as_matrix()


def places(count: int = 40, spread: float = 30.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Places of a run, and the same in metres."""
    target = np.random.default_rng(seed).normal(size=(count, 3)) * (spread, spread, 0.3 * spread)
    return (target - (5, 6, 7)) @ TURN / SCALE, target


def angle(fit_rotation: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(fit_rotation @ TURN.T).magnitude()))


def test_exact_positions_give_the_exact_similarity() -> None:
    source, target = places()
    fit = fit_places(source, target, None)
    assert fit.scale == pytest.approx(SCALE, rel=1e-12)
    assert angle(fit.rotation) < 1e-6
    assert np.abs(fit.residuals).max() < 1e-9
    assert fit.tilt == "places"


def test_outliers_are_left_out_at_any_noise_level() -> None:
    for noise in (0.01, 1.0):
        source, target = places()
        rng = np.random.default_rng(1)
        noisy = target + rng.normal(size=target.shape) * noise
        wrong = rng.choice(len(target), 12, replace=False)
        noisy[wrong] += rng.normal(size=(12, 3)) * 60
        fit = fit_places(source, noisy, None)
        assert not fit.inliers[wrong].any()
        assert fit.inliers.sum() >= 25
        assert fit.scale == pytest.approx(SCALE, rel=3 * fit.scale_error)
        assert fit.scale_error < 0.01 * max(noise, 0.1)


def test_up_of_a_small_capture_comes_from_the_cameras() -> None:
    source, target = places(spread=2.0)
    noisy = target + np.random.default_rng(2).normal(size=target.shape) * (1.0, 1.0, 2.0)
    up = TURN[2]  # of the world, in the run
    alone, held = fit_places(source, noisy, None), fit_places(source, noisy, up)
    assert (alone.tilt, held.tilt) == ("places", "cameras")
    tilts = [np.degrees(np.linalg.norm(np.cross(fit.rotation[2], up))) for fit in (alone, held)]
    assert tilts[1] < 1e-5 < tilts[0]
    assert alone.tilt_error > 5


def test_positions_on_a_line_or_without_heights_need_an_up() -> None:
    source, target = places()
    line = np.outer(np.linspace(0, 50, 12), (1.0, 0.4, 0.1))
    on_line = (line - (5, 6, 7)) @ TURN / SCALE
    for given, told in ((on_line, line), (source, np.column_stack([target[:, :2], np.full(40, np.nan)]))):
        fit = fit_places(given, told, TURN[2])
        assert fit.scale == pytest.approx(SCALE, rel=1e-9)
        assert angle(fit.rotation) < 1e-5
        with pytest.raises(DataError, match="--set up"):
            fit_places(given, told, None)


def cameras(up: tuple[float, float, float], roll: float = 0.0) -> list[Camera]:
    made = []
    for k in range(24):
        turn = 2 * np.pi * k / 24
        eye = Rotation.align_vectors([up], [(0, 0, 1)])[0].apply((4 * np.cos(turn), 4 * np.sin(turn), 1.5))
        leaning = np.array(up) + roll * np.sin(3 * turn) * np.cross(up, eye) / np.linalg.norm(eye)
        made.append(look_at(eye, np.zeros(3), leaning, width=8, height=8, fx=8.0))
    return made


def test_up_is_rounded_to_an_axis_if_the_cameras_nearly_agree() -> None:
    assert cameras_up(cameras((0, 0, 1), roll=0.05)) == pytest.approx((0, 0, 1), abs=0)
    tilted = np.array((0.2, 0.0, 1.0)) / np.linalg.norm((0.2, 0.0, 1.0))
    assert cameras_up(cameras(tuple(tilted))) == pytest.approx(tilted, abs=1e-6)
    assert cameras_up([]) is None
