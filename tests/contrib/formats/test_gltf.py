"""glTF with KHR_gaussian_splatting, against a decoder written here after the extension's text."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.contrib.formats.gltf import read_gltf, write_gltf
from gs2d.core.sh import sh_basis
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import read_splat_file, read_surfels
from gs2d.io.gaussians import Gaussians
from splat_scenes import a_scene, turned_by

PREFIX = "KHR_gaussian_splatting:"
FORMATS = {5121: ("B", 1), 5123: ("H", 2), 5126: ("f", 4)}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def opened(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the bytes of a .glb file, whose every length is checked."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    assert length % 4 == 0
    document = json.loads(data[20 : 20 + length])
    rest = data[20 + length :]
    if not rest:
        return document, b""
    count, kind = struct.unpack_from("<I4s", rest)
    assert (count, kind) == (len(rest) - 8, b"BIN\0")
    assert count == document["buffers"][0]["byteLength"]
    return document, rest[8:]


def attributes(document: dict[str, Any], data: bytes) -> dict[str, np.ndarray]:
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    found = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        code, size = FORMATS[accessor["componentType"]]
        width = WIDTHS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == size * width * accessor["count"]
        values = struct.unpack_from(f"<{width * accessor['count']}{code}", data, view["byteOffset"])
        found[name.removeprefix(PREFIX)] = np.array(values).reshape(-1, width)
    return found


def rewritten(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The file with another JSON."""
    document, data = opened(path)
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_glb_has_the_fields_of_the_extension(tmp_path: Path, degree: int) -> None:
    splats = a_scene(40, degree)
    write_gltf(tmp_path / "a.glb", Gaussians.of(splats))
    document, data = opened(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in document  # who does not know it draws points
    assert document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }  # fmt: skip
    values = attributes(document, data)
    # y up: ours are turned by half a turn about z, splats, colours and all.
    half_turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_array_equal(values["POSITION"], splats.means.numpy() @ half_turn)
    position = document["accessors"][0]
    np.testing.assert_array_equal(
        [position["min"], position["max"]], [f(values["POSITION"], 0) for f in (np.min, np.max)]
    )
    np.testing.assert_allclose(np.linalg.norm(values["ROTATION"], axis=1), 1, atol=1e-6)
    theirs = quats_to_matrices(torch.from_numpy(values["ROTATION"][:, [3, 0, 1, 2]].copy())).numpy()
    ours = quats_to_matrices(splats.quats.double()).numpy()
    np.testing.assert_allclose(theirs, half_turn @ ours, atol=1e-6)
    np.testing.assert_allclose(values["SCALE"][:, :2], splats.scales.numpy(), rtol=1e-6)
    np.testing.assert_allclose(values["SCALE"][:, 2], 1e-6, rtol=1e-5)
    np.testing.assert_allclose(values["OPACITY"][:, 0], splats.opacities.numpy(), atol=1e-7)
    names = [f"SH_DEGREE_{level}_COEF_{i}" for level in range(degree + 1) for i in range(2 * level + 1)]
    assert set(values) == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", *names}
    direction = torch.nn.functional.normalize(torch.randn((20, 3), generator=torch.Generator().manual_seed(0)), dim=1)
    seen = torch.einsum("dk,nkc->dnc", sh_basis(direction, degree), torch.cat([splats.sh0, splats.shN], 1)).numpy()
    turned = sh_basis(direction @ torch.from_numpy(half_turn).float(), degree).numpy()
    np.testing.assert_allclose(
        np.einsum("dk,knc->dnc", turned, np.stack([values[name] for name in names])), seen, atol=1e-5
    )
    # Points for who knows no splats: linear colours, and the opacity.
    srgb = np.clip(0.5 + 0.28209479177387814 * splats.sh0[:, 0].numpy(), 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    assert np.abs(values["COLOR_0"][:, :3] / 65535 - linear).max() < 0.006
    np.testing.assert_allclose(values["COLOR_0"][:, 3] / 65535, splats.opacities.numpy(), atol=1e-5)


def test_a_glb_keeps_coordinates_in_a_round_trip(tmp_path: Path) -> None:
    splats = a_scene(300)
    splats.opacity_logits.clamp_(-8, 8)
    write_gltf(tmp_path / "a.glb", Gaussians.of(splats))
    back, words = read_surfels(tmp_path / "a.glb")
    assert words == "flat splats"
    for name in ("means", "sh0", "shN"):
        assert torch.equal(getattr(back, name), getattr(splats, name))
    np.testing.assert_allclose(back.log_scales, splats.log_scales, atol=1e-6)
    np.testing.assert_allclose(back.opacity_logits, splats.opacity_logits, atol=5e-4)  # float32 near 1
    assert turned_by(back.quats.numpy(), splats.quats.numpy()).max() < 0.1
    assert (quats_to_matrices(back.quats) - quats_to_matrices(splats.quats)).abs().max() < 1e-5


def test_integers_strides_transforms_and_external_buffers_are_read(tmp_path: Path) -> None:
    """By hand: two splats, interleaved, twice the size and a step aside."""
    rows = b"".join(
        struct.pack("<3f4bHHHBB3f", *position, 0, 0, 0, 127, 65535, 0, 13107, 255, 0, *color)
        for position, color in (((1, 2, 3), (0.5, 0, -1)), ((0, 0, 1), (1, 2, 3)))
    )
    stride = len(rows) // 2
    (tmp_path / "a b.bin").write_bytes(rows)
    kinds = {
        "POSITION": (0, 5126, "VEC3", False), f"{PREFIX}ROTATION": (12, 5120, "VEC4", True),
        f"{PREFIX}SCALE": (16, 5123, "VEC3", True), f"{PREFIX}OPACITY": (22, 5121, "SCALAR", True),
        f"{PREFIX}SH_DEGREE_0_COEF_0": (24, 5126, "VEC3", False),
    }  # fmt: skip
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scenes": [{"nodes": [1]}],
        "nodes": [{"mesh": 0, "scale": [2, 2, 2]}, {"children": [0], "translation": [10, 0, 0]}, {"mesh": 0}],
        "meshes": [{"primitives": [{
            "mode": 0, "attributes": {name: i for i, name in enumerate(kinds)},
            "extensions": {"KHR_gaussian_splatting": extension},
        }]}],
        "accessors": [
            {"bufferView": 0, "byteOffset": at, "componentType": code, "type": kind, "normalized": flag, "count": 2}
            for at, code, kind, flag in kinds.values()
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(rows), "byteStride": stride}],
        "buffers": [{"uri": "a%20b.bin", "byteLength": len(rows)}],
    }  # fmt: skip
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    g, kind = read_gltf(tmp_path / "a.gltf")
    assert (len(g), kind) == (2, "glTF")  # the third node is in no scene
    np.testing.assert_allclose(g.means, [[-12, -4, 6], [-10, 0, 2]], atol=1e-6)
    np.testing.assert_allclose(np.exp(g.log_scales[0]), [2, 0, 0.4], atol=1e-5)
    assert turned_by(g.quats, np.array([[0, 0, 0, 1.0]] * 2)).max() < 1e-3  # the half turn about z
    np.testing.assert_allclose(g.sh0, [[0.5, 0, -1], [1, 2, 3]])
    assert (g.opacity_logits > 17).all()
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(rows).decode()
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    np.testing.assert_array_equal(read_gltf(tmp_path / "b.gltf")[0].means, g.means)
    document["buffers"][0]["uri"] = "../a b.bin"
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "c.gltf").write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"c.gltf: expected buffers in the folder of the file, got '../a b.bin'"):
        read_gltf(tmp_path / "inner" / "c.gltf")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda d: d["meshes"][0]["primitives"][0].pop("extensions"),
            ", got glTF without; use the splats",
        ),
        (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "it needs EXT_meshopt_compression"),
        (
            lambda d: d["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"].update(
                extensions={"KHR_gaussian_splatting_compression_spz": {}}
            ),
            "got KHR_gaussian_splatting_compression_spz; convert the file to PLY",
        ),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(f"{PREFIX}SCALE"), "KeyError: 'SCALE'"),
        (lambda d: d["accessors"][0].update(count=10**12), "12000000000000 bytes|would take"),
        (lambda d: d["accessors"][0].update(count=-1), "expected an integer >= 0, got -1"),
        (lambda d: d["accessors"][0].update(count=3), "attributes of equal length"),
        (lambda d: d["accessors"][0].update(sparse={}), "expected plain accessors"),
        (lambda d: d["accessors"][0].update(type="MAT4"), "KeyError: 'MAT4'"),
        (lambda d: d["bufferViews"][2].update(byteOffset=10**9), "in a buffer of"),
        (lambda d: d["buffers"][0].update(uri="none.bin"), "cannot read .*none.bin: No such file"),
        (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "a uniform scale of the nodes"),
        (lambda d: d["nodes"][0].update(children=[0]), "expected nodes with one parent each"),
        (lambda d: d["nodes"][0].update(matrix=[1, 2]), "expected 16 finite numbers"),
        (lambda d: d["asset"].update(version="1.0"), "expected version 2.0"),
        (lambda d: d["scenes"][0].update(nodes=[7]), "IndexError"),
    ],
)
def test_an_invalid_document_is_a_one_line_error(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    write_gltf(tmp_path / "a.glb", Gaussians.of(a_scene(30, 1)))
    with pytest.raises(DataError, match=words) as caught:
        read_splat_file(rewritten(tmp_path / "a.glb", change))
    assert "\n" not in str(caught.value)
