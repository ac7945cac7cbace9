"""Reading, writing, compositing and filtering of pictures (gs2d.core.images)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gs2d.core import images
from gs2d.core.images import (
    area_downscale,
    composite,
    image_size,
    is_number,
    mask_downscale,
    natural_key,
    read_image,
    read_mask,
    to_uint8,
    write_image,
)
from gs2d.errors import DataError, DiskError, ShapeError


def test_every_kind_of_file_becomes_8_bit_rgb_or_rgba(tmp_path: Path) -> None:
    grey = np.array([[0, 100, 255]], np.uint8)
    cases = {
        "l.png": (Image.fromarray(grey), [[[0, 0, 0], [100] * 3, [255] * 3]]),
        "la.png": (Image.fromarray(np.stack([grey, grey], 2), "LA"), [[[0] * 4, [100] * 4, [255] * 4]]),
        "bit.png": (Image.fromarray(grey > 50), [[[0] * 3, [255] * 3, [255] * 3]]),
        # 16 bits: 65535 is 255, 257 x 100 is 100.
        "i16.png": (Image.fromarray(grey.astype(np.uint16) * 257), [[[0] * 3, [100] * 3, [255] * 3]]),
    }
    palette = Image.fromarray(np.array([[0, 1, 2]], np.uint8), "P")
    palette.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90])
    cases["p.png"] = (palette, [[[10, 20, 30], [40, 50, 60], [70, 80, 90]]])
    for name, (image, expected) in cases.items():
        image.save(tmp_path / name)
        got = read_image(tmp_path / name)
        assert got.dtype == np.uint8
        np.testing.assert_array_equal(got, expected, err_msg=name)
    palette.save(tmp_path / "pt.png", transparency=1)
    np.testing.assert_array_equal(read_image(tmp_path / "pt.png")[0, :, 3], [255, 0, 255])
    Image.new("CMYK", (4, 3)).save(tmp_path / "cmyk.jpg")
    assert read_image(tmp_path / "cmyk.jpg").shape == (3, 4, 3)


def test_a_picture_that_is_missing_broken_or_cut_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone\.png does not exist"):
        read_image(tmp_path / "gone.png")
    with pytest.raises(DataError, match=r"gone\.png does not exist"):
        image_size(tmp_path / "gone.png")
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(DataError, match=r"text\.png does not decode"):
        read_image(tmp_path / "text.png")
    noise = np.random.default_rng(0).integers(0, 256, (50, 60, 3)).astype(np.uint8)
    for suffix in ("png", "jpg"):
        path = tmp_path / f"cut.{suffix}"
        Image.fromarray(noise).save(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert image_size(path) == (60, 50)
        with pytest.raises(DataError, match=rf"cut\.{suffix} does not decode: .*; replace or remove") as caught:
            read_image(path)
        assert "\n" not in str(caught.value)


def test_a_picture_of_far_too_many_pixels_is_told_to_be_shrunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("L", (40, 30)).save(tmp_path / "x.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 500)  # Pillow refuses twice as many
    for read in (image_size, read_image):
        with pytest.raises(DataError, match=r"x\.png .*more than 1,000 pixels, .* shrink it"):
            read(tmp_path / "x.png")


def test_a_mask_of_zeros_and_ones_is_not_all_black(tmp_path: Path) -> None:
    pixels = np.array([[0, 1], [1, 0]], np.uint8)
    for name, factor in (("ones", 1), ("white", 255), ("dark", 100)):
        Image.fromarray(pixels * np.uint8(factor)).save(tmp_path / f"{name}.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "ones.png"), pixels == 1)
    np.testing.assert_array_equal(read_mask(tmp_path / "white.png"), pixels == 1)
    assert not read_mask(tmp_path / "dark.png").any()


def test_a_written_picture_reads_back_as_it_was(tmp_path: Path) -> None:
    for channels in (3, 4):
        pixels = np.random.default_rng(channels).integers(0, 256, (7, 5, channels)).astype(np.uint8)
        write_image(tmp_path / "a.png", pixels)
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)
    write_image(tmp_path / "m.png", np.array([[True, False]]))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), [[True, False]])
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["a.png", "m.png"]


def test_floats_are_clipped_and_rounded_to_the_nearest_level() -> None:
    """0.5 x 255 = 127.5 rounds up; 0.001 x 255 = 0.255 rounds down; 0.002 x 255 = 0.51 rounds up."""
    image = np.array([[-1.0, 0.001, 0.002, 0.5, 1.0, 7.0]])
    np.testing.assert_array_equal(to_uint8(image), [[0, 0, 1, 128, 255, 255]])
    with pytest.raises(ShapeError, match="NaN"):
        to_uint8(np.array([[np.nan]]))
    with pytest.raises(ShapeError, match="uint8, bool or float, got int64"):
        to_uint8(np.array([[1]]))


def test_a_picture_that_cannot_be_written_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(DiskError, match="create it first"):
        write_image(tmp_path / "no/such/a.png", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(ShapeError, match=r"got \[2, 2, 2\]"):
        write_image(tmp_path / "a.png", np.zeros((2, 2, 2), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_area_downscale_averages_blocks_and_cuts_what_is_left_over() -> None:
    """[[10, 20], [30, 41]] averages to 25.25, rounded 25; [[0, 0], [1, 1]] to 0.5, rounded up to 1."""
    plane = np.array([[10, 20, 0, 0, 99], [30, 41, 1, 1, 99], [99] * 5], np.uint8)
    image = np.stack([plane] * 3, axis=2)
    np.testing.assert_array_equal(area_downscale(image, 2)[..., 0], [[25, 1]])
    assert area_downscale(image, 1) is image
    with pytest.raises(ShapeError, match="at least one pixel of 5x3, got 4"):
        area_downscale(image, 4)


@pytest.mark.parametrize("factor", [16, 17])
def test_white_stays_white_in_large_blocks(factor: int) -> None:
    white = np.full((factor, 2 * factor, 3), 255, np.uint8)
    np.testing.assert_array_equal(area_downscale(white, factor), np.full((1, 2, 3), 255))


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


def test_a_mask_pixel_counts_if_enough_of_its_block_does() -> None:
    mask = np.array([[1, 1, 1, 0], [1, 1, 0, 1], [0, 0, 1, 0], [1, 0, 1, 0]], bool)
    np.testing.assert_array_equal(mask_downscale(mask, 2, need=1.0), [[True, False], [False, False]])
    np.testing.assert_array_equal(mask_downscale(mask, 2, need=0.5), [[True, True], [False, True]])


def test_names_are_in_the_order_in_which_people_count() -> None:
    names = ["r_10.png", "r_2.png", "a.png", "r_2b.png", "r_002.png", "3.png", "12.png"]
    counted = ["3.png", "12.png", "a.png", "r_002.png", "r_2.png", "r_2b.png", "r_10.png"]
    assert sorted(names, key=natural_key) == counted


def png_of(path: Path, width: int, height: int, mode: str = "RGB") -> Path:
    Image.new(mode, (width, height)).save(path)
    return path


def test_an_image_that_would_explode_is_not_decoded(tmp_path: Path) -> None:
    """36 megapixels of black: a hundred kilobytes, and half a gigabyte on the way to an array."""
    bomb = png_of(tmp_path / "bomb.png", 6000, 6000)
    assert bomb.stat().st_size < 200_000
    with pytest.raises(DataError, match=r"bomb\.png: an image \(6000x6000\) .* would take 144 MB"):
        read_image(bomb)
    with pytest.raises(DataError, match="would take 144 MB"):
        read_mask(bomb)
    assert image_size(bomb) == (6000, 6000)


def test_a_mask_of_one_color_may_be_as_large_as_a_photograph(tmp_path: Path) -> None:
    assert not read_mask(png_of(tmp_path / "mask.png", 9504, 6336, "L")).any()  # of a camera of 60 megapixels


@pytest.mark.parametrize("format_", ["DDS", "EPS", "TGA", "ICO", "PCX", "GIF"])
def test_formats_that_nobody_photographs_in_are_never_tried(tmp_path: Path, format_: str) -> None:
    """EPS would start Ghostscript; whatever the file is called, Pillow's other parsers do not see it."""
    Image.new("RGB", (32, 32), "red").save(tmp_path / "a", format=format_)
    path = (tmp_path / "a").rename(tmp_path / "a.png")
    for read in (read_image, read_mask, image_size):
        with pytest.raises(DataError, match=r"a\.png .*cannot identify image file"):
            read(path)


