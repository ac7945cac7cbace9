"""OpenEXR files: conversion to sRGB, depth maps, and damaged files."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest

from gs2d.data import load_scene
from gs2d.data.float_images import read_exr
from gs2d.data.image_files import image_size, read_grey, read_image
from gs2d.data.prior_maps import read_depth
from gs2d.errors import DataError

OpenEXR = pytest.importorskip("OpenEXR")


def write(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    facts = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    path.parent.mkdir(parents=True, exist_ok=True)
    OpenEXR.File(facts, {name: np.ascontiguousarray(a) for name, a in channels.items()}).write(str(path))
    return path


def colors(*values: float, alpha: float | None = None) -> dict[str, np.ndarray]:
    """A row of grey pixels of these linear values."""
    row = np.array([values], dtype=np.float32)
    found = {name: row for name in "RGB"}
    return found if alpha is None else {**found, "A": np.full_like(row, alpha)}


def test_linear_light_becomes_srgb_and_is_clipped_at_white(tmp_path: Path) -> None:
    # sRGB: 0.18 -> 0.4614, 0.002 -> 12.92 * 0.002 = 0.0258, 1 -> 1; below 0 and no number: black.
    path = write(tmp_path / "a.exr", colors(0.18, 0.002, 1.0, 7.5, -1.0, np.nan))
    image = read_image(path)
    assert (image.dtype, image.shape) == (np.uint8, (1, 6, 3))
    assert image[0, :, 0].tolist() == [118, 7, 255, 255, 0, 0]
    assert image_size(path) == (6, 1)


def test_premultiplied_alpha_becomes_straight(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", colors(0.09, 0.0, alpha=0.5))
    assert read_image(path)[0].tolist() == [[118, 118, 118, 128], [0, 0, 0, 128]]
    empty = write(tmp_path / "b.exr", colors(0.0, alpha=0.0))
    assert read_image(empty)[0, 0].tolist() == [0, 0, 0, 0]


def test_depths_are_not_converted(tmp_path: Path) -> None:
    depth = np.array([[1.5, 0.0], [250.25, 3.0]], dtype=np.float32)
    for channels in ({"Z": depth}, {"V": depth}, {"Z": depth, "A": np.ones_like(depth)}):
        values = read_depth(write(tmp_path / "d.exr", channels))
        assert np.array_equal(values, depth)
    with pytest.raises(DataError, match="channel"):
        read_grey(write(tmp_path / "c.exr", colors(0.5)))
    with pytest.raises(DataError, match="must hold depths above 0"):
        read_depth(write(tmp_path / "n.exr", {"Z": np.zeros((2, 2), np.float32)}))


def test_a_capture_may_have_float_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for index in range(3):
        light = rng.uniform(0, 1, (12, 16, 3)).astype(np.float32)
        write(tmp_path / f"images/{index}.exr", {name: light[..., i] for i, name in enumerate("RGB")})
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/cameras.txt").write_text("1 PINHOLE 16 12 20 20 8 6\n")
    poses = "".join(f"{i + 1} 1 0 0 0 {i} 0 3 1 {i}.exr\n\n" for i in range(3))
    (tmp_path / "sparse/images.txt").write_text(poses)
    (tmp_path / "sparse/points3D.txt").write_text("1 0 0 0 9 9 9 0.5 1 0\n")
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == ["1.exr", "2.exr", "0.exr"]
    assert np.array_equal(scene.views[2].image(), read_exr(tmp_path / "images/0.exr"))


def test_a_header_that_announces_more_than_its_file_can_hold_is_refused_before_decoding(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", colors(0.1, 0.2))
    data = path.read_bytes()
    huge = struct.pack("<4i", 0, 0, 99_999, 99_999)
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = data.index(name) + len(name) + 4
        data = data[:at] + huge + data[at + 16 :]
    path.write_bytes(data)
    for reader in (read_image, image_size, read_grey):
        with pytest.raises(DataError, match="channels"):
            reader(path)


def test_a_damaged_file_gives_an_image_or_a_one_line_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noise = {name: rng.random((16, 16), dtype=np.float32) for name in "RGB"}
    whole = bytearray(write(tmp_path / "a.exr", noise).read_bytes())
    for _ in range(300):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(damaged) if rng.random() < 0.5 else 400, 4):
            damaged[at] = rng.integers(0, 256)
        (tmp_path / "b.exr").write_bytes(damaged)
        with contextlib.suppress(DataError):
            assert read_image(tmp_path / "b.exr").dtype == np.uint8
