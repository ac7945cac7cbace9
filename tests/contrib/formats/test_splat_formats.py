"""Splats for other tools: .splat, SPZ and compressed PLY, against decoders written here and files of other programs."""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gs2d.contrib.formats.antimatter import read_splat, write_splat
from gs2d.contrib.formats.compressed_ply import read_compressed_ply, write_compressed_ply
from gs2d.contrib.formats.spz import read_spz, write_spz
from gs2d.core.sh import sh_basis
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import LAYOUTS, layout_of, read_splat_file, write_layout
from gs2d.io.gaussians import FLAT_LOG_SCALE, Gaussians, sigmoid, unit_quats
from gs2d.io.splat_ply import read_gaussians
from splat_scenes import a_scene, turned_by

C0 = 0.28209479177387814


# -- .splat ----------------------------------------------------------------------------------------------------
def test_a_splat_record_has_32_bytes_as_documented(tmp_path: Path) -> None:
    splats = a_scene(3, degree=1)
    splats.quats[:] = torch.tensor([[2.0, 0, 0, 0], [0, 0, -3.0, 0], [0.5, 0.5, 0.5, 0.5]])
    splats.log_scales[:] = torch.log(torch.tensor([[0.1, 0.2], [0.5, 0.4], [0.3, 0.3]]))
    splats.opacity_logits[:] = torch.tensor([0.0, 9.0, -1.0])
    splats.sh0[:, 0] = (torch.tensor([[0.2, 0.4, 0.6], [0.0, 1.0, 2.0], [0.5, -1.0, 0.698]]) - 0.5) / C0
    write_splat(tmp_path / "a.splat", Gaussians.of(splats))
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 96
    # s_u s_v o: 0.01, 0.2, 0.024
    for i, row in zip((1, 2, 0), range(3), strict=True):
        fields = struct.unpack("<6f8B", data[32 * row : 32 * row + 32])
        np.testing.assert_array_equal(np.float32(fields[:3]), splats.means[i].numpy())
        np.testing.assert_allclose(fields[3:6], [*splats.scales[i].numpy(), 1e-6], rtol=1e-6)
    rgba = [struct.unpack("<4B", data[32 * row + 24 : 32 * row + 28]) for row in range(3)]
    assert rgba == [(0, 255, 255, 255), (128, 0, 178, 69), (51, 102, 153, 128)]
    rotations = [struct.unpack("<4B", data[32 * row + 28 : 32 * row + 32]) for row in range(3)]
    assert rotations == [(128, 128, 0, 128), (192, 192, 192, 192), (255, 128, 128, 128)]


def test_a_splat_file_survives_a_round_trip_without_sh(tmp_path: Path) -> None:
    splats = a_scene()
    write_splat(tmp_path / "a.splat", Gaussians.of(splats))
    back = read_splat(tmp_path / "a.splat")
    order = np.argsort(-(splats.log_scales.sum(1) + splats.opacities.log()).numpy(), kind="stable")
    same = Gaussians.of(splats).rows(order)
    np.testing.assert_array_equal(back.means, same.means)
    np.testing.assert_allclose(back.log_scales, same.log_scales, atol=1e-6)
    assert np.abs(sigmoid(back.opacity_logits) - sigmoid(same.opacity_logits)).max() <= 0.5001 / 255
    shown = np.clip(0.5 + C0 * same.sh0, 0, 1)
    assert np.abs(0.5 + C0 * back.sh0 - shown).max() <= 0.5001 / 255
    assert turned_by(back.quats, same.quats).max() < 1.0
    assert (back.sh_degree, back.is_flat) == (0, True)


