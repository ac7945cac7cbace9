"""Compositing and filtering of images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gs2d.core import image_arrays as images
from gs2d.core.image_arrays import area_downscale, composite, natural_key, to_uint8
from gs2d.errors import ShapeError


def test_floats_are_clipped_and_rounded_to_the_nearest_level() -> None:
    """0.5 x 255 = 127.5 rounds up; 0.001 x 255 = 0.255 rounds down; 0.002 x 255 = 0.51 rounds up."""
    image = np.array([[-1.0, 0.001, 0.002, 0.5, 1.0, 7.0]])
    np.testing.assert_array_equal(to_uint8(image), [[0, 0, 1, 128, 255, 255]])
    with pytest.raises(ShapeError, match="NaN"):
        to_uint8(np.array([[np.nan]]))
    with pytest.raises(ShapeError, match="float"):
        to_uint8(np.array([[1]]))


def test_area_downscale_averages_blocks_and_cuts_what_is_left_over() -> None:
    """[[10, 20], [30, 41]] averages to 25.25, rounded 25; [[0, 0], [1, 1]] to 0.5, rounded up to 1."""
    plane = np.array([[10, 20, 0, 0, 99], [30, 41, 1, 1, 99], [99] * 5], np.uint8)
    image = np.stack([plane] * 3, axis=2)
    np.testing.assert_array_equal(area_downscale(image, 2)[..., 0], [[25, 1]])
    assert area_downscale(image, 1) is image
    with pytest.raises(ShapeError, match="least"):
        area_downscale(image, 4)


def test_transparent_pixels_do_not_bleed_into_the_colour() -> None:
    """Alphas 255, 85, 0, 0: alpha (255 + 85) / 4 = 85; red (200 255 + 80 85) / 340 = 170."""
    image = np.zeros((2, 2, 4), np.uint8)
    image[0, 0] = (200, 0, 0, 255)
    image[0, 1] = (80, 0, 0, 85)
    image[1] = (255, 255, 255, 0)
    np.testing.assert_array_equal(area_downscale(image, 2), [[[170, 0, 0, 85]]])
    np.testing.assert_array_equal(area_downscale(np.zeros((2, 2, 4), np.uint8), 2), [[[0, 0, 0, 0]]])


@given(st.integers(1, 5), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=30, deadline=None)
def test_compositing_and_filtering_commute_up_to_rounding(factor: int, seed: int, alpha: bool) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (3 * factor, 4 * factor, 4 if alpha else 3)).astype(np.uint8)
    small = composite(area_downscale(image, factor), (0.2, 0.7, 1.0))
    full = composite(image, (0.2, 0.7, 1.0)).reshape(3, factor, 4, factor, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small, full, atol=1.01 / 255)


def test_composite_worked_by_hand() -> None:
    """Alpha 0.4 (102): 0.4 x 0.2 (51) + 0.6 x 0.5 = 0.38."""
    image = np.array([[[51, 51, 51, 102], [255, 255, 255, 255], [7, 7, 7, 0]]], np.uint8)
    out = composite(image, (0.5, 0.5, 0.5))
    assert out.dtype == np.float32
    np.testing.assert_allclose(out[0, :, 0], (0.38, 1.0, 0.5), atol=1e-6)
    every = np.stack([np.arange(256, dtype=np.uint8)] * 3, axis=1)[None]
    out = composite(every, (0, 0, 0))
    assert (out[0, 0, 0], out[0, 255, 0]) == (0.0, 1.0)
    np.testing.assert_array_equal(to_uint8(out), every)
    with pytest.raises(ShapeError, match="background"):
        composite(image, (0.5, 0.5))


def test_names_are_sorted_in_numeric_order() -> None:
    names = ["r_10.png", "r_2.png", "a.png", "r_2b.png", "r_002.png", "3.png", "12.png"]
    counted = ["3.png", "12.png", "a.png", "r_002.png", "r_2.png", "r_2b.png", "r_10.png"]
    assert sorted(names, key=natural_key) == counted


@pytest.mark.parametrize("channels", [3, 4])
def test_downscaling_in_bands_equals_downscaling_at_once(channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (47, 31, channels), dtype=np.uint8)
    whole = area_downscale(picture, 4)
    assert whole.shape == (11, 7, channels)
    monkeypatch.setattr(images, "_BAND", 31 * 4 * 3)  # three rows of it at a time
    np.testing.assert_array_equal(area_downscale(picture, 4), whole)
