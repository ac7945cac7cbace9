"""Splat and point files as other programs write them: each is read, or refused in a line that says what it is."""

from __future__ import annotations

import gzip
import io
import itertools
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gs2d.contrib.formats.sog import packed_sog
from gs2d.contrib.formats.spz import read_spz, write_spz
from gs2d.contrib.formats.turned import mirrored
from gs2d.core.sh import sh_basis
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import LAYOUTS, read_splat_file, read_splats, write_layout
from gs2d.io.gaussians import Gaussians
from gs2d.io.ply_format import read_ply, write_ply
from gs2d.io.splat_ply import write_splats
from gs2d.pipeline.look.info import describe_file
from splat_scenes import a_scene


def table(path: Path, element: str = "vertex") -> np.ndarray:
    """The rows of a PLY file."""
    properties = read_ply(path).elements[element].properties
    return np.rec.fromarrays(list(properties.values()), names=list(properties)).view(np.ndarray)


def with_types(rows: np.ndarray, dtype: str, *, bits: bool = False) -> np.ndarray:
    """Rows whose columns have another type; ``bits``: the bits of half floats."""
    changed = np.zeros(len(rows), [(name, dtype) for name in rows.dtype.names or ()])
    for name in rows.dtype.names or ():
        changed[name] = rows[name].astype(np.float16).view(np.uint16) if bits else rows[name].astype(dtype)
    return changed


# -- SPZ: coordinate systems -----------------------------------------------------------------------------------
def with_records(path: Path, version: int, records: bytes) -> Path:
    """Put records where the version has them, and the flag that says so."""
    data = path.read_bytes() if version == 4 else gzip.decompress(path.read_bytes())
    data = data[:14] + b"\2" + data[15:]
    if version == 4:
        data = data[:16] + struct.pack("<I", 32 + len(records)) + data[20:32] + records + data[32:]
        path.write_bytes(data)
    else:
        path.write_bytes(gzip.compress(data + records))
    return path