# -- SPZ -------------------------------------------------------------------------------------------------------
def decode_spz(path: Path) -> dict[str, np.ndarray]:
    """By the documentation of the format, one splat after the other, in its own coordinates (right, up, back)."""
    data = gzip.decompress(path.read_bytes())
    magic, version, n, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic.to_bytes(4, "little"), version, flags, reserved) == (b"NGSP", 3, 0, 0)
    k = (degree + 1) ** 2 - 1
    at = 16
    position, alpha, color, scale, rotation, sh = [], [], [], [], [], []
    for i in range(n):
        raw = data[at + 9 * i : at + 9 * i + 9]
        position.append([int.from_bytes(raw[3 * a : 3 * a + 3], "little", signed=True) / 2**bits for a in range(3)])
    at += 9 * n
    alpha = [data[at + i] / 255 for i in range(n)]
    at += n
    color = [[(data[at + 3 * i + a] / 255 - 0.5) / 0.15 for a in range(3)] for i in range(n)]
    at += 3 * n
    scale = [[data[at + 3 * i + a] / 16 - 10 for a in range(3)] for i in range(n)]
    at += 3 * n
    for i in range(n):
        word = int.from_bytes(data[at + 4 * i : at + 4 * i + 4], "little")
        largest, rest = word >> 30, [(word >> shift) & 1023 for shift in (20, 10, 0)]
        values = [(-1 if field >> 9 else 1) * (field & 511) / 511 / math.sqrt(2) for field in rest]
        values.insert(largest, math.sqrt(max(0.0, 1 - sum(v * v for v in values))))
        rotation.append([values[3], *values[:3]])  # stored x y z w
    at += 4 * n
    sh = [[[(data[at + 3 * (k * i + j) + c] - 128) / 128 for c in range(3)] for j in range(k)] for i in range(n)]
    assert len(data) == at + 3 * k * n
    names = ("position", "alpha", "color", "scale", "rotation", "sh")
    every = (position, alpha, color, scale, rotation, np.reshape(sh, (n, k, 3)))
    return {name: np.array(values, dtype=float) for name, values in zip(names, every, strict=True)} | {"bits": bits}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_has_the_documented_values(tmp_path: Path, degree: int) -> None:
    splats = a_scene(300, degree)
    g = Gaussians.of(splats)
    assert write_spz(tmp_path / "a.spz", g) == ()
    d = decode_spz(tmp_path / "a.spz")
    flip = np.array([1, -1, -1])  # right, down, front -> right, up, back
    assert np.abs(d["position"] - g.means * flip).max() <= 0.5 / 2 ** d["bits"] + 1e-7
    assert np.exp(-4.5) / 128 < 1 / 2 ** d["bits"] <= np.exp(-4.0) / 64
    assert np.abs(d["alpha"] - splats.opacities.numpy()).max() <= 0.5001 / 255
    assert np.abs(d["color"] - g.sh0).max() <= 0.5001 / 255 / 0.15
    assert np.abs(d["scale"][:, :2] - g.log_scales[:, :2]).max() <= 0.5001 / 16
    assert (d["scale"][:, 2] == -10).all()  # the thinnest that it holds
    # The frame of each splat, turned by the flip on both sides: the same covariance in flipped coordinates.
    expected = unit_quats(g.quats) * (1, 1, -1, -1)
    assert turned_by(d["rotation"], expected).max() < 0.25
    if degree:
        # 7 bits for degree 1 and 6 for the others: half a step and what rounding to 128ths adds.
        direction = torch.nn.functional.normalize(
            torch.randn((50, 3), generator=torch.Generator().manual_seed(0)), dim=1
        )
        ours = torch.einsum("dk,nkc->dnc", sh_basis(direction, degree)[:, 1:], splats.shN).numpy()
        turned = sh_basis(direction * torch.tensor([1.0, -1.0, -1.0]), degree)[:, 1:].numpy()
        theirs = np.einsum("dk,nkc->dnc", turned, d["sh"])
        bound = np.abs(turned) @ np.where(np.arange(d["sh"].shape[1]) < 3, 1.5, 2.5) / 128
        assert (np.abs(ours - theirs).max(axis=(1, 2)) <= bound + 1e-6).all()


def test_spz_keeps_coordinates_in_a_round_trip(tmp_path: Path) -> None:
    splats = a_scene()
    g = Gaussians.of(splats)
    write_spz(tmp_path / "a.spz", g)
    back, version = read_spz(tmp_path / "a.spz")
    assert version == 3
    assert np.abs(back.means - g.means).max() <= 0.5 * np.exp(-4.0) / 64  # the median splat is smaller
    assert np.abs(back.log_scales[:, :2] - g.log_scales[:, :2]).max() <= 0.5001 / 16
    assert turned_by(back.quats, g.quats).max() < 0.25
    assert np.abs(back.shN - g.shN).max() <= 2.51 / 128
    assert np.abs(back.sh0 - g.sh0).max() <= 0.5001 / 255 / 0.15
    first = (tmp_path / "a.spz").read_bytes()
    write_spz(tmp_path / "b.spz", g)
    assert (tmp_path / "b.spz").read_bytes() == first  # no time of writing in it


