"""PLY files: what is written comes back, and every other kind of file is named for what it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh, read_points, write_mesh
from gs2d.io.ply_format import read_ply, write_ply
from gs2d.io.splat_ply import ply_kind, read_splats, write_splats
from surface_shapes import tetrahedron


def random_splats(n: int, degree: int, seed: int = 0) -> Splats:
    g = torch.Generator().manual_seed(seed)
    k = (degree + 1) ** 2
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 2), "opacity_logits": (n,), "sh0": (n, 1, 3)}
    shapes["shN"] = (n, k - 1, 3)
    return Splats(**{a: torch.randn(s, generator=g) for a, s in shapes.items()})


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("n", [0, 7])
def test_splats_survive_a_round_trip_exactly(tmp_path: Path, degree: int, n: int) -> None:
    splats = random_splats(n, degree)
    if n:
        splats.means[0, 0] = -0.0  # the sign of zero and subnormals survive too
        splats.means[1, 1] = 1e-42
    write_splats(tmp_path / "a.ply", splats)
    for (name, before), (_, after) in zip(splats.items(), read_splats(tmp_path / "a.ply").items(), strict=True):
        assert after.dtype == torch.float32, name
        assert after.is_contiguous(), name
        assert np.array_equal(before.numpy().view(np.int32), after.numpy().view(np.int32)), name


def test_the_2dgs_layout_equals_the_official_one(tmp_path: Path) -> None:
    splats = random_splats(2, 1)
    write_splats(tmp_path / "a.ply", splats)
    vertex = read_ply(tmp_path / "a.ply").elements["vertex"]
    assert list(vertex.properties) == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(9)]
        + ["opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    # f_rest is channel-major: with K-1 = 3 coefficients, f_rest_4 is green's second one
    assert vertex.properties["f_rest_4"][1] == splats.shN[1, 1, 1].item()
    assert (vertex.properties["nx"] == 0).all()


def test_the_viewer_layout_has_a_flat_third_scale_after_the_second(tmp_path: Path) -> None:
    splats = random_splats(3, 3)
    write_splats(tmp_path / "a.ply", splats, layout="3dgs")
    vertex = read_ply(tmp_path / "a.ply").elements["vertex"]
    names = list(vertex.properties)
    assert names[names.index("scale_1") + 1] == "scale_2"
    np.testing.assert_allclose(vertex.properties["scale_2"], np.log(1e-6), rtol=1e-6)
    np.testing.assert_array_equal(vertex.properties["scale_1"], splats.log_scales[:, 1])


def test_kinds_of_ply_files_are_distinguished(tmp_path: Path) -> None:
    write_splats(tmp_path / "3dgs.ply", random_splats(3, 0), layout="3dgs")
    write_mesh(tmp_path / "mesh.ply", tetrahedron())
    points = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    write_ply(tmp_path / "points.ply", {"vertex": points})
    write_ply(tmp_path / "empty.ply", {"camera": points})
    assert [ply_kind(tmp_path / f"{name}.ply") for name in ("3dgs", "mesh", "points")] == ["3dgs", "mesh", "points"]
    cases = {"3dgs": "3DGS splats with three", "mesh": "got a mesh", "points": "got a point cloud", "empty": "without"}
    for name, words in cases.items():
        with pytest.raises(DataError, match=words) as error:
            read_splats(tmp_path / f"{name}.ply")
        assert "\n" not in str(error.value)
        assert "expected" in str(error.value)


def test_published_3dgs_and_compressed_files_are_named(shared: Callable[[str], Path]) -> None:
    folder = shared("gaussians_plush_dog")
    with pytest.raises(DataError, match="splats"):
        read_splats(folder / "point_cloud_29999_clean.ply")
    with pytest.raises(DataError, match="compressed PLY"):
        read_splats(folder / "point_cloud_29999_clean.compressed.ply")
    assert read_points(folder / "point_cloud_29999_clean.ply").points.shape == (15105, 3)


def test_missing_splat_properties_are_named(tmp_path: Path) -> None:
    rows = np.zeros(1, dtype=[(name, "f4") for name in ("x", "y", "z", "scale_0", "scale_1", "opacity")])
    write_ply(tmp_path / "a.ply", {"vertex": rows})
    with pytest.raises(DataError, match="f_dc_0"):
        read_splats(tmp_path / "a.ply")


MIXED = """ply
format {} 1.0
comment polygons of 3 and 4 corners, colours before positions, a property of another kind on the faces
element vertex 5
property uchar red
property uchar green
property uchar blue
property double y
property double x
property float z
element face 2
property uchar material
property list uchar {} vertex_index
property float area
end_header
"""


def mixed_ply(order: str) -> bytes:
    """A square 0 1 2 3 and a triangle 0 3 4, in ASCII ("") or binary of either byte order."""
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = MIXED.format(name, "uint" if order else "int").encode()
    vertices = [(i, 2 * i, 255, 0.5 * i, -1.0 * i, 4.0) for i in range(5)]
    polygons = [(7, [0, 1, 2, 3], 1.5), (8, [0, 3, 4], 2.5)]
    if not order:
        lines = [" ".join(map(str, v)) for v in vertices]
        lines += [" ".join(map(str, [m, len(p), *p, a])) for m, p, a in polygons]
        return head + "\n".join(lines).encode() + b"\n"
    o = order
    types = [("r", "u1"), ("g", "u1"), ("b", "u1"), ("y", o + "f8"), ("x", o + "f8"), ("z", o + "f4")]
    table = np.array(vertices, dtype=types)
    body = table.tobytes()
    for material, polygon, area in polygons:
        body += bytes([material, len(polygon)]) + np.array(polygon, o + "u4").tobytes()
        body += np.array(area, o + "f4").tobytes()
    return head + body


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_polygons_any_property_order_and_every_format_are_read(tmp_path: Path, order: str) -> None:
    (tmp_path / "a.ply").write_bytes(mixed_ply(order))
    mesh = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    np.testing.assert_array_equal(mesh.vertices[:, :2], [[-1.0 * i, 0.5 * i] for i in range(5)])
    assert mesh.colors is not None
    assert mesh.colors[3].tolist() == [3, 6, 255]
    assert read_points(tmp_path / "a.ply").points[2].tolist() == [-2.0, 1.0, 4.0]


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("lost", [1, 9, 40])
def test_a_truncated_file_is_a_data_error(tmp_path: Path, order: str, lost: int) -> None:
    data = mixed_ply(order).rstrip() if not order else mixed_ply(order)
    if not order and lost == 1:
        lost = 4  # one character less of "2.5" is still a number
    (tmp_path / "a.ply").write_bytes(data[:-lost])
    with pytest.raises(DataError, match="ends early"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"solid cube\n", "does not start with 'ply'"),
        (b"ply\nformat ascii 1.0\n", "no end_header"),
        (b"ply\nformat middle_endian 1.0\nend_header\n", "format middle_endian"),
        (b"ply\nelement vertex 1\nend_header\n", "no format line"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "element vertex many"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "property float x"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "negative count"),
        (b"ply\nformat ascii 1.0\nelement v 1\nproperty float x\nproperty float x\nend_header\n1 1\n", "twice"),
        (b"ply\nformat binary_little_endian 1.0\nelement v 999999999999\nproperty float x\nend_header\n", "ends early"),
        (b"ply\nformat ascii 1.0\nelement v 1\nproperty float x\nend_header\nfive\n", "invalid number"),
    ],
)
def test_a_malformed_file_is_a_data_error_in_one_line(tmp_path: Path, text: bytes, words: str) -> None:
    (tmp_path / "a.ply").write_bytes(text)
    with pytest.raises(DataError, match=words) as error:
        read_ply(tmp_path / "a.ply")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "body", "words"),
    [
        ("ascii", b"0 0 0\nnan 0 0\n", "a list of length nan"),
        ("ascii", b"0 0 0\n2.5 0 0\n", "a list of length 2.5"),
        ("ascii", b"0 0 0\n1 3e9\n", "a number out of the range of int"),
        ("binary_little_endian", bytes(12) + b"\xff\xff\xff\x7f" + bytes(8), "it ends early"),
    ],
)
def test_an_invalid_count_or_number_is_a_data_error(tmp_path: Path, kind: str, body: bytes, words: str) -> None:
    file = tmp_path / "x.ply"
    header = f"ply\nformat {kind} 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list int int vertex_indices\nend_header\n"
    file.write_bytes(header.encode() + body)
    with pytest.raises(DataError, match=words):
        read_mesh(file)