def test_a_decoder_that_asks_for_more_memory_than_there_is_is_an_error_that_names_the_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = png_of(tmp_path / "a.png", 4, 4)

    def load(_: Image.Image) -> None:
        raise MemoryError

    monkeypatch.setattr("PIL.PngImagePlugin.PngImageFile.load", load)
    with pytest.raises(DataError, match=r"a\.png must decode in the memory there is"):
        read_image(path)


def test_formats_of_photographs_and_masks_are_read(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "bmp", "tif", "webp", "ppm", "pgm", "jp2"):
        Image.new("L", (20, 10), 255).save(tmp_path / f"a.{suffix}")
        assert read_image(tmp_path / f"a.{suffix}").shape[:2] == (10, 20), suffix
        assert read_mask(tmp_path / f"a.{suffix}").all(), suffix
    Image.new("RGB", (20, 10)).save(
        tmp_path / "phone.jpg", "MPO", save_all=True, append_images=[Image.new("RGB", (9, 9))]
    )
    assert read_image(tmp_path / "phone.jpg").shape == (10, 20, 3)


def test_digits_of_other_scripts_are_no_number() -> None:
    assert [is_number(text) for text in ("0", "00012", "", "-1", "1.0", "\u00b2", "\u0663", "9" * 19)] == [True] * 2 + [
        False
    ] * 6


@pytest.mark.parametrize("channels", [3, 4])
def test_a_picture_is_shrunk_in_bands_as_in_one_piece(channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (47, 31, channels), dtype=np.uint8)
    whole = area_downscale(picture, 4)
    assert whole.shape == (11, 7, channels)
    monkeypatch.setattr(images, "_BAND", 31 * 4 * 3)  # three rows of it at a time
    np.testing.assert_array_equal(area_downscale(picture, 4), whole)