def test_spz_reports_clipped_splats(tmp_path: Path) -> None:
    splats = a_scene(10)
    assert write_spz(tmp_path / "a.spz", Gaussians.of(splats)) == ()  # rounding alone is not reported
    splats.log_scales[:2] = -12.0
    splats.log_scales[2, 0] = 7.0
    splats.shN[3, 0, 0] = 1.5
    splats.sh0[[0, 4]] = 5.0  # 0.15 * 5 + 0.5 = 1.25: a byte ends at 1; splat 0 counts once
    assert write_spz(tmp_path / "a.spz", Gaussians.of(splats)) == (
        "5 of 10 splats exceed the range of SPZ and were clipped: 2 smaller than 4.5e-5 units, 1 larger "
        "than 379 units, 2 colours far beyond black or white, 1 colours that change too much with the view (SH beyond "
        "1)",
        "2 of 10 disks are less than four times as wide as thick in SPZ (4.5e-5 units), so other programs do not "
        "show them flat; choose another format",
    )
    back = read_spz(tmp_path / "a.spz")[0]  # those whose colour did change by more than half a step of 1 / 255
    moved = np.abs(0.15 * (back.sh0 - Gaussians.of(splats).sh0)).max(axis=1) > 0.51 / 255
    assert np.flatnonzero(moved).tolist() == [0, 4]
    splats.means[0, 0] = 1e7
    with pytest.raises(DataError, match="SPZ holds positions up to 8388607 units, got 1e"):
        write_spz(tmp_path / "b.spz", Gaussians.of(splats))
    assert not (tmp_path / "b.spz").exists()
    splats.means[0, 0] = 5e5  # far out: fewer bits behind the point
    write_spz(tmp_path / "b.spz", Gaussians.of(splats))
    assert abs(read_spz(tmp_path / "b.spz")[0].means[0, 0] - 5e5) <= 0.1


# -- compressed PLY --------------------------------------------------------------------------------------------
def test_a_supersplat_file_equals_its_uncompressed_version(shared: Callable[[str], Path]) -> None:
    name = shared("gaussians_plush_dog") / "point_cloud_29999_clean"
    plain, packed = read_gaussians(f"{name}.ply"), read_compressed_ply(f"{name}.compressed.ply")
    distance, match = cKDTree(plain.means).query(packed.means)
    assert len(np.unique(match)) == len(plain) == len(packed)
    same = plain.rows(match)
    assert distance.max() < 2e-4
    assert np.abs(packed.log_scales - same.log_scales).max() < 0.006
    assert turned_by(packed.quats, same.quats).max() < 0.25
    assert np.abs(sigmoid(packed.opacity_logits) - sigmoid(same.opacity_logits)).max() <= 0.5001 / 255
    assert np.abs(packed.sh0 - same.sh0).max() < 0.025
    assert np.abs(packed.shN - same.shN).max() <= 1 / 64
    assert (packed.sh_degree, packed.is_flat, plain.is_flat) == (3, False, False)


def test_a_compressed_ply_survives_a_round_trip(tmp_path: Path) -> None:
    splats = a_scene(1000)
    g = Gaussians.of(splats)
    write_compressed_ply(tmp_path / "a.compressed.ply", g)
    back = read_compressed_ply(tmp_path / "a.compressed.ply")
    match = cKDTree(g.means).query(back.means)[1]
    same = g.rows(match)
    assert len(np.unique(match)) == len(g)
    # Neighbours share a chunk: its span is half of the scene's (4 units) and less, in 2047 or 1023 steps.
    assert np.abs(back.means - same.means).max() <= 4 / 1023
    assert np.abs(back.log_scales[:, :2] - same.log_scales[:, :2]).max() < 0.003
    np.testing.assert_allclose(back.log_scales[:, 2], FLAT_LOG_SCALE, rtol=1e-6)
    assert turned_by(back.quats, same.quats).max() < 0.25
    assert np.abs(back.shN - same.shN).max() <= 1 / 64 + 1e-6
    assert np.abs(sigmoid(back.opacity_logits) - sigmoid(same.opacity_logits)).max() <= 0.5001 / 255


# -- all of them -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", LAYOUTS.builtin)
@pytest.mark.parametrize("n", [0, 1, 257])
def test_every_layout_is_read_back_as_flat_splats(tmp_path: Path, layout: str, n: int) -> None:
    path = tmp_path / f"a{LAYOUTS.get(layout).ending}"
    write_layout(path, a_scene(n, degree=2), layout)
    file = read_splat_file(path)
    assert len(file.gaussians) == n
    assert file.surfels is not None
    assert file.gaussians.sh_degree == (
        0 if layout == "splat" or (layout in ("gltf", "sog", "streamed") and n == 0) else 2
    )


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("a.ply", "3dgs"),
        ("a.Compressed.PLY", "compressed"),
        ("a.spz", "spz"),
        ("a.SPLAT", "splat"),
        ("a.Usd", "usd"),
        ("a.obj", None),
    ],
)
def test_the_suffix_selects_the_layout(name: str, layout: str | None) -> None:
    assert layout_of(Path(name)) == layout