def axes_of(system: int) -> np.ndarray:
    """The matrix from a coordinate system of SPZ to right, down, front, as the format's library converts."""
    bits = [(system - 1) >> i & 1 for i in range(4)]
    signs = np.diag([1.0 if bits[0] else -1.0, -1.0 if bits[1] else 1.0, 1.0 if bits[2] else -1.0])
    return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ signs if bits[3] else signs


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("system", range(1, 17))
def test_spz_records_select_the_coordinate_system(tmp_path: Path, system: int, version: int) -> None:
    """Positions, covariances, and the colour seen along any direction, turn with the axes."""
    if version == 4:
        pytest.importorskip("zstandard")
    path = tmp_path / "a.spz"
    write_spz(path, Gaussians.of(a_scene(40, 3)), version=version)
    numbers = mirrored(read_spz(path)[0], (1, -1, -1))  # as they are stored
    other = struct.pack("<II", 0xADBE0002, 3) + b"abc"
    record = struct.pack("<III", 0xADBE0003, 4, system)
    back = read_spz(with_records(path, version, other + record))[0]
    M = axes_of(system)
    np.testing.assert_allclose(back.means, numbers.means @ M.T, atol=1e-6)

    def covariance(g: Gaussians) -> np.ndarray:
        sides = quats_to_matrices(torch.from_numpy(g.quats)).numpy() * np.exp(g.log_scales)[:, None]
        return np.asarray(sides @ sides.transpose(0, 2, 1))

    np.testing.assert_allclose(covariance(back), M @ covariance(numbers) @ M.T, atol=1e-6)
    directions = torch.nn.functional.normalize(
        torch.randn((30, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1
    )
    seen = np.einsum("dk,nkc->dnc", sh_basis(directions, 3)[:, 1:].numpy(), numbers.shN)
    turned = np.einsum("dk,nkc->dnc", sh_basis(directions @ torch.from_numpy(M).T, 3)[:, 1:].numpy(), back.shN)
    np.testing.assert_allclose(turned, seen, atol=1e-6)


@pytest.mark.parametrize(("value", "size"), [(17, 4), (6, 3)])
def test_an_invalid_coordinate_system_is_an_error(tmp_path: Path, value: int, size: int) -> None:
    write_spz(tmp_path / "a.spz", Gaussians.of(a_scene(3, 0)))
    record = struct.pack("<II", 0xADBE0003, size) + value.to_bytes(size, "little")
    with pytest.raises(DataError, match=f"from 1 to 16 in 4 bytes, got {value} in {size}; export it again"):
        read_splat_file(with_records(tmp_path / "a.spz", 3, record))


# -- types of PLY properties -----------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", ["2dgs", "3dgs"])
def test_half_floats_declared_as_ushort_are_decoded(tmp_path: Path, layout: str) -> None:
    splats, path = a_scene(30, 1), tmp_path / "a.ply"
    write_splats(path, splats, layout=layout)
    write_ply(path, {"vertex": with_types(table(path), "<u2", bits=True)})
    back = read_splats(path)
    for name, tensor in splats.items():
        np.testing.assert_array_equal(getattr(back, name).numpy(), tensor.numpy().astype(np.float16))


# -- numbers that are not finite -------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", ["2dgs", "3dgs"])
def test_a_scale_of_0_and_infinite_opacities_are_read(tmp_path: Path, layout: str) -> None:
    splats = a_scene(5, 0)
    splats.opacity_logits[:2] = torch.tensor([math.inf, -math.inf])
    splats.log_scales[2, 0] = -math.inf
    path = tmp_path / "a.ply"
    write_splats(path, splats, layout=layout)
    file = read_splat_file(path)
    assert file.notes == ()
    assert file.surfels is not None
    assert file.surfels.opacities[0] > 1 - 1e-7
    assert file.surfels.opacities[1] < 1e-20
    assert file.surfels.scales[2, 0] < 1e-30


@pytest.mark.parametrize("layout", ["2dgs", "3dgs", "splat", "gltf", "usd", "sog"])
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_splats_with_nan_are_dropped_and_counted(tmp_path: Path, layout: str, wrong: float) -> None:
    if layout == "usd":
        pytest.importorskip("pxr", reason="the extra usd is not installed")
    splats = a_scene(6, 1)
    path = tmp_path / ("meta.json" if layout == "sog" else f"a{LAYOUTS.get(layout).ending}")
    if layout == "sog":  # one splat has the first value of the codebook
        files = packed_sog(Gaussians.of(splats))
        meta = json.loads(files["meta.json"])
        meta["sh0"]["codebook"][0] = wrong
        for name, data in {**files, "meta.json": json.dumps(meta).encode()}.items():
            (tmp_path / name).write_bytes(data)
    else:
        write_layout(path, splats, layout)
        number = struct.pack("<f", float(splats.means[2, 1]))
        number = struct.pack("<f", -float(splats.means[2, 1])) if layout == "gltf" else number
        data = path.read_bytes()
        assert data.count(number) == 1
        path.write_bytes(data.replace(number, struct.pack("<f", wrong)))
    file = read_splat_file(path)
    assert len(file.gaussians) == 5
    among = "sh0" if layout == "sog" else "means"
    assert file.notes == (f"{path.name}: 1 of 6 splats have NaN or infinity ({among}) and were dropped",)
    assert describe_file(path)["notes"] == list(file.notes)
    told: list[str] = []
    assert len(read_splats(path, told.append)) == 5
    assert told == list(file.notes)


# -- SH degree 4 -----------------------------------------------------------------------------------------------
def degree_4(path: Path) -> Path:
    """The degree 2 of ``a_scene`` as the lowest bands of degree 4, in the format of the ending."""
    splats = a_scene(8, 2)
    layout = "3dgs" if path.name == "a.ply" else {".ply": "compressed", ".spz": "spz4", ".glb": "gltf"}[path.suffix]
    if path.suffix == ".glb":
        write_layout(path, splats, layout)
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        document = json.loads(data[20 : 20 + length])
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        prefix = "KHR_gaussian_splatting:SH_DEGREE"
        lower = attributes[f"{prefix}_1_COEF_0"]
        attributes |= {f"{prefix}_{d}_COEF_{i}": lower for d in (3, 4) for i in range(2 * d + 1)}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, len(data) - length + len(text), len(text), b"JSON")
        path.write_bytes(head + text + data[20 + length :])
        return path
    more = Splats(**{**dict(splats.items()), "shN": torch.cat([splats.shN, torch.zeros(8, 16, 3)], dim=1)[:, :15]})
    if layout == "spz4":
        zstandard = pytest.importorskip("zstandard")
        write_layout(path, more, layout)
        data = bytearray(path.read_bytes())
        sizes = [list(struct.unpack_from("<QQ", data, 32 + 16 * i)) for i in range(6)]
        begin = 32 + 16 * 6 + sum(packed for packed, _ in sizes[:5])
        sh = np.frombuffer(zstandard.ZstdDecompressor().decompress(bytes(data[begin:])), np.uint8).reshape(8, 15, 3)
        stream = np.concatenate([sh, np.full((8, 9, 3), 200, np.uint8)], axis=1).tobytes()
        last = zstandard.ZstdCompressor().compress(stream)
        data[12] = 4
        struct.pack_into("<QQ", data, 32 + 16 * 5, len(last), len(stream))
        path.write_bytes(bytes(data[:begin]) + last)
        return path
    write_layout(path, more, layout)
    element = "vertex" if layout == "3dgs" else "sh"
    elements = {name: table(path, name) for name in read_ply(path).elements}
    rows = elements[element]
    kind = rows.dtype["f_rest_0"]
    names = [name for name in rows.dtype.names or () if not name.startswith("f_rest")]
    out = np.zeros(8, [(n, rows.dtype[n]) for n in names] + [(f"f_rest_{i}", kind) for i in range(72)])
    for name in names:
        out[name] = rows[name]
    for channel, i in itertools.product(range(3), range(24)):
        out[f"f_rest_{24 * channel + i}"] = rows[f"f_rest_{15 * channel + i}"] if i < 15 else 7
    write_ply(path, {**elements, element: out})
    return path


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.glb"])
def test_sh_degree_4_is_reduced_to_3(tmp_path: Path, name: str) -> None:
    file = read_splat_file(degree_4(tmp_path / name))
    assert file.notes == (f"{name}: SH degree 4 was reduced to 3, the highest supported",)
    assert file.gaussians.sh_degree == 3
    splats = a_scene(8, 2)
    row = np.abs(file.gaussians.means[:, None] - splats.means.numpy()).sum(axis=2).argmin(axis=1)
    assert np.abs(file.gaussians.shN[:, :8] - splats.shN.numpy()[row]).max() < 0.03


# -- other versions --------------------------------------------------------------------------------------------
def webp(rows: np.ndarray, shape: tuple[int, int]) -> bytes:
    picture = np.zeros((shape[0] * shape[1], rows.shape[1]), np.uint8)
    picture[: len(rows)] = rows
    data = io.BytesIO()
    Image.fromarray(picture.reshape(*shape, -1)).save(data, "WEBP", lossless=True, exact=True)
    return data.getvalue()


def test_sog_1_with_ranges_instead_of_codebooks_is_read(tmp_path: Path) -> None:
    files = packed_sog(Gaussians.of(a_scene(6, 1)))
    means = read_sog_means(tmp_path / "2", files)
    scales, colors = (np.random.default_rng(i).integers(0, 256, (6, 3 + i), dtype=np.uint8) for i in (0, 1))
    two = json.loads(files["meta.json"])
    harmonics = {"shape": [6, 3], "mins": -1.5, "maxs": 1.0, "files": two["shN"]["files"], "quantization": 8}
    meta: dict[str, Any] = {
        "means": {"shape": [6, 3], **two["means"]},
        "scales": {"mins": [-6.0, -5.0, -14.0], "maxs": [-3.0, -4.0, -13.0], "files": ["scales.webp"]},
        "quats": two["quats"],
        "sh0": {"mins": [-1.0, -2.0, 0.0, -4.0], "maxs": [1.0, 2.0, 3.0, 6.0], "files": ["sh0.webp"]},
        "shN": harmonics,
    }
    files |= {"scales.webp": webp(scales, (4, 4)), "sh0.webp": webp(colors, (4, 4))}
    files["meta.json"] = json.dumps(meta).encode()
    g = read_folder(tmp_path / "1", files)
    np.testing.assert_array_equal(g.means, means)
    shares = colors / 255.0
    np.testing.assert_allclose(g.log_scales, np.array([-6, -5, -14]) + np.array([3, 1, 1]) * scales / 255, atol=1e-5)
    np.testing.assert_allclose(g.sh0, np.array([-1, -2, 0]) + np.array([2, 4, 3]) * shares[:, :3], atol=1e-6)
    np.testing.assert_allclose(g.opacity_logits, -4 + 10 * shares[:, 3], atol=1e-5)
    assert g.shN.shape == (6, 3, 3)
    steps = (g.shN + 1.5) / 2.5 * 255
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    assert len(np.unique(np.rint(steps))) > 10


def read_folder(folder: Path, files: dict[str, bytes]) -> Gaussians:
    folder.mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return read_splat_file(folder / "meta.json").gaussians


def read_sog_means(folder: Path, files: dict[str, bytes]) -> np.ndarray:
    return read_folder(folder, files).means
