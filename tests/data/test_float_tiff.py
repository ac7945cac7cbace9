"""TIFF files of floats: conversion to sRGB, depth maps, and damaged files."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from gs2d.data.float_images import FloatTiff, read_float_tiff
from gs2d.data.image_files import image_size, read_grey, read_image
from gs2d.data.prior_maps import read_depth
from gs2d.errors import DataError

tifffile = pytest.importorskip("tifffile")

#: 0.5 of linear light is 0.7354 in sRGB (187.5), 0.18 is 0.4613 (117.6).
LIGHT = np.array([[0.0, 0.18, 0.5], [1.0, 7.0, np.nan]], np.float32)
SHOWN = np.array([[0, 118, 188], [255, 255, 0]], np.uint8)


def colors(values: np.ndarray = LIGHT) -> np.ndarray:
    return np.repeat(values[..., None], 3, axis=2)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("float32", {}),
        ("float32", {"compression": "zlib"}),
        ("float32", {"bigtiff": True}),
        ("float32", {"byteorder": ">"}),
        ("float32", {"planarconfig": "separate"}),
        ("float16", {}),
        ("float64", {}),
    ],
)
def test_linear_light_becomes_srgb(tmp_path: Path, kind: str, options: dict[str, object]) -> None:
    path, light = tmp_path / "a.tiff", colors().astype(kind)
    if options.get("planarconfig") == "separate":
        light = np.moveaxis(light, -1, 0)
    tifffile.imwrite(path, light, photometric="rgb", **options)
    assert image_size(path) == (3, 2)
    np.testing.assert_array_equal(read_image(path), colors(SHOWN))


def test_one_channel_is_grey_and_premultiplied_alpha_becomes_straight(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "grey.tif", LIGHT)
    np.testing.assert_array_equal(read_image(tmp_path / "grey.tif"), colors(SHOWN))
    half = np.full((2, 3, 1), 0.5, np.float32)
    tifffile.imwrite(
        tmp_path / "a.tif",
        np.concatenate([0.5 * colors(), half], axis=2),
        photometric="rgb",
        extrasamples=["assocalpha"],
    )
    tifffile.imwrite(
        tmp_path / "b.tif", np.concatenate([colors(), half], axis=2), photometric="rgb", extrasamples=["unassalpha"]
    )
    for name in ("a.tif", "b.tif"):
        image = read_image(tmp_path / name)
        np.testing.assert_array_equal(image[..., :3], colors(SHOWN))
        assert (image[..., 3] == 128).all()


def test_16_bit_integers_are_srgb_and_depths_are_not_converted(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", colors(np.full((4, 5), 40_000, np.uint16)), photometric="rgb")
    assert np.abs(read_image(tmp_path / "a.tif").astype(int) - 156).max() <= 1  # 40000 / 257 = 155.6
    tifffile.imwrite(tmp_path / "depth.tif", np.full((4, 5), 2.5, np.float32))
    assert (read_grey(tmp_path / "depth.tif")[0] == 2.5).all()
    assert (read_depth(tmp_path / "depth.tif") == 2.5).all()


def test_a_damaged_file_gives_an_image_or_a_one_line_error(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, colors(np.full((16, 16), 0.25, np.float32)), photometric="rgb", compression="zlib")
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            damaged[at] = int(rng.integers(256))
        path.write_bytes(damaged[: int(rng.integers(8, len(whole) + 1))])
        with contextlib.suppress(DataError):
            assert read_image(path).dtype == np.uint8


def test_a_header_that_announces_more_than_its_file_can_hold_is_refused_before_decoding(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", colors(), photometric="rgb")
    huge = FloatTiff(100_000, 100_000, 3)
    with pytest.raises(DataError, match=r"a\.tif"):
        read_float_tiff(tmp_path / "a.tif", huge)
