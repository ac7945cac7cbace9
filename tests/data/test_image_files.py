"""Reading and writing of image files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gs2d.data.image_files import image_size, read_grey, read_image, read_mask, write_image
from gs2d.errors import DataError


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


def test_a_missing_or_damaged_image_is_an_error_that_names_it(tmp_path: Path) -> None:
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


def test_a_mask_of_zeros_and_ones_is_not_all_black(tmp_path: Path) -> None:
    pixels = np.array([[0, 1], [1, 0]], np.uint8)
    for name, factor in (("ones", 1), ("white", 255), ("dark", 100)):
        Image.fromarray(pixels * np.uint8(factor)).save(tmp_path / f"{name}.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "ones.png"), pixels == 1)
    np.testing.assert_array_equal(read_mask(tmp_path / "white.png"), pixels == 1)
    assert not read_mask(tmp_path / "dark.png").any()


def test_a_written_image_reads_back_unchanged(tmp_path: Path) -> None:
    for channels in (3, 4):
        pixels = np.random.default_rng(channels).integers(0, 256, (7, 5, channels)).astype(np.uint8)
        write_image(tmp_path / "a.png", pixels)
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)
    write_image(tmp_path / "m.png", np.array([[True, False]]))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), [[True, False]])
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["a.png", "m.png"]


def png_of(path: Path, width: int, height: int, mode: str = "RGB") -> Path:
    Image.new(mode, (width, height)).save(path)
    return path


def test_a_decompression_bomb_is_not_decoded(tmp_path: Path) -> None:
    """36 megapixels of black: a hundred kilobytes, and half a gigabyte on the way to an array."""
    bomb = png_of(tmp_path / "bomb.png", 6000, 6000)
    assert bomb.stat().st_size < 200_000
    with pytest.raises(DataError, match=r"bomb\.png"):
        read_image(bomb)
    with pytest.raises(DataError, match="would take 144 MB"):
        read_mask(bomb)
    assert image_size(bomb) == (6000, 6000)


@pytest.mark.parametrize("format_", ["DDS", "EPS", "TGA", "ICO", "PCX", "GIF"])
def test_other_image_formats_are_never_opened(tmp_path: Path, format_: str) -> None:
    """EPS would start Ghostscript; whatever the file is called, Pillow's other parsers do not see it."""
    Image.new("RGB", (32, 32), "red").save(tmp_path / "a", format=format_)
    path = (tmp_path / "a").rename(tmp_path / "a.png")
    for read in (read_image, read_mask, image_size):
        with pytest.raises(DataError, match=r"a\.png"):
            read(path)


def test_common_image_formats_are_read(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "bmp", "tif", "webp", "ppm", "pgm", "jp2"):
        Image.new("L", (20, 10), 255).save(tmp_path / f"a.{suffix}")
        assert read_image(tmp_path / f"a.{suffix}").shape[:2] == (10, 20), suffix
        assert read_mask(tmp_path / f"a.{suffix}").all(), suffix
    Image.new("RGB", (20, 10)).save(
        tmp_path / "phone.jpg", "MPO", save_all=True, append_images=[Image.new("RGB", (9, 9))]
    )
    assert read_image(tmp_path / "phone.jpg").shape == (10, 20, 3)


def test_floats_are_depths_and_no_photographs(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 5), 2.5, np.float32)).save(tmp_path / "depth.tif")
    assert (read_grey(tmp_path / "depth.tif")[0] == 2.5).all()
    with pytest.raises(DataError, match="must hold integers, got floats"):
        read_image(tmp_path / "depth.tif")