@pytest.mark.parametrize("layout", ["compressed", "spz", "splat", "spz4", "usd", "gltf", "sog"])
@pytest.mark.parametrize("kept", [0, 1, 10, 200, -1])
def test_a_truncated_file_is_a_one_line_error(tmp_path: Path, layout: str, kept: int) -> None:
    path = tmp_path / f"cut{LAYOUTS.get(layout).ending}"
    write_layout(path, a_scene(300), layout)
    path.write_bytes(path.read_bytes()[:kept])
    if layout == "splat" and kept == 0:
        assert len(read_splat_file(path).gaussians) == 0  # empty
        return
    with pytest.raises(DataError, match="cut") as caught:
        read_splat_file(path)
    assert "\n" not in str(caught.value)


def spz_with(path: Path, **changes: int) -> None:
    fields = {"magic": 0x5053474E, "version": 3, "count": 1, "degree": 0, "bits": 12, "flags": 0, "reserved": 0}
    header = struct.pack("<IIIBBBB", *(fields | changes).values())
    path.write_bytes(gzip.compress(header + bytes(20)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"magic": 5}, "SPZ of version 2 or 3"),
        ({"version": 1}, "got version 1"),
        ({"version": 4}, "got version 4"),
        ({"degree": 5}, "degree 5"),
        ({"bits": 60}, "SPZ of version 2 or 3"),
        ({"count": 800_000}, "the file ends early"),
        ({"count": 4_000_000_000}, "a cloud of splats .* would take"),
    ],
)
def test_an_invalid_spz_header_is_an_error(tmp_path: Path, changes: dict[str, int], words: str) -> None:
    spz_with(tmp_path / "a.spz", **changes)
    with pytest.raises(DataError, match=words):
        read_splat_file(tmp_path / "a.spz")
    spz_with(tmp_path / "a.spz")
    assert len(read_splat_file(tmp_path / "a.spz").gaussians) == 1


@pytest.mark.parametrize("degree", [0, 2])
def test_spz_4_has_the_streams_of_version_3(tmp_path: Path, degree: int) -> None:
    """By its documentation: a plain header, a table of sizes, streams of zstd."""
    zstandard = pytest.importorskip("zstandard")
    g = Gaussians.of(a_scene(300, degree))
    write_spz(tmp_path / "3.spz", g)
    assert write_spz(tmp_path / "4.spz", g, version=4) == ()
    data, old = (tmp_path / "4.spz").read_bytes(), gzip.decompress((tmp_path / "3.spz").read_bytes())
    magic, version, n, sh, bits, flags, streams, at = struct.unpack("<4sIIBBBBI", data[:20])
    assert (magic, version, n, sh, flags, streams) == (b"NGSP", 4, 300, degree, 0, 6 if degree else 5)
    assert (bits, at, data[20:32]) == (old[13], 32, bytes(12))
    begin, inside = at + 16 * streams, b""
    for i in range(streams):
        packed, unpacked = struct.unpack_from("<QQ", data, at + 16 * i)
        stream = zstandard.ZstdDecompressor().decompress(data[begin : begin + packed])
        assert len(stream) == unpacked
        begin, inside = begin + packed, inside + stream
    assert begin == len(data)
    assert inside == old[16:]
    (third, three), (fourth, four) = read_spz(tmp_path / "3.spz"), read_spz(tmp_path / "4.spz")
    assert (three, four) == (3, 4)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(third, name), getattr(fourth, name))


def spz4(path: Path, at: int, value: bytes) -> None:
    """A file of version 4 with other bytes at a place."""
    write_spz(path, Gaussians.of(a_scene(20, 0)), version=4)
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (4, b"\5", "SPZ of version 2, 3 or 4 .* got version 5"),
        (12, b"\5", "degree 5"),
        (15, b"\2", "2 streams"),
        (8, struct.pack("<I", 4_000_000_000), "a cloud of splats .* would take"),
        (8, struct.pack("<I", 21), "an SPZ stream of 189 bytes, got 180"),
        (
            8,
            struct.pack("<I", 19),
            "an SPZ stream of 171 bytes, got 172",
        ),  # reads one extra byte
        (16, struct.pack("<I", 10**9), "an SPZ stream of 180 bytes, got 0|its zstd is broken"),
        (32, struct.pack("<Q", 5), "an SPZ stream of 180 bytes, got 0|its zstd is broken"),
        (112, bytes(4), "its zstd is broken"),
    ],
)
def test_an_invalid_spz_4_is_a_one_line_error(tmp_path: Path, at: int, value: bytes, words: str) -> None:
    pytest.importorskip("zstandard")
    spz4(tmp_path / "a.spz", at, value)
    with pytest.raises(DataError, match=words) as caught:
        read_splat_file(tmp_path / "a.spz")
    assert "\n" not in str(caught.value)
